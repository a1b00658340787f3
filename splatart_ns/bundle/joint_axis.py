"""Where joints' axes are drawn, and how certain they are."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from splatart_ns.bundle.bundle import JOINT_DOFS, Joint

_MARGIN = 0.2
"""How far a drawn axis sticks out of the child at both ends, in radii of the object."""
_WITH_LINE = ("revolute", "prismatic", "screw", "cylindrical")


@dataclass(frozen=True)
class AxisLine:
    """A piece of a joint's axis past its child, canonical frame, length."""

    axis: np.ndarray
    """Unit vector [3]."""
    origin: np.ndarray
    """A point of the line [3]."""
    low: float
    """Where the piece begins along the axis, from the origin; and where it ends."""
    high: float

    def points(self, along: np.ndarray) -> np.ndarray:
        """Places [K, 3] on the line at distances `along` [K] from the origin."""
        return self.origin + along[:, None] * self.axis


def axis_line(joint: Joint, points: np.ndarray, radius: float) -> AxisLine | None:
    """The piece of the axis past the child's `points` [N, 3], canonical frame; None for joints without an axis.

    `radius` is the object's, length.
    """
    if joint.type not in _WITH_LINE:
        return None
    axis, origin = joint.axis.numpy(), joint.origin.numpy()
    if len(points) == 0:
        points = origin[None]
    if joint.type == "prismatic":  # its axis has a direction only, so it is drawn through the child
        origin = np.median(points, axis=0)
    low, high = np.quantile((points - origin) @ axis, [0.02, 0.98]) + _MARGIN * radius * np.array([-1, 1])
    return AxisLine(axis, origin, float(low), float(high))


def axis_deviation(joint: Joint, along: np.ndarray) -> np.ndarray:
    """Standard deviation [K], length, of the axis at the places `origin + along * axis`, in the worst direction.

    The covariance of such a place is C_oo + s (C_ao + C_ao^T) + s^2 C_aa. Blocks that the bundle lacks count as 0.
    """
    aa, oo, ao = (
        np.zeros((3, 3)) if (block := joint.covariance.get(name)) is None else np.array(block)
        for name in ("axis", "origin", "axis_origin")
    )
    s = along[:, None, None]
    return np.sqrt(np.linalg.eigvalsh(oo + s * (ao + ao.T) + s**2 * aa)[:, -1].clip(0))


def direction_deviation(joint: Joint) -> float | None:
    """Standard deviation of the axis's direction in the worst direction, radian; None where undetermined."""
    return _worst(joint, "axis")


def place_deviation(joint: Joint) -> float | None:
    """Standard deviation of the axis's origin in the worst direction, length; None where undetermined."""
    return _worst(joint, "origin")


def value_deviations(joint: Joint) -> list[float] | None:
    """Standard deviation of each of the joint's numbers at the worst state; None where undetermined."""
    block = joint.covariance.get("values")
    if block is None or JOINT_DOFS[joint.type] == 0:
        return None
    variances = np.diag(np.array(block, float)).reshape(len(joint.values), -1).max(0)
    return np.sqrt(variances.clip(0)).tolist() if np.isfinite(variances).all() else None


def _worst(joint: Joint, name: str) -> float | None:
    block = joint.covariance.get(name)
    return None if block is None else math.sqrt(max(np.linalg.eigvalsh(np.array(block))[-1], 0.0))
