"""Stage 3: the joint between two parts, from their relative motion.

A joint is fitted in two steps: the closed form (common screw axis of all states), then Levenberg-Marquardt on the
distances between the child's points moved by the observed and by the modelled motion (ADD). To second order the mean
square of those distances is a quadratic form in the small motion between the two, so no step visits the points. Where
a covariance of the motion is known it takes the place of that form: it says which directions the images left open.

The noise decides between types. A registration that is wrong by a length s at the surface turns a part of radius r by
about s / r, so the noise model is s^2 times the inverse of the points' quadratic form: a finger of a few pixels may
turn by degrees where a door may not. The score of a type is chi^2 + 4 per parameter: a freedom must buy two standard
deviations. The lowest score wins among the types that are accepted, whose residual is small or explained by the
noise. Two states make all this necessary: there a revolute joint (5 parameters for 6 numbers) imitates almost every
sliding one (3).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from splatart_ns.geometry.screw import Screw
from splatart_ns.geometry.se3 import (
    adjoint,
    from_rotation_translation,
    inverse,
    se3_log,
    skew,
    so3_exp,
    so3_log,
    transform_points,
)

NOISE = 0.003
"""Default registration error of a part's surface, as a share of the object's bounding radius."""
EPSILON = 0.02
"""Default limit of the residual, as a share of the object's bounding radius."""
PRISMATIC_BELOW = 1.2
"""A joint slides if holding the rotation raises the rendering cost by less than this factor."""
_PENALTY = 4.0  # score of one parameter
_EXPLAINED = 3.0  # chi^2 per observed number that is still put down to the noise
_MAX_ITERATIONS = 30
_LEAST_LEVER = 0.005  # of the object's radius
_UNDETERMINED_AXIS = math.radians(15)
_UNDETERMINED_ORIGIN = 0.25  # of the object's radius
_UNKNOWN_ROTATION = math.radians(5)


@dataclass(frozen=True)
class JointFit:
    """One joint: how a child part moves relative to its parent. Lengths and radians, canonical frame, float64."""

    type: str
    """"revolute", "prismatic", "screw" or "fixed"."""
    axis: Tensor
    """Unit direction [3]; for a fixed joint it means nothing and is z."""
    origin: Tensor
    """The point of the axis nearest the child's centroid [3]."""
    pitch: float
    """Slide per radian; 0 but for screws."""
    values: Tensor
    """Joint values [S]: radian, or length for prismatic joints. 0 at state 0, positive where the travel is largest."""
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
    covariance: dict[str, list] = field(default_factory=dict)
    """Blocks of what applies: "axis", "origin" (across the axis), "axis_origin", all [3, 3], and "values" [S, S]."""
    ambiguous: bool = False
    """Whether the data support another type nearly as well."""
    alternatives: list[dict] = field(default_factory=list)
    """The other types that were fitted: {"type", "residual", "score"}."""
    undetermined: list[str] = field(default_factory=list)
    """What the data leave open, a sentence each."""

    @property
    def limits(self) -> tuple[float, float]:
        """The observed range of the values."""
        return float(self.values.min()), float(self.values.max())

    def motion(self, values: Tensor) -> Tensor:
        """Motions [..., 4, 4] of the child relative to its parent at joint values [...]."""
        axis, origin = self.axis.to(values), self.origin.to(values)
        return joint_motion(self.type, axis, origin, self.pitch, values)

    def reversed(self, points: Tensor, T_rel: Tensor) -> JointFit:
        """The same joint with parent and child exchanged, for the new child's points [N, 3] and motions [S, 4, 4].

        Every motion becomes its inverse about the same line, so the axis turns round and the values stay.
        """
        points = points.to(self.origin)
        centroid = points.mean(0)
        along = float(self.axis @ (centroid - self.origin))
        covariance = dict(self.covariance)
        if "origin" in covariance:
            C_a, C_o, C_ao = (torch.tensor(covariance[k]).to(self.axis) for k in ("axis", "origin", "axis_origin"))
            across = torch.eye(3).to(self.axis) - torch.outer(self.axis, self.axis)
            slid = C_o + along * (C_ao + C_ao.mT) + along**2 * C_a
            covariance["origin"] = (across @ slid @ across).tolist()
            covariance["axis_origin"] = (-(C_ao + along * C_a) @ across).tolist()
        axis = self.axis if self.type == "fixed" else -self.axis
        flipped = replace(self, axis=axis, origin=self.origin + along * self.axis, covariance=covariance)
        return replace(flipped, residual=mean_distance(points, T_rel[1:], flipped.motion(self.values[1:])))


