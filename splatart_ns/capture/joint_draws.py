"""Joint values drawn at random, at which parts do not reach into each other."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping

import numpy as np

from splatart_ns.capture.crossings import Crossings
from splatart_ns.capture.robot import Joint, Robot
from splatart_ns.capture.surface import Surface
from splatart_ns.errors import InputError

_log = logging.getLogger(__name__)

_TURN = 1.75
"""Radian: joints that turn further than this are moved within a window of it, so that states have views in common."""
_TRIES = 40
"""Draws for each part."""


def draw_configurations(
    robot: Robot, frozen: Mapping[str, float], surfaces: Mapping[str, Surface], states: int, seed: int
) -> list[dict[str, float]]:
    """The values of all movable joints for each state; every joint that is not held moves, if its limits let it.

    Part by part, from the root on, joints are drawn again while parts so far reach into each other, in a state or half
    way between the first two: the part's own, then also those above it, one more each time. Where `_TRIES` draws do not
    help, what leaves fewest such pairs is kept.

    Args:
        surfaces: part name to its surface in its own frame, of the parts that have a shape.

    Raises:
        InputError: a sliding joint without limits.
    """
    free = {j.name: j for j in robot.movable if j.name not in frozen and j.mimic is None}
    for name, joint in free.items():
        if joint.limits is not None and joint.limits[0] == joint.limits[1]:
            found = f"joint {name!r} has limits {joint.limits[0]:g} to {joint.limits[1]:g} and does not move"
            mend = f"correct its <limit>, or make its links one part by --freeze {name}={joint.limits[0]:g}"
            _log.warning("%s: %s; %s", robot.path, found, mend)
    rng, again = (np.random.default_rng([seed, stream]) for stream in (0, 3))
    drawn = {name: _spread_values(joint, robot, states, rng) for name, joint in free.items()}

    def configurations() -> list[dict[str, float]]:
        return [robot.complete({**{n: float(v[k]) for n, v in drawn.items()}, **frozen}) for k in range(states)]

    crossings, placed = Crossings(robot, frozen, surfaces), []

    def count() -> int:
        found = configurations()
        return sum(len(crossings.pairs(values, placed)) for values in (*found, robot.halfway(*found[:2])))

    leaders = {j.name: j.mimic.joint for j in robot.movable if j.mimic is not None}
    above: dict[str | None, list[str]] = {None: []}
    """Part to the joints that place it, from its own to the root's."""
    for part, (parent, joints) in robot.hinges(frozen).items():
        placed.append(part)
        names = (_leader(j.name, leaders) for j in joints)
        above[part] = [n for n in names if n in free] + above[parent]
        fewest = count()
        for attempt in range(_TRIES if above[part] else 0):
            if fewest == 0:
                break
            before = dict(drawn)
            for name in above[part][: 1 + attempt % len(above[part])]:
                drawn[name] = _spread_values(free[name], robot, states, again)
            crossing = count()
            if crossing < fewest:
                fewest = crossing
            else:
                drawn = before
    return configurations()


def _leader(joint: str, leaders: Mapping[str, str]) -> str:
    """The joint that it mimics in the end, or itself."""
    while joint in leaders:
        joint = leaders[joint]
    return joint


def _spread_values(joint: Joint, robot: Robot, count: int, rng: np.random.Generator) -> np.ndarray:
    """Values within the limits, one in the middle of each of `count` equal ranges, shuffled: each state moves it."""
    turns = joint.type != "prismatic"
    if joint.limits is None and not turns:
        raise InputError(f"{robot.path}: joint {joint.name!r} has no limits; add a <limit>, or give joint values.")
    low, high = joint.limits or (-math.pi, math.pi)
    if turns and high - low > _TURN:
        middle = rng.uniform(low + 0.5 * _TURN, high - 0.5 * _TURN)
        low, high = middle - 0.5 * _TURN, middle + 0.5 * _TURN
    places = (rng.permutation(count) + rng.uniform(0.3, 0.7, count)) / count
    digits = 4 if high - low > 1e-2 else 3 - math.floor(math.log10(max(high - low, 1e-12)))
    return np.round(low + (high - low) * places, digits).clip(low, high)
