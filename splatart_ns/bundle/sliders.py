"""Joint values as people set them: a slider for each degree of freedom, in degrees or the bundle's length unit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from splatart_ns.bundle.bundle import JOINT_DOFS, JOINT_LENGTHS, Bundle
from splatart_ns.bundle.configurations import Configuration, movable_joints

_TURNS = " turn x", " turn y", " turn z"
_SEVERAL = {"cylindrical": (" slide", " turn"), "spherical": _TURNS, "free": (" x", " y", " z", *_TURNS)}


def freedoms(joint_type: str) -> tuple[tuple[str, bool], ...]:
    """For each degree of freedom, in the order of a joint's values: what its slider is called besides the joint, and
    whether the value is an angle."""
    names = _SEVERAL.get(joint_type, ("",) * JOINT_DOFS[joint_type])
    return tuple((name, index >= JOINT_LENGTHS.get(joint_type, 0)) for index, name in enumerate(names))


def unit_name(turns: bool, length_unit: str) -> str:
    """What the numbers of a slider are."""
    return "degree" if turns else "length" if length_unit == "unknown" else length_unit


def slider_range(low: float, high: float) -> tuple[float, float, float]:
    """Ends and step of a slider for a range from `low` to `high`: half as much more on both sides, and a step of 1,
    0.1, 0.01, ... that makes hundreds of places."""
    beyond = max(0.5 * (high - low), 1e-3)
    decimals = 2 - math.floor(math.log10(high - low + 2 * beyond))
    step = 10.0**-decimals
    return (
        round(math.floor((low - beyond) / step) * step, decimals),
        round(math.ceil((high + beyond) / step) * step, decimals),
        step,
    )


@dataclass(frozen=True)
class Slider:
    """One degree of freedom of a bundle's joint; `low`, `high`, `step` and `ends` are in `unit`."""

    joint: str
    freedom: int
    """The place of its number among the joint's values."""
    label: str
    unit: str
    """"degree", or the bundle's length unit, or "length" where that is unknown."""
    low: float
    high: float
    step: float
    ends: tuple[float, float]
    """Of the joint's `ranges`."""

    @property
    def note(self) -> str:
        """What is known of the range."""
        if self.unit == "degree" and np.allclose(self.ends, (-180, 180)):
            return "nothing tells how far it turned"
        return f"range {' to '.join(f'{x:.4g}' for x in sorted(set(self.ends)))} {self.unit}"

    @property
    def units(self) -> float:
        """What a value of the bundle (radian or length) is multiplied by."""
        return math.degrees(1) if self.unit == "degree" else 1.0


def bundle_sliders(bundle: Bundle) -> list[Slider]:
    """The sliders of all movable joints of the tree, parents before children."""
    sliders = []
    for name, joint in movable_joints(bundle).items():
        for index, ((suffix, turns), ends) in enumerate(zip(freedoms(joint.type), joint.ranges, strict=True)):
            unit = unit_name(turns, bundle.length_unit)
            low, high = (end * (math.degrees(1) if turns else 1.0) for end in ends)
            sliders.append(Slider(name, index, f"{name}{suffix} ({unit})", unit, *slider_range(low, high), (low, high)))
    return sliders


def configuration(sliders: Sequence[Slider], positions: Sequence[float]) -> Configuration:
    """The configuration of the bundle, radians and lengths, at the sliders' positions."""
    values: dict[str, list[float]] = {}
    for slider, position in zip(sliders, positions, strict=True):
        values.setdefault(slider.joint, []).append(position / slider.units)
    return {name: several if len(several) > 1 else several[0] for name, several in values.items()}


def positions(sliders: Sequence[Slider], q: Mapping[str, float | Sequence[float]]) -> list[float]:
    """The inverse of `configuration`, where joints that `q` does not name are at 0."""
    return [float(np.ravel(q[s.joint])[s.freedom]) * s.units if s.joint in q else 0.0 for s in sliders]
