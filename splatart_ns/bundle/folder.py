"""The bundle on disk: `articulation.json` and one PLY per part."""

from __future__ import annotations

import math
import os
import re
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from splatart_ns.bundle.bundle import JOINT_DOFS, Bundle, Joint, Part
from splatart_ns.capture.capture import UNLABELLED
from splatart_ns.files import write_json
from splatart_ns.records import Record, read_record
from splatart_ns.splats.ply import read_ply, write_ply
from splatart_ns.splats.splat import Splat

FORMAT = "splatart-articulation-1"
ARTICULATION = "articulation.json"
METRICS = "metrics.json"
"""What `splatart eval` writes beside it."""
_VARIANCE = 1e300
"""Below which variances are: of what is hardly determined they are large."""
_AT_ZERO = 1e-6
"""Radian or length: how far from 0 a value at the first state may be, and limits about it, by rounding."""


def save_bundle(bundle: Bundle, folder: Path) -> None:
    """Write the parts' PLYs and then `articulation.json`, each to a temporary name first.

    PLYs of parts that an earlier bundle in the folder had are removed.
    """
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
    for stale in set((folder / "parts").glob("*.ply")) - {folder / path for path in splats.values()}:
        stale.unlink()


def remove_bundle(folder: Path) -> None:
    """Remove what `save_bundle` has written into `folder`, and the metrics of it."""
    for path in (folder / ARTICULATION, folder / METRICS, *(folder / "parts").glob("*.ply")):
        path.unlink(missing_ok=True)
    with suppress(OSError):  # other files are in it, or it is not there
        (folder / "parts").rmdir()


def _splat_paths(bundle: Bundle) -> dict[str, str]:
    """File names that every file system takes, one per part."""
    paths: dict[str, str] = {}
    for part in bundle.parts:
        stem = re.sub(r"[^A-Za-z0-9_-]+", "_", part.name) or "part"
        while f"parts/{stem}.ply".lower() in {p.lower() for p in paths.values()}:
            stem = f"{stem}_{part.id}"
        paths[part.name] = f"parts/{stem}.ply"
    return paths


def load_bundle(folder: Path) -> Bundle:
    """Read and check a bundle; float64 motions and joints, float32 Gaussians.

    Raises InputError for anything missing, malformed, out of range or inconsistent.
    """
    path = Path(folder) / ARTICULATION
    top = read_record(path, "give the folder of a bundle")
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
    closing = [joint.name for joint in joints if not joint.in_tree]

    provenance = top.record("provenance")
    if "worlds" in provenance.fields:
        provenance.similarities("worlds", len(states))
    if "cameras" in provenance.fields:
        of_states = provenance.items("cameras")
        if len(of_states) != len(states):
            provenance.fail(
                "cameras", f"has {len(of_states)} entries", f"give one for each of the {len(states)} states"
            )
        for points in of_states:
            provenance.numbers("cameras", points, (len(points) if isinstance(points, list) else 1, 3))
    bundle = Bundle(
        parts=sorted(parts, key=lambda part: part.id),
        joints=joints,
        root=top.choice("root", names),
        states=states,
        length_unit=top.record("units").text("length"),
        loops=[_read_loop(record, closing, names) for record in top.records("loops")],
        provenance=provenance.fields,
    )
    if (angle := top.record("units").text("angle")) != "radian":
        top.fail("units.angle", f"is '{angle}'", "angles of a bundle are in radians")
    _check_tree(bundle, top)
    return bundle


def _read_part(record: Record, num_states: int, folder: Path) -> Part:
    part_id = record.integer("id")
    if not 1 <= part_id < UNLABELLED:
        record.fail("id", f"is {part_id}", f"part ids are 1 to {UNLABELLED - 1}")
    name = record.text("name")
    motion = record.motions("motion", record.items("motion"), num_states)
    if not torch.allclose(motion[0], torch.eye(4).to(motion), atol=1e-5):
        record.fail("motion", "does not begin with the identity", "the canonical frame is the world at the first state")
    covariance = torch.full((num_states, 6, 6), math.nan, dtype=torch.float64)
    rows = record.items("motion_covariance")
    if len(rows) != num_states:
        record.fail("motion_covariance", f"has {len(rows)} entries", f"give one for each of the {num_states} states")
    for state, row in enumerate(rows):
        if row is not None:
            covariance[state] = record.numbers("motion_covariance", row, (6, 6), _VARIANCE)

    splat = _read_splat(record, folder)
    if (count := record.integer("num_gaussians")) != len(splat):
        record.fail("num_gaussians", f"is {count} but the PLY holds {len(splat)}", "the files are of different runs")
    return Part(part_id, name, splat, motion, covariance)


