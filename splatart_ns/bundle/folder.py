"""The bundle on disk: `articulation.json` and one PLY per part."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any, NoReturn

import torch
from torch import Tensor

from splatart_ns.bundle.bundle import JOINT_DOFS, Bundle, Joint, Part
from splatart_ns.capture.capture import UNLABELLED
from splatart_ns.errors import InputError
from splatart_ns.files import write_json
from splatart_ns.splats.ply import read_ply, write_ply
from splatart_ns.splats.splat import Splat

FORMAT = "splatart-articulation-1"
ARTICULATION = "articulation.json"


def save_bundle(bundle: Bundle, folder: Path) -> None:
    """Write the parts' PLYs and then `articulation.json`, each to a temporary name first."""
    folder = Path(folder)
    splats = _splat_paths(bundle)
    for part in bundle.parts:
        write_ply(part.splat, folder / splats[part.name])
    write_json(
        folder / ARTICULATION,
        {
            "format": FORMAT,
            "units": {"length": bundle.length_unit, "angle": "radian"},
            "states": bundle.states,
            "root": bundle.root,
            "parts": [
                {
                    "id": part.id,
                    "name": part.name,
                    "splat": splats[part.name],
                    "num_gaussians": len(part.splat),
                    "motion": part.motion.tolist(),
                    "motion_covariance": [c.tolist() if c.isfinite().all() else None for c in part.motion_covariance],
                }
                for part in bundle.parts
            ],
            "joints": [
                {
                    "name": joint.name,
                    "type": joint.type,
                    "parent": joint.parent,
                    "child": joint.child,
                    "in_tree": joint.in_tree,
                    "axis": joint.axis.tolist(),
                    "origin": joint.origin.tolist(),
                    "pitch": joint.pitch,
                    "values": joint.values.tolist(),
                    "limits": joint.limits,
                    "residual": joint.residual,
                    "covariance": joint.covariance,
                    "ambiguous": joint.ambiguous,
                    "alternatives": joint.alternatives,
                }
                for joint in bundle.joints
            ],
            "loops": bundle.loops,
            "provenance": bundle.provenance,
        },
    )


def _splat_paths(bundle: Bundle) -> dict[str, str]:
    """File names that every file system takes, one per part."""
    paths: dict[str, str] = {}
    for part in bundle.parts:
        stem = re.sub(r"[^A-Za-z0-9_-]+", "_", part.name) or "part"
        if f"parts/{stem}.ply".lower() in {p.lower() for p in paths.values()}:
            stem = f"{stem}_{part.id}"
        paths[part.name] = f"parts/{stem}.ply"
    return paths


def load_bundle(folder: Path) -> Bundle:
    """Read and check a bundle; float64 motions and joints, float32 Gaussians.

    Raises InputError for anything missing, malformed, out of range or inconsistent.
    """
    path = Path(folder) / ARTICULATION
    try:
        value = json.loads(path.read_text(encoding="utf-8"), parse_constant=_no_constant)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); give a folder that `splatart fit` wrote"
        ) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not JSON ({error}); run `splatart fit` again") from error

    top = _Record(value, path, "the file")
    if (form := top.text("format")) != FORMAT:
        top.fail("format", f"is '{form}'", f"this version reads '{FORMAT}'")
    states = [s for s in top.items("states") if isinstance(s, str)]
    if not states or len(set(states)) < len(top.items("states")):
        top.fail("states", f"is {top.items('states')}", "give one name per state, each another")
    parts = [_read_part(record, len(states), Path(folder)) for record in top.records("parts")]
    if not parts:
        top.fail("parts", "is empty", "a bundle has at least one part")
    names = [part.name for part in parts]
    _check_unique(top, "parts", names)
    _check_unique(top, "parts", [part.id for part in parts])
    joints = [_read_joint(record, len(states), names) for record in top.records("joints")]
    _check_unique(top, "joints", [joint.name for joint in joints])

    bundle = Bundle(
        parts=sorted(parts, key=lambda part: part.id),
        joints=joints,
        root=top.choice("root", names),
        states=states,
        length_unit=top.record("units").text("length"),
        loops=[_read_loop(record, joints, names) for record in top.records("loops")],
        provenance=top.record("provenance").fields,
    )
    if (angle := top.record("units").text("angle")) != "radian":
        top.fail("units.angle", f"is '{angle}'", "angles of a bundle are in radians")
    _check_tree(bundle, top)
    return bundle


