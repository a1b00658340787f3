"""An articulated object made by code: solids on links, joints between them, and the URDF that tells it."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from splatart_ns.capture.textures import Colour, lay_out


@dataclass(frozen=True)
class Link:
    """A rigid part: solids in its own frame."""

    name: str
    solids: Sequence[trimesh.Trimesh]
    palette: Sequence[Colour]
    """Three colours of the ground and one of the marks on it."""
    texture_seed: tuple[int, ...]
    """Links of one seed, palette and size look alike."""


@dataclass(frozen=True)
class Joint:
    """How a link hangs on its parent. At value 0 the frames of all links are parallel."""

    name: str
    type: str
    """"revolute" or "prismatic"."""
    parent: str
    child: str
    origin: tuple[float, float, float]
    """The child's origin in the parent's frame."""
    axis: tuple[float, float, float]
    limits: tuple[float, float]
    """Radian or length."""


@dataclass(frozen=True)
class ArticulatedObject:
    """Links and the joints between them, parents before children; the first link is the root."""

    name: str
    links: Sequence[Link]
    joints: Sequence[Joint]
    grain: float
    """Size of the texture's features, length."""

    def link_poses(self, values: Mapping[str, float]) -> dict[str, np.ndarray]:
        """T_root_link [4, 4] of every link at a value of every joint."""
        poses = {self.links[0].name: np.eye(4)}
        for joint in self.joints:
            T, axis = np.eye(4), np.asarray(joint.axis, dtype=np.float64)
            T[:3, 3] = joint.origin
            if joint.type == "revolute":
                T[:3, :3] = Rotation.from_rotvec(values[joint.name] * axis).as_matrix()
            else:
                T[:3, 3] += values[joint.name] * axis
            poses[joint.child] = poses[joint.parent] @ T
        return poses

    def write(self, folder: Path) -> Path:
        """Write URDF, meshes and textures into a folder; the same bytes each time.

        Returns:
            The path of the URDF.
        """
        folder.mkdir(parents=True, exist_ok=True)
        robot = ElementTree.Element("robot", name=self.name)
        for link in self.links:
            _write_mesh(folder / f"{link.name}.obj", link, self.grain)
            element = ElementTree.SubElement(robot, "link", name=link.name)
            geometry = ElementTree.SubElement(ElementTree.SubElement(element, "visual"), "geometry")
            ElementTree.SubElement(geometry, "mesh", filename=f"{link.name}.obj")
        for joint in self.joints:
            element = ElementTree.SubElement(robot, "joint", name=joint.name, type=joint.type)
            ElementTree.SubElement(element, "origin", xyz=_words(joint.origin), rpy="0 0 0")
            ElementTree.SubElement(element, "parent", link=joint.parent)
            ElementTree.SubElement(element, "child", link=joint.child)
            ElementTree.SubElement(element, "axis", xyz=_words(joint.axis))
            low, high = (f"{x:g}" for x in joint.limits)
            ElementTree.SubElement(element, "limit", lower=low, upper=high, effort="10", velocity="1")
        ElementTree.indent(robot)
        path = folder / f"{self.name}.urdf"
        path.write_bytes(ElementTree.tostring(robot, encoding="utf-8", xml_declaration=True))
        return path


def _write_mesh(path: Path, link: Link, grain: float) -> None:
    """An OBJ with its material file and texture beside it."""
    corners = np.concatenate([np.asarray(s.vertices)[np.asarray(s.faces)] for s in link.solids])
    texture, uv = lay_out(corners, link.palette, grain, grain / 16.0, np.random.default_rng(link.texture_seed))
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