def joint_motion(kind: str, axis: Tensor, origin: Tensor, pitch: float | Tensor, values: Tensor) -> Tensor:
    """Motions [..., 4, 4] of joints of type `kind` at values [...]; axes and origins [..., 3] broadcast to them."""
    zero = torch.zeros_like(values)
    turn = zero if kind in ("prismatic", "fixed") else values
    slide = {"prismatic": values, "screw": pitch * values}.get(kind, zero)
    shape = (*values.shape, 3)
    return Screw(axis.expand(shape), origin.expand(shape), turn, slide).motion()


def surface_noise(points: Tensor, noise: float, object_radius: float) -> Tensor:
    """Covariance [6, 6] of a motion about the centroid of points [N, 3], known to `noise` x `object_radius` at them.

    The variance times the inverse of the quadratic form whose value at a small motion is the points' mean squared
    displacement. The lever of a turn is at least 0.005 of the object's radius, as for a rod that turns about itself.
    """
    x = points - points.mean(0)
    C = x.mT @ x / x.shape[0]
    inertia = (C.trace() + (_LEAST_LEVER * object_radius) ** 2) * torch.eye(3).to(C) - C
    return (noise * object_radius) ** 2 * torch.block_diag(torch.eye(3).to(C), torch.linalg.inv(inertia))


def mean_distance(points: Tensor, T_a: Tensor, T_b: Tensor) -> float:
    """ADD: mean distance of points [N, 3] under two sets of motions [S, 4, 4]."""
    return float(torch.linalg.vector_norm(transform_points(T_a - T_b, points), dim=-1).mean())


def fit_joint(
    T_rel: Tensor,
    points: Tensor,
    *,
    covariance: Tensor | None = None,
    object_radius: float | None = None,
    noise: float = NOISE,
    epsilon: float = EPSILON,
    render_ratio: float | None = None,
    types: Sequence[str] = ("fixed", "prismatic", "revolute"),
) -> JointFit:
    """The joint that explains how a child moves relative to its parent.

    `T_rel` [S, 4, 4]: canonical motion of the child relative to its parent's, T_rel[0] = 1, at least two states.
    `points` [N, 3]: the child's points at state 0. `covariance` [S, 6, 6]: of the motions, T_true = exp(d) T_rel with
    d = (translation, rotation) about the world's origin; without it, and always as a floor, the surface noise of the
    module's head at `noise` times `object_radius` (the child's own bounding radius where the object's is not given).
    Types that leave more than `epsilon` x `object_radius`, and more than the noise explains, are not accepted.
    `render_ratio`: rendering cost with the rotation held over the cost of the free fit; where given, it alone chooses
    between turning and sliding. `types` may include "screw", which only three or more states can tell from revolute.
    """
    if object_radius is None:
        object_radius = float(torch.linalg.vector_norm(points - points.mean(0), dim=-1).max())
    covariances = None if covariance is None else covariance[None]
    return fit_joints(T_rel[None], [points], object_radius, covariances, noise, epsilon, [render_ratio], types)[0]