def _read_part(record: _Record, num_states: int, folder: Path) -> Part:
    part_id = record.integer("id")
    if not 1 <= part_id < UNLABELLED:
        record.fail("id", f"is {part_id}", f"part ids are 1 to {UNLABELLED - 1}")
    name = record.text("name")
    motion = record.tensor("motion", (num_states, 4, 4))
    R = motion[:, :3, :3]
    rigid = torch.allclose(R @ R.mT, torch.eye(3, dtype=R.dtype), atol=1e-5) and bool((torch.linalg.det(R) > 0).all())
    if not rigid or not torch.equal(motion[:, 3], torch.tensor([0.0, 0, 0, 1], dtype=R.dtype).expand(num_states, 4)):
        record.fail(
            "motion", "has a matrix that is no rigid motion", "give a rotation, a translation and a row 0 0 0 1"
        )
    if not torch.allclose(motion[0], torch.eye(4, dtype=R.dtype), atol=1e-5):
        record.fail("motion", "does not begin with the identity", "the canonical frame is the world at the first state")
    covariance = torch.full((num_states, 6, 6), math.nan, dtype=torch.float64)
    rows = record.items("motion_covariance")
    if len(rows) != num_states:
        record.fail("motion_covariance", f"has {len(rows)} entries", f"give one for each of the {num_states} states")
    for state, row in enumerate(rows):
        if row is not None:
            covariance[state] = record.numbers("motion_covariance", row, (6, 6))

    splat = _read_splat(record, folder)
    if (count := record.integer("num_gaussians")) != len(splat):
        record.fail("num_gaussians", f"is {count} but the PLY holds {len(splat)}", "the files are of different runs")
    return Part(part_id, name, splat, motion, covariance)


def _read_splat(record: _Record, folder: Path) -> Splat:
    relative = record.text("splat")
    path = folder / relative
    if "\0" in relative or not path.resolve().is_relative_to(folder.resolve()):
        record.fail("splat", f"is '{relative}'", "give a path inside the bundle's folder")
    return read_ply(path)


def _read_joint(record: _Record, num_states: int, parts: list[str]) -> Joint:
    kind = record.choice("type", list(JOINT_DOFS))
    dofs = JOINT_DOFS[kind]
    parent, child = record.choice("parent", parts), record.choice("child", parts)
    if parent == child:
        record.fail("child", f"is '{child}' as is the parent", "a joint joins two parts")
    axis = record.tensor("axis", (3,))
    if abs(float(axis.norm()) - 1) > 1e-4:
        record.fail("axis", f"has the length {float(axis.norm()):g}", "give a unit vector")
    values = record.tensor("values", (num_states,) if dofs <= 1 else (num_states, dofs))
    if float(values[0].abs().max()) > 1e-6:
        record.fail("values", f"begins with {values[0].tolist()}", "the value at the first state is 0")
    limits = None
    if dofs <= 1 or record.fields.get("limits") is not None:
        low, high = record.tensor("limits", (2,)).tolist()
        limits = (low, high)
        if low > high:
            record.fail("limits", f"is [{low}, {high}]", "give the lower limit first")
    residual = record.number("residual")
    if residual < 0:
        record.fail("residual", f"is {residual}", "a distance is 0 or more")
    alternatives = [
        {"type": r.choice("type", list(JOINT_DOFS)), "residual": r.number("residual"), "score": r.number("score")}
        for r in record.records("alternatives")
    ]
    return Joint(
        name=record.text("name"),
        type=kind,
        parent=parent,
        child=child,
        axis=axis,
        origin=record.tensor("origin", (3,)),
        values=values,
        limits=limits,
        pitch=record.number("pitch"),
        in_tree=record.flag("in_tree"),
        residual=residual,
        covariance=record.record("covariance").fields,
        ambiguous=record.flag("ambiguous"),
        alternatives=alternatives,
    )


