"""A few articulated objects made by code, for demonstrations and tests: nothing to download."""

from __future__ import annotations

import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import trimesh

from splatart_ns.capture.shapes import blocks, drum, rounded_box
from splatart_ns.capture.synthesis import SynthesisOptions, synthesize
from splatart_ns.capture.textures import Colour, lay_out
from splatart_ns.errors import InputError


@dataclass(frozen=True)
class _Link:
    name: str
    solids: Sequence[trimesh.Trimesh]
    palette: Sequence[Colour]


@dataclass(frozen=True)
class _Joint:
    name: str
    type: str
    parent: str
    child: str
    origin: tuple[float, float, float]
    axis: tuple[int, int, int]
    limits: tuple[float, float]


@dataclass(frozen=True)
class _Object:
    links: Sequence[_Link]
    joints: Sequence[_Joint]
    grain: float
    """Size of the texture's features, metres."""
    states: tuple[str, ...]
    """Joint values of the two states it is usually shown in."""


_BLUES = ((32, 62, 120), (92, 148, 205), (218, 228, 236), (245, 190, 40))
_REDS = ((128, 30, 34), (222, 96, 60), (246, 214, 168), (24, 44, 70))
_GREENS = ((24, 78, 58), (104, 168, 96), (226, 232, 190), (196, 42, 88))
_GREYS = ((46, 50, 58), (128, 134, 140), (226, 224, 216), (232, 112, 28))


def _hinge() -> _Object:
    base = [
        rounded_box((0.25, 0.32, 0.04), 0.008, at=(0.0, 0.0, 0.02)),
        drum(0.009, -0.135, -0.075, "y", at=(-0.113, 0.0, 0.050), chamfer=0.002),
        drum(0.009, 0.075, 0.135, "y", at=(-0.113, 0.0, 0.050), chamfer=0.002),
        drum(0.012, 0.124, 0.138, "x", at=(0.0, 0.09, 0.02), chamfer=0.002),
    ]
    lid = [
        rounded_box((0.222, 0.32, 0.024), 0.007, at=(0.123, 0.0, 0.004)),
        drum(0.009, -0.07, 0.07, "y", chamfer=0.002),
        rounded_box((0.016, 0.13, 0.012), 0.003, at=(0.008, 0.0, 0.0)),
        rounded_box((0.05, 0.08, 0.016), 0.004, at=(0.17, -0.08, 0.021)),
    ]
    return _Object(
        links=(_Link("base", base, _GREYS), _Link("lid", lid, _BLUES)),
        joints=(_Joint("lid_joint", "revolute", "base", "lid", (-0.113, 0.0, 0.050), (0, -1, 0), (0.0, 2.3)),),
        grain=0.022,
        states=("lid_joint=0.5", "lid_joint=1.7"),
    )


def _drawer() -> _Object:
    def cabinet(i: int, j: int, k: int) -> bool:
        return not (i == 1 and j == 1 and k in (1, 3))

    def tray(i: int, j: int, k: int) -> bool:
        front = i == 2
        inside = 1 <= j <= 3 and 1 <= k <= 2
        hollow = i == 1 and j == 2 and k == 2
        return front or (inside and not hollow)

    body = [
        blocks(((-0.17, -0.152, 0.17), (-0.18, -0.162, 0.162, 0.18), (0.02, 0.038, 0.11, 0.126, 0.252, 0.27)), cabinet),
        *(rounded_box((0.04, 0.04, 0.02), 0.004, at=(x, y, 0.01)) for x in (-0.14, 0.14) for y in (-0.15, 0.15)),
    ]
    drawer = [
        blocks(
            (
                (-0.146, -0.132, 0.172, 0.19),
                (-0.172, -0.156, -0.142, 0.142, 0.156, 0.172),
                (-0.068, -0.056, -0.044, 0.045, 0.068),
            ),
            tray,
        ),
        rounded_box((0.014, 0.15, 0.018), 0.005, at=(0.221, 0.0, 0.01)),
        *(drum(0.006, 0.19, 0.216, "x", at=(0.0, y, 0.01)) for y in (-0.05, 0.05)),
    ]
    return _Object(
        links=(_Link("body", body, _GREENS), _Link("drawer", drawer, _REDS)),
        joints=(_Joint("drawer_joint", "prismatic", "body", "drawer", (0.0, 0.0, 0.189), (1, 0, 0), (0.0, 0.24)),),
        grain=0.028,
        states=("drawer_joint=0.05", "drawer_joint=0.2"),
    )