def fit_joints(
    T_rel: Tensor,
    points: Sequence[Tensor],
    object_radius: float,
    covariances: Tensor | None = None,
    noise: float = NOISE,
    epsilon: float = EPSILON,
    render_ratios: Sequence[float | None] | None = None,
    types: Sequence[str] = ("fixed", "prismatic", "revolute"),
) -> list[JointFit]:
    """`fit_joint` for B pairs at once: motions [B, S, 4, 4], covariances [B, S, 6, 6], points and ratios one a pair."""
    T_rel = T_rel.double()
    points = [x.to(T_rel) for x in points]
    if T_rel.shape[1] < 2:
        raise ValueError(f"a joint needs the motions of at least two states, not {T_rel.shape[1]}")
    # About the child's centroid translation and rotation are nearly independent, and numbers stay small.
    centroids = torch.stack([x.mean(0) for x in points])
    about = from_rotation_translation(torch.eye(3).to(T_rel), centroids)[:, None]
    T = (inverse(about) @ T_rel @ about)[:, 1:]
    floor = [surface_noise(x, noise, object_radius) for x in points]
    errors = torch.stack(floor)[:, None].expand(*T.shape[:2], 6, 6)
    if covariances is not None:
        to_body = adjoint(inverse(T_rel @ about)[:, 1:])
        errors = errors + to_body @ covariances.to(T_rel)[:, 1:] @ to_body.mT
    whiten = torch.linalg.inv(torch.linalg.cholesky(errors))
    worst_rotation = torch.linalg.eigvalsh(errors[..., 3:, 3:]).amax((-2, -1)).sqrt()

    fits = zip(*(_fit(kind, T, whiten, points) for kind in types), strict=True)
    ratios = render_ratios or [None] * len(points)
    return [
        _choose([replace(f, origin=f.origin + c) for f in pair], ratio, float(sigma), object_radius, epsilon)
        for pair, c, ratio, sigma in zip(fits, centroids, ratios, worst_rotation, strict=True)
    ]


def _choose(
    fits: list[JointFit], render_ratio: float | None, rotation_sigma: float, object_radius: float, epsilon: float
) -> JointFit:
    limit = _EXPLAINED * 6 * (len(fits[0].values) - 1)
    fits = [replace(f, accepted=f.residual <= epsilon * object_radius or f.chi2 <= limit) for f in fits]
    best = min(fits, key=lambda f: (not f.accepted, f.score))
    if render_ratio is not None and best.type != "fixed":
        slides = render_ratio < PRISMATIC_BELOW
        allowed = [f for f in fits if f.type != "fixed" and (f.type == "prismatic") == slides]
        best = min(allowed, key=lambda f: f.score, default=best)
    others = sorted((f for f in fits if f is not best), key=lambda f: f.score)
    unseen_turn = best.type == "prismatic" and rotation_sigma > _UNKNOWN_ROTATION
    close = any(f.score < best.score + _PENALTY for f in others)
    return replace(
        best,
        ambiguous=render_ratio is None and (close or unseen_turn),
        alternatives=[{"type": f.type, "residual": f.residual, "score": f.score} for f in others],
        undetermined=_undetermined(best, object_radius),
    )


def _undetermined(fit: JointFit, object_radius: float) -> list[str]:
    if fit.type == "fixed":
        return ["The parts did not move relative to each other, so axis, origin and type are undetermined."]
    notes = []
    sigma = {k: math.sqrt(torch.linalg.eigvalsh(torch.tensor(C))[-1].clamp_min(0)) for k, C in fit.covariance.items()}
    if sigma["axis"] > _UNDETERMINED_AXIS:
        degrees = math.degrees(min(sigma["axis"], math.pi))
        notes.append(f"The axis is undetermined: its standard deviation is {degrees:.0f} degrees.")
    if sigma.get("origin", 0.0) > _UNDETERMINED_ORIGIN * object_radius:
        share = sigma["origin"] / object_radius
        notes.append(f"The origin is undetermined: its standard deviation is {share:.2g} of the object's radius.")
    return notes


# B joints under fit: axes [B, 3], their points nearest the centroid [B, 3], pitches [B], values [B, n].
_Joints = tuple[Tensor, Tensor, Tensor, Tensor]


def _fit(kind: str, T: Tensor, whiten: Tensor, points: list[Tensor]) -> list[JointFit]:
    """The best joints of one type for motions T [B, n, 4, 4] of states 1 and up; the centroid is the origin."""
    joints = _closed_form(kind, T)
    r = _residuals(kind, joints, T, whiten)
    cost, damping = (r * r).sum(-1), torch.full_like(T[:, 0, 0, 0], 1e-6)
    iterations = torch.zeros_like(cost, dtype=torch.long)
    converged = torch.full_like(iterations, kind == "fixed", dtype=torch.bool)
    for _ in range(_MAX_ITERATIONS):
        if converged.all():
            break
        iterations += ~converged
        H, g, scale = _normal_equations(_jacobian(kind, joints, T, whiten), r)
        step = torch.linalg.solve(H + damping[:, None, None] * torch.eye(H.shape[-1]).to(H), -g) / scale
        trial = _moved(kind, joints, step)
        r_trial = _residuals(kind, trial, T, whiten)
        trial_cost = (r_trial * r_trial).sum(-1)
        better = (trial_cost <= cost) & ~converged
        # Where no step goes down any more only rounding is left.
        converged = converged | better & (cost - trial_cost <= 1e-8 * cost + 1e-16) | ~better & (damping > 1e6)
        joints = tuple(
            torch.where(better.view(-1, *[1] * (a.ndim - 1)), b, a) for a, b in zip(joints, trial, strict=True)
        )
        r, cost = torch.where(better[:, None], r_trial, r), torch.where(better, trial_cost, cost)
        damping = torch.where(better, (damping / 10).clamp_min(1e-12), damping * 10)
    return _results(kind, joints, T, whiten, points, cost, iterations, converged)