def _read_splat(record: Record, folder: Path) -> Splat:
    relative = record.text("splat")
    path = folder / relative
    try:
        inside = Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))
    except (OSError, ValueError):  # too long, or with a null byte
        inside = False
    if not inside:
        record.fail("splat", f"is {relative!r}", "give a path inside the bundle's folder")
    return read_ply(path)


def _read_joint(record: Record, num_states: int, parts: list[str]) -> Joint:
    kind = record.choice("type", list(JOINT_DOFS))
    dofs = JOINT_DOFS[kind]
    parent, child = record.choice("parent", parts), record.choice("child", parts)
    if parent == child:
        record.fail("child", f"is '{child}' as is the parent", "a joint joins two parts")
    axis = record.tensor("axis", (3,))
    if abs(float(axis.norm()) - 1) > 1e-4:
        record.fail("axis", f"has the length {float(axis.norm()):g}", "give a unit vector")
    values = record.tensor("values", (num_states,) if dofs <= 1 else (num_states, dofs))
    if float(values[0].abs().max()) > _AT_ZERO:
        record.fail("values", f"begins with {values[0].tolist()}", "the value at the first state is 0")
    limits = None
    if dofs <= 1:
        low, high = record.tensor("limits", (2,)).tolist()
        limits = (low, high)
        if low > high:
            record.fail("limits", f"is [{low}, {high}]", "give the lower limit first")
        if low > _AT_ZERO or high < -_AT_ZERO:
            record.fail("limits", f"is [{low}, {high}]", "give a range that holds 0, the value at the first state")
    elif (given := record.fields.get("limits")) is not None:
        record.fail("limits", f"is {given}, but a {kind} joint has {dofs} values", "give null")
    residual = record.number("residual")
    if residual < 0:
        record.fail("residual", f"is {residual}", "a distance is 0 or more")
    alternatives = [_read_alternative(r, parts) for r in record.records("alternatives")]
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
        covariance=_read_covariance(record.record("covariance"), num_states * max(dofs, 1)),
        ambiguous=record.flag("ambiguous"),
        alternatives=alternatives,
    )


def _read_alternative(record: Record, parts: list[str]) -> dict[str, Any]:
    return {
        "type": record.choice("type", list(JOINT_DOFS)),
        "residual": record.number("residual"),
        "score": record.number("score"),
        **({"parent": record.choice("parent", parts)} if "parent" in record.fields else {}),
    }


def _read_covariance(record: Record, num_values: int) -> dict[str, Any]:
    shapes = {"axis": (3, 3), "origin": (3, 3), "axis_origin": (3, 3), "values": (num_values, num_values)}
    for name, block in record.fields.items():
        if name not in shapes:
            record.fail(name, "is unknown", f"known are {', '.join(shapes)}")
        if block is not None:
            record.numbers(name, block, shapes[name], _VARIANCE)
    return record.fields


def _read_loop(record: Record, closing: list[str], parts: list[str]) -> dict[str, Any]:
    joint = record.choice("joint", closing)
    names = record.items("parts")
    if unknown := [name for name in names if name not in parts]:
        record.fail("parts", f"names {unknown[0]!r}", f"the parts are {', '.join(parts)}")
    return {"joint": joint, "parts": names}


def _check_unique(record: Record, key: str, values: list) -> None:
    if repeated := [v for v, count in Counter(values).items() if count > 1]:
        record.fail(key, f"has {repeated[0]!r} twice", "names and ids must be unique")


def _check_tree(bundle: Bundle, record: Record) -> None:
    """No part has two parents, the root has none, and every tree joint hangs from the root. A name means one joint."""
    children = Counter(joint.child for joint in bundle.joints if joint.in_tree)
    for name in bundle.part_names:
        most = 0 if name == bundle.root else 1
        if children[name] > most:
            found = f"give part '{name}' {children[name]} parents in the tree"
            record.fail("joints", found, "the root has none and every other part at most one")
    movers = {joint.child: joint for joint in bundle.joints if joint.in_tree}
    for joint in movers.values():
        if (other := movers.get(joint.name, joint)) is not joint:
            found = f"call joint '{joint.name}' as the part that joint '{other.name}' moves"
            record.fail("joints", found, "give the joint another name: a joint goes by its name or by its part's")
    hanging = {joint.child for joint in bundle.tree_joints}
    if lost := [name for name in children if name not in hanging]:
        record.fail(
            "joints", f"leave part '{lost[0]}' without a way to the root", "tree joints must hang from the root"
        )
