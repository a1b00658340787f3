"""Joints of the bundle as chains of turns and slides, which every robot format has, and their values in both ways.

A screw is a turn, and a slide that follows it; a cylindrical joint a slide and a turn; a spherical joint turns about x,
then y, then z of the moving frame; a free one slides along x, y, z and then turns so.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from splatart_ns.bundle.bundle import Joint
from splatart_ns.bundle.export.robot import Freedom
from splatart_ns.bundle.posing import JointValue, joint_motion
from splatart_ns.geometry.se3 import se3_log

STILL = 1e-6
"""Radian or metre: a joint whose observed range is less did not move."""

_EULER = "XYZ"  # intrinsic
_TYPES = {
    "fixed": (),
    "revolute": (("", "revolute"),),
    "prismatic": (("", "prismatic"),),
    "screw": (("turn", "revolute"), ("slide", "prismatic")),
    "cylindrical": (("slide", "prismatic"), ("turn", "revolute")),
    "spherical": tuple((f"turn_{a}", "revolute") for a in "xyz"),
    "free": (*((f"slide_{a}", "prismatic") for a in "xyz"), *((f"turn_{a}", "revolute") for a in "xyz")),
}
"""The suffix and type of each freedom of a joint type."""


def freedom_names(joint: Joint) -> list[str]:
    """A name for each freedom: the joint's own if there is one."""
    return [f"{joint.name}_{suffix}" if suffix else joint.name for suffix, _ in _TYPES[joint.type]]


def freedoms(joint: Joint, names: Sequence[str], scale: float, margin: float) -> tuple[Freedom, ...]:
    """The freedoms of a joint, called `names`; none if it did not move.

    Limits are the joint's range, `margin` times its width wider at both ends. `scale` is metres per unit.
    """
    own = _axes(joint)
    ranges = _ranges(joint, scale)
    if all(high - low < STILL for low, high in ranges):
        return ()
    chain: list[Freedom] = []
    for name, (_, kind), axis, (low, high) in zip(names, _TYPES[joint.type], own, ranges, strict=True):
        wider = max(margin * (high - low), STILL if high - low < STILL else 0.0)
        mimic = (chain[0].name, joint.pitch * scale) if joint.type == "screw" and chain else None
        chain.append(Freedom(name, kind, axis, (low - wider, high + wider), mimic))
    return tuple(chain)


def joint_value(joint: Joint, numbers: Sequence[float], scale: float) -> JointValue:
    """The bundle's value of a joint at the values of its freedoms, radian or metre."""
    match joint.type:
        case "revolute" | "screw":
            return float(numbers[0])
        case "prismatic":
            return numbers[0] / scale
        case "cylindrical":
            return [numbers[0] / scale, numbers[1]]
        case "spherical":
            return Rotation.from_euler(_EULER, numbers).as_rotvec().tolist()
        case "free":
            T = torch.eye(4, dtype=torch.float64)
            R = Rotation.from_euler(_EULER, numbers[3:]).as_matrix()
            origin = joint.origin.numpy()
            T[:3, :3] = torch.from_numpy(R)
            T[:3, 3] = torch.from_numpy(origin + np.asarray(numbers[:3]) / scale - R @ origin)
            return se3_log(T)
        case _:
            return 0.0


def freedom_values(joint: Joint, value: JointValue, scale: float) -> list[float]:
    """The values of a joint's freedoms at a value of the bundle: the inverse of `joint_value`."""
    value = torch.as_tensor(value, dtype=torch.float64).numpy()
    match joint.type:
        case "revolute":
            return [float(value)]
        case "prismatic":
            return [float(value) * scale]
        case "screw":
            return [float(value), float(value) * joint.pitch * scale]
        case "cylindrical":
            return [value[0] * scale, value[1]]
        case "spherical":
            return _euler(Rotation.from_rotvec(value))
        case "free":
            T = joint_motion(joint, value).numpy()
            origin = joint.origin.numpy()
            slides = scale * (T[:3, :3] @ origin + T[:3, 3] - origin)
            return [*slides, *_euler(Rotation.from_matrix(T[:3, :3]))]
        case _:
            return []


def _euler(turn: Rotation) -> list[float]:
    """Where the second angle is a right one, the third is 0."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Gimbal lock")
        return turn.as_euler(_EULER).tolist()


def _axes(joint: Joint) -> list[np.ndarray]:
    if joint.type in ("spherical", "free"):
        return [np.eye(3)[i % 3] for i in range(len(_TYPES[joint.type]))]
    axis = joint.axis.double().numpy()
    return [axis / np.linalg.norm(axis)] * len(_TYPES[joint.type])


def _ranges(joint: Joint, scale: float) -> list[tuple[float, float]]:
    """The range of each freedom, which holds 0, where state 0 is: `Joint.ranges`, or of several what was observed."""
    ends = joint.ranges[0] if joint.values.ndim == 1 else joint.values
    numbers = np.array([freedom_values(joint, value, scale) for value in ends] + [[0.0] * len(_TYPES[joint.type])])
    return list(zip(numbers.min(0).tolist(), numbers.max(0).tolist(), strict=True))
