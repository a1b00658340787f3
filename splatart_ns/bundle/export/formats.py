"""From a bundle to files that other programs open."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, get_args

from splatart_ns.bundle.bundle import Bundle
from splatart_ns.bundle.export.folder import export_folder
from splatart_ns.bundle.export.glb import write_glb
from splatart_ns.bundle.export.mjcf import write_mjcf
from splatart_ns.bundle.export.page import write_page
from splatart_ns.bundle.export.ply import write_whole_ply
from splatart_ns.bundle.export.robot import Robot
from splatart_ns.bundle.export.urdf import write_urdf
from splatart_ns.bundle.export.usd import write_usd
from splatart_ns.choices import Format
from splatart_ns.errors import InputError

WITHOUT_MESHES: frozenset[Format] = frozenset({"ply", "html"})
"""Formats of the Gaussians themselves."""


def export(bundle: Bundle, robot: Robot, form: Format, folder: Path) -> Path:
    """Write `robot`, which `describe` made of `bundle`, in a format; `folder` is new or an earlier export.

    Returns the file, in `folder`. Beside it are its meshes and `export.json`: names, scale, notes and all files.

    Raises:
        InputError: the folder holds what no export wrote, the format is none or its library is not installed.
    """
    if form not in get_args(Format):
        raise InputError(f"the format is {form!r}; give one of {', '.join(get_args(Format))}")
    require([form])
    with export_folder(folder, _about(robot, form)) as fresh:
        if form == "ply":
            path = write_whole_ply(bundle, robot.name, robot.scale, fresh)
        elif form == "html":
            path = write_page(bundle, robot.name, fresh)
        else:
            writers = {"urdf": write_urdf, "mjcf": write_mjcf, "usd": write_usd, "glb": write_glb}
            path = writers[form](robot, fresh)
    return Path(folder) / path.name


def require(formats: Iterable[Format]) -> None:
    """Raise InputError where a library that writes one of the formats is not installed."""
    if "usd" in formats and importlib.util.find_spec("pxr") is None:
        raise InputError("--format usd needs usd-core; install it with: pip install usd-core")


def format_notes(robot: Robot, form: Format) -> list[str]:
    """What a format cannot say of this robot, a sentence each."""
    notes = []
    for loop in robot.loops:
        if form == "urdf":
            notes.append(f"Joint '{loop.name}' closes a loop, which URDF does not have: left out.")
        elif form == "glb":
            notes.append(f"Joint '{loop.name}' closes a loop, which GLB does not have: left out.")
        elif form == "usd" and loop.type == "screw":
            notes.append(
                f"Joint '{loop.name}' closes a loop and is a screw, which UsdPhysics cannot say: in the file it turns "
                "and slides freely."
            )
        elif loop.type == "free":
            notes.append(f"Joint '{loop.name}' closes a loop and is free, which holds nothing: left out.")
    if form == "usd":
        for f in robot.freedoms:
            if f.mimic is not None:
                notes.append(
                    f"'{f.name}' follows '{f.mimic[0]}', which UsdPhysics cannot say: both are free in the file."
                )
    return notes


def _about(robot: Robot, form: Format) -> Mapping[str, Any]:
    if form == "html":  # has the bundle's own names and units
        return {"of": form}
    about = {
        "of": form,
        "metres_per_unit": robot.scale,
        "links": {link.part: link.name for link in robot.links.values()},
        "joints": {j.source: [f.name for f in j.freedoms] for j in robot.joints if j.source is not None},
    }
    if form not in WITHOUT_MESHES:
        about["mass"] = {link.name: link.inertia.mass for link in robot.links.values()}
        about["overlapping_at_rest"] = [{"links": list(pair), "depth": d} for pair, d in robot.overlaps.items()]
    return about | {"notes": [*robot.notes, *format_notes(robot, form)]}
