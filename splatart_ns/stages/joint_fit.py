"""One joint, as a fit finds it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from splatart_ns.geometry.se3 import se3_log, transform_points
from splatart_ns.stages.joint_parameters import JOINT_DOFS, joint_motion

UNSEEN_ROTATION = math.radians(30)
"""A turn known no better than this is not seen: the part may have turned by any angle."""


@dataclass(frozen=True)
class JointFit:
    """One joint: how a child part moves relative to its parent. Lengths and radians, canonical frame, float64."""

    type: str
    """A key of `JOINT_DOFS`."""
    axis: Tensor
    """Unit direction [3]; of fixed, spherical and free joints, which have none, z."""
    origin: Tensor
    """The point of the axis nearest the child's centroid [3]; the centre of a spherical joint; else the centroid."""
    pitch: float
    """Slide per radian; 0 but for screws."""
    values: Tensor
    """Joint values [S]: radian, or length for prismatic joints. 0 at state 0, positive where the travel is largest.
    [S, D] for D = 2, 3 or 6 degrees of freedom: (length, angle) for cylindrical, a rotation vector for spherical, a
    tangent (translation, rotation) for free."""
    residual: float
    """Mean distance of the child's points between observed and modelled motion, mean over states 1 and up."""
    score: float = math.inf
    """chi^2 plus a penalty per parameter: the lower, the better supported."""
    chi2: float = math.nan
    """Squared residual in units of the noise."""
    accepted: bool = True
    """Whether the residual is within the limit, or no more than the noise explains."""
    converged: bool = True
    iterations: int = 0
    shown: int | None = None
    """In how many states both parts are seen; None: in all."""
    covariance: dict[str, list] = field(default_factory=dict)
    """Blocks of what applies: "axis", "origin" (across the axis), "axis_origin", all [3, 3], and "values" [S, S], or
    [S D, S D] with the D values of a state side by side."""
    ambiguous: bool = False
    """Whether the data support another type nearly as well."""
    alternatives: list[dict] = field(default_factory=list)
    """The other types that were fitted: {"type", "residual", "score"}."""
    undetermined: list[str] = field(default_factory=list)
    """What the data leave open, a sentence each."""

    @property
    def dofs(self) -> int:
        return JOINT_DOFS[self.type]

    @property
    def num_shown(self) -> int:
        """In how many states both parts are seen."""
        return len(self.values) if self.shown is None else self.shown

    @property
    def limits(self) -> tuple[float, float] | None:
        """The observed range of the value, a whole turn where no state but the first tells it; None for more than one
        freedom."""
        if self.dofs > 1:
            return None
        values = self.values
        if self.type == "revolute" and "values" in self.covariance:
            variances = torch.tensor(self.covariance["values"], dtype=torch.float64).diagonal()
            told = (variances <= UNSEEN_ROTATION**2).to(values.device)
            if not told[1:].any():
                return -math.pi, math.pi
            values = values[told]
        return float(values.min()), float(values.max())

    def motion(self, values: Tensor) -> Tensor:
        """Motions [..., 4, 4] of the child relative to its parent at values [...], or [..., D] for D > 1 freedoms."""
        axis, origin = self.axis.to(values), self.origin.to(values)
        return joint_motion(self.type, axis, origin, self.pitch, values)

    def reversed(self, points: Tensor, T_rel: Tensor) -> JointFit:
        """The same joint with parent and child exchanged, for the new child's points [N, 3] and motions [S, 4, 4].

        Every motion becomes its inverse. About the same line, so the axis turns round and the values stay; where there
        is no line, about the same centre by the opposite values.
        """
        points = points.to(self.origin)
        if self.type in ("fixed", "spherical", "free"):
            origin = self.origin if self.type == "spherical" else points.mean(0)
            flipped = replace(self, values=self.values if self.type == "fixed" else -self.values, origin=origin)
            return replace(flipped, residual=mean_distance(points, T_rel[1:], flipped.motion(flipped.values[1:])))
        centroid = points.mean(0)
        along = float(self.axis @ (centroid - self.origin))
        covariance = dict(self.covariance)
        if "origin" in covariance:
            C_a, C_o, C_ao = (
                torch.tensor(covariance[k], dtype=torch.float64).to(self.axis)
                for k in ("axis", "origin", "axis_origin")
            )
            across = torch.eye(3).to(self.axis) - torch.outer(self.axis, self.axis)
            slid = C_o + along * (C_ao + C_ao.mT) + along**2 * C_a
            covariance["origin"] = (across @ slid @ across).tolist()
            covariance["axis_origin"] = (-(C_ao + along * C_a) @ across).tolist()
        flipped = replace(self, axis=-self.axis, origin=self.origin + along * self.axis, covariance=covariance)
        return replace(flipped, residual=mean_distance(points, T_rel[1:], flipped.motion(self.values[1:])))


def free_joint(T_rel: Tensor, points: Tensor) -> JointFit:
    """The joint that leaves a child [N, 3] all freedom, with its motions [S, 4, 4] relative to the parent."""
    T_rel = T_rel.double()
    z = torch.tensor([0.0, 0.0, 1.0]).to(T_rel)
    return JointFit("free", z, points.to(T_rel).mean(0), 0.0, se3_log(T_rel), residual=0.0, chi2=0.0)


def mean_distance(points: Tensor, T_a: Tensor, T_b: Tensor) -> float:
    """ADD: mean distance of points [N, 3] under two sets of motions [S, 4, 4]."""
    return float(torch.linalg.vector_norm(transform_points(T_a - T_b, points), dim=-1).mean())
