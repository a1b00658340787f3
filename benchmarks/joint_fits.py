"""Joints from exact motions, over the whole range of travels: how near the fit comes to what float64 allows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from splatart_ns.stages.joint import fit_joint
from splatart_ns.stages.joint_parameters import joint_motion

TRAVELS = (1e-9, 1e-6, 1e-4, 1e-2, 0.1, 0.5, 1.0, 2.0, 3.0, *(math.pi - d for d in (1e-3, 1e-6, 1e-9, 0.0)))
TYPES = {"prismatic": 2, "revolute": 2, "screw": 5, "cylindrical": 5, "spherical": 5}
"""Types, and the states from which each is fitted."""
AXIS, ORIGIN, PITCH = (0.36, -0.48, 0.8), (0.4, -0.3, 0.2), 0.15


@dataclass(frozen=True)
class FitError:
    """Of one fit; lengths in the part's radius."""

    travel: float
    residual: float
    """Mean distance of the part's points between the observed and the fitted motion (ADD)."""
    axis: float
    """Angle between the fitted and the true axis, radians; of spherical joints, which have none, the centre's error."""
    converged: bool

    @property
    def forced(self) -> float:
        """The error of the axis that rounding the motions to float64 allows: its share of the travel."""
        return torch.finfo(torch.float64).eps / self.travel


def part_points() -> Tensor:
    """Points [200, 3] of a part of radius about 1."""
    return torch.rand(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5


def observed_motions(kind: str, travel: float, states: int) -> Tensor:
    """Motions [S, 4, 4] from 0 to `travel`."""
    axis, origin = (torch.tensor(v, dtype=torch.float64) for v in (AXIS, ORIGIN))
    share = torch.linspace(0, 1, states, dtype=torch.float64)
    values = travel * share
    if kind == "cylindrical":
        values = travel * torch.stack([share.square(), share], -1)
    elif kind == "spherical":
        swing = torch.stack([share, (3 * share).sin() * share, share.square()], -1)
        values = travel * swing / torch.linalg.vector_norm(swing, dim=-1).max()
    return joint_motion(kind, axis / axis.norm(), origin, PITCH, values)


def fit_error(kind: str, travel: float) -> FitError:
    points = part_points()
    fit = fit_joint(observed_motions(kind, travel, TYPES[kind]), points, types=[kind])
    radius = float(torch.linalg.vector_norm(points - points.mean(0), dim=-1).max())
    axis, origin = (torch.tensor(v, dtype=torch.float64) for v in (AXIS, ORIGIN))
    axis = axis / axis.norm()
    if kind == "spherical":
        error = float(torch.linalg.vector_norm(fit.origin - origin)) / radius
    else:
        error = float(torch.linalg.vector_norm(torch.linalg.cross(fit.axis, axis)))
    return FitError(travel, fit.residual / radius, error, fit.converged)