def _arm() -> _Object:
    base = [
        rounded_box((0.22, 0.17, 0.03), 0.008, at=(0.0, 0.0, 0.015)),
        drum(0.06, 0.03, 0.11, chamfer=0.008),
        rounded_box((0.06, 0.05, 0.045), 0.006, at=(-0.077, 0.0, 0.05)),
    ]
    turret = [
        drum(0.056, 0.004, 0.044, chamfer=0.006),
        rounded_box((0.08, 0.056, 0.09), 0.01, at=(0.0, 0.0, 0.08)),
        drum(0.042, -0.036, 0.03, "y", at=(0.0, 0.0, 0.125), chamfer=0.005),
    ]
    upper = [
        drum(0.044, 0.034, 0.084, "y", chamfer=0.006),
        rounded_box((0.062, 0.044, 0.2), 0.012, at=(0.0, 0.059, 0.11)),
        drum(0.038, 0.034, 0.084, "y", at=(0.0, 0.0, 0.22), chamfer=0.006),
        rounded_box((0.016, 0.03, 0.09), 0.004, at=(0.036, 0.059, 0.12)),
    ]
    fore = [
        drum(0.036, -0.03, 0.03, "y", chamfer=0.005),
        rounded_box((0.05, 0.05, 0.18), 0.012, at=(0.0, 0.0, 0.1)),
        rounded_box((0.07, 0.09, 0.022), 0.006, at=(0.0, 0.0, 0.195)),
        rounded_box((0.03, 0.018, 0.06), 0.004, at=(0.012, -0.032, 0.23)),
        rounded_box((0.03, 0.018, 0.045), 0.004, at=(0.012, 0.032, 0.225)),
    ]
    return _Object(
        links=(
            _Link("base", base, _GREYS),
            _Link("turret", turret, _BLUES),
            _Link("upper_arm", upper, _REDS),
            _Link("forearm", fore, _GREENS),
        ),
        joints=(
            _Joint("yaw", "revolute", "base", "turret", (0.0, 0.0, 0.11), (0, 0, 1), (-2.6, 2.6)),
            _Joint("shoulder", "revolute", "turret", "upper_arm", (0.0, 0.0, 0.125), (0, 1, 0), (-1.2, 1.5)),
            _Joint("elbow", "revolute", "upper_arm", "forearm", (0.0, 0.0, 0.22), (0, 1, 0), (0.0, 2.4)),
        ),
        grain=0.025,
        states=("yaw=-0.4,shoulder=0.1,elbow=1.5", "yaw=0.5,shoulder=0.7,elbow=0.7"),
    )


_BUILDERS: dict[str, Callable[[], _Object]] = {"hinge": _hinge, "drawer": _drawer, "arm": _arm}

OBJECTS = tuple(_BUILDERS)
"""The names of the objects."""


def write_object(name: str, folder: Path) -> Path:
    """Write an object's URDF, meshes and textures into a folder; the same bytes each time.

    Args:
        name: one of `OBJECTS`.

    Returns:
        The path of the URDF.

    Raises:
        InputError: there is no such object.
    """
    return _write(name, _build(name), Path(folder))


def synthesize_object(name: str, output_dir: Path, options: SynthesisOptions | None = None) -> Path:
    """`synthesize` one of `OBJECTS`; two states are the object's own, unless joint values are given.

    Raises:
        InputError: as `synthesize`; or there is no such object.
    """
    options = options or SynthesisOptions()
    made = _build(name)
    if not options.joint_values and not options.freeze and options.states == len(made.states):
        options = replace(options, joint_values=made.states)
    with tempfile.TemporaryDirectory() as folder:
        return synthesize(_write(name, made, Path(folder)), output_dir, options)


def _build(name: str) -> _Object:
    if name not in _BUILDERS:
        raise InputError(f"There is no built-in object {name!r}; take one of: {', '.join(OBJECTS)}.")
    return _BUILDERS[name]()


def _write(name: str, made: _Object, folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    robot = ElementTree.Element("robot", name=name)
    for i, link in enumerate(made.links):
        _write_mesh(folder / f"{link.name}.obj", link, made.grain, np.random.default_rng([7, i, len(name)]))
        element = ElementTree.SubElement(robot, "link", name=link.name)
        geometry = ElementTree.SubElement(ElementTree.SubElement(element, "visual"), "geometry")
        ElementTree.SubElement(geometry, "mesh", filename=f"{link.name}.obj")
    for joint in made.joints:
        element = ElementTree.SubElement(robot, "joint", name=joint.name, type=joint.type)
        ElementTree.SubElement(element, "origin", xyz=_words(joint.origin), rpy="0 0 0")
        ElementTree.SubElement(element, "parent", link=joint.parent)
        ElementTree.SubElement(element, "child", link=joint.child)
        ElementTree.SubElement(element, "axis", xyz=_words(joint.axis))
        low, high = (f"{x:g}" for x in joint.limits)
        ElementTree.SubElement(element, "limit", lower=low, upper=high, effort="10", velocity="1")
    ElementTree.indent(robot)
    path = folder / f"{name}.urdf"
    path.write_bytes(ElementTree.tostring(robot, encoding="utf-8", xml_declaration=True))
    return path


def _write_mesh(path: Path, link: _Link, grain: float, rng: np.random.Generator) -> None:
    """An OBJ with its material file and texture beside it."""
    corners = np.concatenate([np.asarray(s.vertices)[np.asarray(s.faces)] for s in link.solids])
    texture, uv = lay_out(corners, link.palette, grain, grain / 16.0, rng)
    cv2.imwrite(str(path.with_suffix(".png")), cv2.cvtColor(texture, cv2.COLOR_RGB2BGR))
    path.with_suffix(".mtl").write_text(f"newmtl {link.name}\nKd 1 1 1\nmap_Kd {link.name}.png\n", encoding="utf-8")

    lines, first = [f"mtllib {link.name}.mtl", f"usemtl {link.name}"], 1
    lines += [f"vt {_words(t)}" for t in uv.reshape(-1, 2)]
    faces = []
    for solid in link.solids:
        lines += [f"v {_words(v)}" for v in np.asarray(solid.vertices)]
        faces.append(np.asarray(solid.faces) + first)
        first += len(solid.vertices)
    faces = np.concatenate(faces)
    texels = np.arange(faces.size).reshape(-1, 3) + 1
    lines += ["f " + " ".join(f"{v}/{t}" for v, t in zip(*row, strict=True)) for row in zip(faces, texels, strict=True)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _words(numbers: Sequence[float]) -> str:
    return " ".join(f"{x:.9g}" for x in numbers)