def _read_loop(record: _Record, joints: list[Joint], parts: list[str]) -> dict[str, Any]:
    joint = record.choice("joint", [joint.name for joint in joints if not joint.in_tree])
    names = record.items("parts")
    if unknown := [name for name in names if name not in parts]:
        record.fail("parts", f"names {unknown[0]!r}", f"the parts are {', '.join(parts)}")
    return {"joint": joint, "parts": names}


def _check_unique(record: _Record, key: str, values: list) -> None:
    if repeated := {v for v in values if values.count(v) > 1}:
        record.fail(key, f"has {repeated.pop()!r} twice", "names and ids must be unique")


def _check_tree(bundle: Bundle, record: _Record) -> None:
    """Every part but the root is the child of one tree joint, and the root reaches all."""
    children = [joint.child for joint in bundle.joints if joint.in_tree]
    for name in bundle.part_names:
        expected = 0 if name == bundle.root else 1
        if children.count(name) != expected:
            record.fail(
                "joints",
                f"give part '{name}' {children.count(name)} parents in the tree",
                "the root has none and every other part has one",
            )
    if len(bundle.tree_joints) != len(children):
        reached = {bundle.root, *(joint.child for joint in bundle.tree_joints)}
        lost = next(name for name in bundle.part_names if name not in reached)
        record.fail("joints", f"form a cycle that holds part '{lost}'", "every part must hang from the root")


class _Record:
    """A JSON object being read: typed access to its fields, with errors that name the place."""

    def __init__(self, value: Any, path: Path, where: str):
        self.path, self.where = path, where
        if not isinstance(value, dict):
            raise InputError(f"{path}: {where} is {_shown(value)} but must be an object; run `splatart fit` again")
        self.fields: dict[str, Any] = value

    def fail(self, key: str, found: str, mend: str) -> NoReturn:
        raise InputError(f"{self.path}: '{key}' of {self.where} {found}; {mend}")

    def _get(self, key: str, kind: type | tuple[type, ...], word: str) -> Any:
        if key not in self.fields:
            self.fail(key, "is missing", "run `splatart fit` again")
        value = self.fields[key]
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            self.fail(key, f"is {_shown(value)}", f"give {word}")
        return value

    def text(self, key: str) -> str:
        value = self._get(key, str, "a text that is not empty")
        return value or self.fail(key, "is empty", "give a text that is not empty")

    def integer(self, key: str) -> int:
        return self._get(key, int, "a whole number")

    def flag(self, key: str) -> bool:
        return self._get(key, bool, "true or false")

    def items(self, key: str) -> list:
        return self._get(key, list, "a list")

    def choice(self, key: str, known: list[str]) -> str:
        value = self._get(key, str, "a text")
        return value if value in known else self.fail(key, f"is '{value}'", f"known are {', '.join(known) or 'none'}")

    def record(self, key: str) -> _Record:
        return _Record(self._get(key, dict, "an object"), self.path, f"'{key}' of {self.where}")

    def records(self, key: str) -> list[_Record]:
        named = [(v.get("name") if isinstance(v, dict) else None, v) for v in self.items(key)]
        return [_Record(v, self.path, f"{key}[{i}]" + (f" ({n})" if n else "")) for i, (n, v) in enumerate(named)]

    def number(self, key: str) -> float:
        return float(self.numbers(key, self._get(key, (int, float), "a number"), ()))

    def tensor(self, key: str, shape: tuple[int, ...]) -> Tensor:
        return self.numbers(key, self._get(key, list, f"numbers of shape {list(shape)}"), shape)

    def numbers(self, key: str, value: Any, shape: tuple[int, ...]) -> Tensor:
        """Nested lists of exactly this shape, all finite numbers, as float64."""

        def check(v: Any, dims: tuple[int, ...]) -> None:
            if dims and isinstance(v, list) and len(v) == dims[0]:
                for item in v:
                    check(item, dims[1:])
            elif dims or isinstance(v, bool) or not isinstance(v, int | float) or not abs(v) < 1e300:
                self.fail(key, f"holds {_shown(v)}", f"give finite numbers of shape {list(shape)}")

        check(value, shape)
        return torch.tensor(value, dtype=torch.float64)


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is no number")
