"""Random articulated objects: of a family, a number of parts and proportions that a seed chooses."""

from __future__ import annotations

import colorsys
import math

import numpy as np

from splatart_ns.capture.articulated_object import ArticulatedObject, Joint, Link
from splatart_ns.capture.assembly import Assembly, turn, turned
from splatart_ns.capture.families import FAMILIES
from splatart_ns.capture.interpenetration import Interpenetration
from splatart_ns.capture.textures import Colour
from splatart_ns.errors import InputError

MOST_PARTS = max(n for family in FAMILIES.values() for n in family.parts)

_LEAST_TURN = math.radians(15.0)
_SLIDE = (0.2, 0.9)
"""Shares of a slide's length that it moves from one state to the next, at least and at most."""
_TRIES = 400
"""Configurations that are drawn for each state, before it is given up."""


def random_object(seed: int, parts: int | None = None) -> ArticulatedObject:
    """An object of a family, proportions, size and heading that the seed chooses; named after family and seed.

    Args:
        parts: 2 to `MOST_PARTS`; the seed chooses if None.
    """
    rng = np.random.default_rng([seed, parts or 0])
    names = [name for name, family in FAMILIES.items() if parts is None or parts in family.parts]
    # Families of many sizes come more often, or most objects would have two parts.
    weights = np.sqrt([len(FAMILIES[name].parts) for name in names])
    name = str(rng.choice(names, p=weights / weights.sum()))
    family = FAMILIES[name]
    count = int(rng.choice(family.parts)) if parts is None else parts
    while True:
        assembly = family.build(rng, count)
        scale = math.exp(rng.uniform(math.log(0.2), math.log(2.0)))
        object = _finished(f"{name}-{seed}", assembly, scale, turn(2, rng.uniform(0.0, 2.0 * math.pi)), rng)
        if _can_stand(object, rng):
            return object


def _can_stand(object: ArticulatedObject, rng: np.random.Generator) -> bool:
    """Whether it has configurations without interpenetration; a few of an arm's proportions leave none."""
    interpenetration = Interpenetration(object)
    drawn = ({j.name: _moved(j, None, rng) for j in object.joints} for _ in range(40))
    return any(not interpenetration.is_gross(values) for values in drawn)


def random_joint_values(object: ArticulatedObject, states: int, seed: int) -> tuple[str, ...]:
    """Joint values "a=1,b=2" of each state: all joints move from state to state, no part reaches into another one.

    Turns are of 15 degrees or more, slides of 20 to 90 % of their length. The configuration half way between the first
    two states is free of interpenetration too, as it is rendered for evaluation.

    Raises:
        InputError: no such configuration is found.
    """
    rng = np.random.default_rng([seed, 1])
    interpenetration = Interpenetration(object)
    chosen: list[dict[str, float]] = []
    for _ in range(_TRIES * states):
        values = {j.name: _moved(j, chosen[-1][j.name] if chosen else None, rng) for j in object.joints}
        tried = [values]
        if len(chosen) == 1:
            tried.append({name: 0.5 * (v + chosen[0][name]) for name, v in values.items()})
        if any(interpenetration.is_gross(v) for v in tried):
            continue
        chosen.append(values)
        if len(chosen) == states:
            return tuple(",".join(f"{name}={v:.9g}" for name, v in values.items()) for values in chosen)
    raise InputError(f"The object {object.name} has no {states} states without interpenetration; take another seed.")


def _moved(joint: Joint, previous: float | None, rng: np.random.Generator) -> float:
    """A value within the joint's limits, a noticeable way from the previous one."""
    low, high = joint.limits
    least, most = _LEAST_TURN, high - low
    if joint.type == "prismatic":
        least, most = (share * (high - low) for share in _SLIDE)
    while True:
        value = rng.uniform(low, high)
        if previous is None or least <= abs(value - previous) <= most:
            return float(np.clip(round(value, 6), low, high))


def _finished(
    name: str, assembly: Assembly, scale: float, R: np.ndarray, rng: np.random.Generator
) -> ArticulatedObject:
    """The assembly in its size and heading, with textures."""
    looks = sorted(set(assembly.looks.values()))
    palettes = {look: _palette(rng) for look in looks}
    seeds = {look: (7, int(rng.integers(2**31))) for look in looks}
    links = tuple(
        Link(part, [turned(s, scale * R) for s in solids], palettes[assembly.looks[part]], seeds[assembly.looks[part]])
        for part, solids in assembly.solids.items()
    )
    joints = tuple(_placed(j, scale, R) for j in assembly.joints)
    return ArticulatedObject(name, links, joints, grain=scale * rng.uniform(0.04, 0.07))


def _placed(joint: Joint, scale: float, R: np.ndarray) -> Joint:
    limits = joint.limits if joint.type == "revolute" else tuple(scale * x for x in joint.limits)
    origin, axis = scale * (R @ joint.origin), R @ joint.axis
    limits = tuple(float(f"{x:g}") for x in limits)
    return Joint(joint.name, joint.type, joint.parent, joint.child, tuple(origin), tuple(axis), limits)


def _palette(rng: np.random.Generator) -> tuple[Colour, ...]:
    """A dark, a middle and a light colour of about one hue, and one across for the marks."""
    hue = rng.random()

    def colour(turn: float, saturation: float, value: float) -> Colour:
        r, g, b = colorsys.hsv_to_rgb((hue + turn) % 1.0, saturation, value)
        return round(255 * r), round(255 * g), round(255 * b)

    saturation = rng.uniform(0.3, 0.8)
    return (
        colour(rng.uniform(-0.08, 0.08), saturation, rng.uniform(0.2, 0.4)),
        colour(rng.uniform(-0.08, 0.08), 0.8 * saturation, rng.uniform(0.55, 0.75)),
        colour(rng.uniform(-0.08, 0.08), 0.25 * saturation, rng.uniform(0.88, 0.97)),
        colour(rng.uniform(0.35, 0.65), rng.uniform(0.7, 0.9), rng.uniform(0.6, 0.95)),
    )