def _normal_equations(J: Tensor, r: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """J^T J and J^T r for columns of unit length, and their lengths: so that metres and radians weigh the same."""
    scale = torch.linalg.vector_norm(J, dim=-2).clamp_min(1e-150)
    J = J / scale[:, None]
    return J.mT @ J, (J.mT @ r[..., None])[..., 0], scale


def _closed_form(kind: str, T: Tensor) -> _Joints:
    """The common axis of all states: the principal direction of their turns (or slides), and its least-squares line."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    zero = torch.zeros_like(t[:, 0])
    if kind == "fixed":
        return torch.tensor([0.0, 0.0, 1.0]).to(t).expand_as(zero), zero, zero[:, 0], torch.zeros_like(t[..., 0])
    along = t if kind == "prismatic" else so3_log(R)
    axis = torch.linalg.svd(along).Vh[:, 0]
    values = (along @ axis[..., None])[..., 0]
    if kind == "prismatic":
        return axis, zero, zero[:, 0], values
    slides = (t @ axis[..., None])[..., 0]
    pitch = (slides * values).sum(-1) / (values * values).sum(-1).clamp_min(1e-300) if kind == "screw" else zero[:, 0]
    # A point o of the axis only slides: (1 - R) o = t - slide. Solved across the axis, in two unknowns.
    across = _across(axis)
    A = ((torch.eye(3).to(R) - R) @ across[:, None]).flatten(1, 2)
    b = (t - slides[..., None] * axis[:, None]).flatten(1, 2)
    # The tiny constant matters to motions without a turn only: their axis is then drawn through the centroid.
    offset = torch.linalg.solve(A.mT @ A + 1e-28 * torch.eye(2).to(A), A.mT @ b[..., None])
    return axis, (across @ offset)[..., 0], pitch, values


def _across(axis: Tensor) -> Tensor:
    """Two orthonormal directions across each axis, as columns [B, 3, 2]."""
    return torch.linalg.svd(axis[:, None]).Vh[:, 1:].mT


def _model(kind: str, joints: _Joints) -> Tensor:
    axis, point, pitch, values = joints
    return joint_motion(kind, axis[:, None], point[:, None], pitch[:, None], values)


def _residuals(kind: str, joints: _Joints, T: Tensor, whiten: Tensor) -> Tensor:
    """What the model leaves, T = model exp(x), in standard deviations [B, 6 n]."""
    x = se3_log(inverse(_model(kind, joints)) @ T)
    return (whiten @ x[..., None]).flatten(1)


def _jacobian(kind: str, joints: _Joints, T: Tensor, whiten: Tensor) -> Tensor:
    """Derivatives [B, 6 n, K] of the residuals: axis turns (2), axis shifts (2, if it turns), pitch (screw), values."""
    axis, point, pitch, values = joints
    n, turns = values.shape[1], kind != "prismatic"
    across = _across(axis)
    turning = torch.cat([torch.linalg.cross(point[..., None].expand_as(across), across, dim=-2), across], -2)
    shifting = torch.cat([across, torch.zeros_like(across)], -2)
    model = _model(kind, joints)
    # Turning the axis about its point, or shifting it, conjugates the model: seen from the body, Ad(model^-1) - 1.
    conjugated = (adjoint(inverse(model)) - torch.eye(6).to(T)) @ (
        torch.cat([turning, shifting], -1) if turns else turning
    )[:, None]
    twist = torch.cat([torch.linalg.cross(point, axis) + pitch[:, None] * axis, axis], -1)
    if not turns:
        twist = torch.cat([axis, torch.zeros_like(axis)], -1)
    columns = [conjugated, torch.eye(n).to(T)[:, None] * twist[:, None, :, None]]
    if kind == "screw":
        slide = values[..., None] * axis[:, None]
        columns.insert(1, torch.cat([slide, torch.zeros_like(slide)], -1)[..., None])
    # The changes come in on the model's side of x; the inverse left Jacobian of SE(3) carries them to x.
    x = se3_log(inverse(model) @ T)
    turned = skew(x[..., 3:])
    ad = torch.cat([torch.cat([turned, skew(x[..., :3])], -1), torch.cat([torch.zeros_like(turned), turned], -1)], -2)
    carry = torch.eye(6).to(T) - ad / 2 + ad @ ad / 12
    return -(whiten @ carry @ torch.cat(columns, -1)).flatten(1, 2)


def _moved(kind: str, joints: _Joints, step: Tensor) -> _Joints:
    axis, point, pitch, values = joints
    across = _across(axis)
    turned = (so3_exp((across @ step[:, :2, None])[..., 0]) @ axis[..., None])[..., 0]
    turned = turned / torch.linalg.vector_norm(turned, dim=-1, keepdim=True)
    if kind != "prismatic":
        point = point + (across @ step[:, 2:4, None])[..., 0]
        point = point - (point * turned).sum(-1, keepdim=True) * turned
    if kind == "screw":
        pitch = pitch + step[:, 4]
    return turned, point, pitch, values + step[:, -values.shape[1] :]


def _results(
    kind: str,
    joints: _Joints,
    T: Tensor,
    whiten: Tensor,
    points: list[Tensor],
    cost: Tensor,
    iterations: Tensor,
    converged: Tensor,
) -> list[JointFit]:
    axis, point, pitch, values = joints
    model = _model(kind, joints)
    J = torch.zeros_like(whiten.flatten(1, 2)[..., :0]) if kind == "fixed" else _jacobian(kind, joints, T, whiten)
    parameters, freedom = J.shape[2], J.shape[1] - J.shape[2]
    inflation = (cost / freedom).clamp_min(1) if freedom > 0 else torch.ones_like(cost)
    covariances = [{}] * len(points) if kind == "fixed" else _covariances(kind, axis, J, inflation, values.shape[1])
    farthest = values.gather(1, values.abs().argmax(1, keepdim=True))
    sign = torch.where(farthest < 0, -1.0, 1.0).to(values)
    values = torch.cat([torch.zeros_like(sign), values * sign], 1)
    axis = axis if kind == "fixed" else axis * sign
    return [
        JointFit(
            type=kind,
            axis=axis[i],
            origin=point[i],
            pitch=float(pitch[i]),
            values=values[i],
            residual=mean_distance(points[i] - points[i].mean(0), T[i], model[i]),
            score=float(cost[i]) + _PENALTY * parameters,
            chi2=float(cost[i]),
            converged=bool(converged[i]),
            iterations=int(iterations[i]),
            covariance=covariances[i],
        )
        for i in range(len(points))
    ]


def _covariances(kind: str, axis: Tensor, J: Tensor, inflation: Tensor, n: int) -> list[dict[str, list]]:
    """Blocks of the inverse Hessian. A direction that the data do not see comes out large, not zero."""
    H, _, scale = _normal_equations(J, J[..., 0])
    C = torch.linalg.inv(H + 1e-14 * torch.eye(H.shape[-1]).to(H)) / (scale[:, :, None] * scale[:, None])
    C = inflation[:, None, None] * C
    across = _across(axis)
    to_axis = -skew(axis) @ across  # a turn w of the axis moves it by w x axis
    blocks = {"axis": to_axis @ C[:, :2, :2] @ to_axis.mT}
    if kind != "prismatic":
        blocks["origin"] = across @ C[:, 2:4, 2:4] @ across.mT
        blocks["axis_origin"] = to_axis @ C[:, :2, 2:4] @ across.mT
    blocks["values"] = torch.nn.functional.pad(C[:, -n:, -n:], (1, 0, 1, 0))
    return [{name: block[i].tolist() for name, block in blocks.items()} for i in range(len(J))]
