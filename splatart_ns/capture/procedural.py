"""Articulated objects made by code, by name: a few built-in ones and any number of random ones. Nothing to download."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from splatart_ns.capture.articulated_object import ArticulatedObject, Joint, Link
from splatart_ns.capture.random_objects import MOST_PARTS, random_joint_values, random_object
from splatart_ns.capture.shapes import blocks, drum, rounded_box
from splatart_ns.capture.synthesis import synthesize
from splatart_ns.capture.synthesis_options import OBJECTS, SynthesisOptions
from splatart_ns.errors import InputError

_BLUES = ((32, 62, 120), (92, 148, 205), (218, 228, 236), (245, 190, 40))
_REDS = ((128, 30, 34), (222, 96, 60), (246, 214, 168), (24, 44, 70))
_GREENS = ((24, 78, 58), (104, 168, 96), (226, 232, 190), (196, 42, 88))
_GREYS = ((46, 50, 58), (128, 134, 140), (226, 224, 216), (232, 112, 28))


def _hinge() -> ArticulatedObject:
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
    return ArticulatedObject(
        name="hinge",
        links=(Link("base", base, _GREYS, (7, 0, 5)), Link("lid", lid, _BLUES, (7, 1, 5))),
        joints=(Joint("lid_joint", "revolute", "base", "lid", (-0.113, 0.0, 0.050), (0, -1, 0), (0.0, 2.3)),),
        grain=0.022,
    )


def _drawer() -> ArticulatedObject:
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
    return ArticulatedObject(
        name="drawer",
        links=(Link("body", body, _GREENS, (7, 0, 6)), Link("drawer", drawer, _REDS, (7, 1, 6))),
        joints=(Joint("drawer_joint", "prismatic", "body", "drawer", (0.0, 0.0, 0.189), (1, 0, 0), (0.0, 0.24)),),
        grain=0.028,
    )


def _arm() -> ArticulatedObject:
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
    return ArticulatedObject(
        name="arm",
        links=(
            Link("base", base, _GREYS, (7, 0, 3)),
            Link("turret", turret, _BLUES, (7, 1, 3)),
            Link("upper_arm", upper, _REDS, (7, 2, 3)),
            Link("forearm", fore, _GREENS, (7, 3, 3)),
        ),
        joints=(
            Joint("yaw", "revolute", "base", "turret", (0.0, 0.0, 0.11), (0, 0, 1), (-2.6, 2.6)),
            Joint("shoulder", "revolute", "turret", "upper_arm", (0.0, 0.0, 0.125), (0, 1, 0), (-1.2, 1.5)),
            Joint("elbow", "revolute", "upper_arm", "forearm", (0.0, 0.0, 0.22), (0, 1, 0), (0.0, 2.4)),
        ),
        grain=0.025,
    )


_BUILDERS: dict[str, Callable[[], ArticulatedObject]] = dict(zip(OBJECTS, (_hinge, _drawer, _arm), strict=True))

_STATES = {
    "hinge": ("lid_joint=0.5", "lid_joint=1.7"),
    "drawer": ("drawer_joint=0.05", "drawer_joint=0.2"),
    "arm": ("yaw=-0.4,shoulder=0.1,elbow=1.5", "yaw=0.5,shoulder=0.7,elbow=0.7"),
}
"""Joint values of the two states that a built-in object is usually shown in."""


def is_object_name(text: str) -> bool:
    """Whether a text means an object made by code (perhaps misspelt) and not a file."""
    return text in OBJECTS or re.fullmatch(r"random(-[^./\\]*)?", text) is not None


def synthesize_object(name: str, output_dir: Path, options: SynthesisOptions | None = None) -> Path:
    """`synthesize` an object made by code, in states of its own unless joint values are given.

    A built-in object has two such states, a random one any number (drawn by its seed, no part inside another).

    Raises:
        InputError: as `synthesize`; or there is no such object.
    """
    options = options or SynthesisOptions()
    made = build_object(name)
    if not options.joint_values and not options.freeze:
        own = _STATES[name] if name in OBJECTS else random_joint_values(made, options.states, _seed(name)[0])
        if len(own) == options.states:
            options = replace(options, joint_values=own)
    with tempfile.TemporaryDirectory() as folder:
        return synthesize(made.write(Path(folder)), output_dir, options)


def build_object(name: str) -> ArticulatedObject:
    """One of `OBJECTS`, or random-SEED or random-SEED-PARTS.

    Raises:
        InputError: there is no such object.
    """
    if name in _BUILDERS:
        return _BUILDERS[name]()
    if not is_object_name(name):
        known = ", ".join(OBJECTS)
        raise InputError(f"There is no built-in object {name!r}; take one of: {known}, or random-SEED.")
    return random_object(*_seed(name))


def _seed(name: str) -> tuple[int, int | None]:
    """Seed and number of parts (None: any) in a random object's name."""
    found = re.fullmatch(r"random-([0-9]{1,9})(?:-([0-9]{1,3}))?", name)
    parts = None if found is None or found[2] is None else int(found[2])
    if found is None or (parts is not None and not 2 <= parts <= MOST_PARTS):
        form = f"random-SEED or random-SEED-PARTS with 2 to {MOST_PARTS} parts"
        raise InputError(f"The object {name!r} is not of the form {form}; write for example random-17 or random-17-6.")
    return int(found[1]), parts
