"""Stage 3: the joint between two parts, from their relative motion.

A joint is fitted in two steps: the closed form (common screw axis of all states), then Levenberg-Marquardt on the
distances between the child's points moved by the observed and by the modelled motion (ADD). To second order the mean
square of those distances is a quadratic form in the small motion between the two, so no step visits the points. Where
a covariance of the motion is known it takes the place of that form: it says which directions the images left open.

The noise decides between types. A registration that is wrong by a length s at the surface turns a part of radius r by
about s / r, so the noise model is s^2 times the inverse of the points' quadratic form: a finger of a few pixels may
turn by degrees where a door may not. The score of a type is chi^2 + 6 per parameter, lowest wins: a freedom must buy
more than about 2.5 standard deviations. Two states make this necessary: there a revolute joint (5 parameters for 6
numbers) imitates almost every sliding one (3).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from splatart_ns.geometry.screw import Screw
from splatart_ns.geometry.se3 import adjoint, inverse, se3_log, skew, so3_exp, transform_points

NOISE = 0.003
"""Default registration error of a part's surface, as a share of the object's bounding radius."""
PRISMATIC_BELOW = 1.2
"""A joint slides if holding the rotation raises the rendering cost by less than this factor."""
_PENALTY = 6.0  # score of one parameter
_MAX_ITERATIONS = 50
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
    converged: bool = True
    iterations: int = 0
    covariance: dict[str, list] = field(default_factory=dict)
    """Blocks "axis", "origin" (across the axis), "axis_origin", all [3, 3], and "values" [S, S], of those that apply."""
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

    def reversed(self, points: Tensor) -> JointFit:
        """The same joint with parent and child exchanged; `points` [N, 3] are those of the new child.

        Every motion becomes its inverse about the same line, so the axis turns round and the values stay.
        """
        centroid = points.to(self.origin).mean(0)
        along = float(self.axis @ (centroid - self.origin))
        covariance = dict(self.covariance)
        if "origin" in covariance:
            C_a, C_o, C_ao = (torch.tensor(covariance[k]).to(self.axis) for k in ("axis", "origin", "axis_origin"))
            across = torch.eye(3).to(self.axis) - torch.outer(self.axis, self.axis)
            slid = C_o + along * (C_ao + C_ao.mT) + along**2 * C_a
            covariance["origin"] = (across @ slid @ across).tolist()
            covariance["axis_origin"] = (-(C_ao + along * C_a) @ across).tolist()
        axis = self.axis if self.type == "fixed" else -self.axis
        return replace(self, axis=axis, origin=self.origin + along * self.axis, covariance=covariance)


def joint_motion(kind: str, axis: Tensor, origin: Tensor, pitch: float | Tensor, values: Tensor) -> Tensor:
    """Motions [..., 4, 4] of a joint of type `kind` at values [...]; axis and origin [3]."""
    zero = torch.zeros_like(values)
    turn = zero if kind in ("prismatic", "fixed") else values
    slide = {"prismatic": values, "screw": pitch * values}.get(kind, zero)
    shape = (*values.shape, 3)
    return Screw(axis.expand(shape), origin.expand(shape), turn, slide).motion()


def surface_noise(points: Tensor, sigma: float, floor: float) -> Tensor:
    """Covariance [6, 6] of a motion about the centroid of points [N, 3], known to `sigma` (length) at the points.

    sigma^2 times the inverse of the quadratic form whose value at a small motion is the points' mean squared
    displacement. `floor` (length) is the least radius a part is taken to have: a rod's turn about itself.
    """
    x = points - points.mean(0)
    C = x.mT @ x / x.shape[0]
    inertia = C.trace() * torch.eye(3).to(C) - C + floor**2 * torch.eye(3).to(C)
    return sigma**2 * torch.block_diag(torch.eye(3).to(C), torch.linalg.inv(inertia))


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
    render_ratio: float | None = None,
    types: Sequence[str] = ("fixed", "prismatic", "revolute"),
) -> JointFit:
    """The joint that explains how a child moves relative to its parent.

    `T_rel` [S, 4, 4]: canonical motion of the child relative to its parent's, T_rel[0] = 1, at least two states.
    `points` [N, 3]: the child's points at state 0. `covariance` [S, 6, 6]: of the motions, T_true = exp(d) T_rel with
    d = (translation, rotation) about the world's origin; without it, and always as a floor, the surface noise of the
    module's head at `noise` times `object_radius` (the child's own bounding radius where the object's is not given).
    `render_ratio`: rendering cost with the rotation held over the cost of the free fit; where given, it alone chooses
    between turning and sliding. `types` may include "screw", which only three or more states can tell from revolute.
    """
    T_rel, points = T_rel.double(), points.to(T_rel.device).double()
    if T_rel.shape[0] < 2:
        raise ValueError(f"a joint needs the motion of at least two states, not {T_rel.shape[0]}")
    centroid = points.mean(0)
    if object_radius is None:
        object_radius = float(torch.linalg.vector_norm(points - centroid, dim=-1).max())
    # About the child's centroid translation and rotation are nearly independent, and numbers stay small.
    about = torch.eye(4).to(T_rel)
    about[:3, 3] = centroid
    T = (inverse(about) @ T_rel @ about)[1:]
    floor = surface_noise(points, noise * object_radius, 0.005 * object_radius)
    noise_covariance = floor.expand(len(T), 6, 6)
    if covariance is not None:
        body = adjoint(inverse(T_rel @ about)[1:])
        noise_covariance = noise_covariance + body @ covariance.to(T_rel)[1:] @ body.mT
    whiten = torch.linalg.inv(torch.linalg.cholesky(noise_covariance))

    fits = [_fit(kind, T, whiten, points - centroid) for kind in types]
    fits = [replace(f, origin=f.origin + centroid) for f in fits]
    best = min(fits, key=lambda f: f.score)
    if render_ratio is not None and best.type != "fixed":
        slides = render_ratio < PRISMATIC_BELOW
        moving = [f for f in fits if f.type != "fixed" and (f.type == "prismatic") == slides]
        best = min(moving, key=lambda f: f.score, default=best)
    others = sorted((f for f in fits if f is not best), key=lambda f: f.score)
    unknown_rotation = float(torch.linalg.eigvalsh(noise_covariance[:, 3:, 3:]).max()) > _UNKNOWN_ROTATION**2
    ambiguous = render_ratio is None and (
        any(f.score < best.score + _PENALTY for f in others) or (best.type == "prismatic" and unknown_rotation)
    )
    return replace(
        best,
        ambiguous=ambiguous,
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


def _fit(kind: str, T: Tensor, whiten: Tensor, points: Tensor) -> JointFit:
    """The best joint of one type for motions T [n, 4, 4] of states 1 and up; the centroid is the origin."""
    joint = _closed_form(kind, T)
    r = _residuals(kind, joint, T, whiten)
    cost, damping, iterations, converged = float(r @ r), 1e-6, 0, kind == "fixed"
    while not converged and iterations < _MAX_ITERATIONS:
        iterations += 1
        J = _jacobian(kind, joint, T, whiten)
        # Columns of unit length: lengths, radians and barely determined directions stand on one footing.
        scale = torch.linalg.vector_norm(J, dim=0).clamp_min(1e-150)
        H, g = (J / scale).mT @ (J / scale), (J / scale).mT @ r
        while True:
            step = torch.linalg.solve(H + damping * torch.eye(len(g)).to(H), -g)
            trial = _moved(kind, joint, step / scale)
            r_trial = _residuals(kind, trial, T, whiten)
            trial_cost = float(r_trial @ r_trial)
            if trial_cost <= cost:
                break
            damping *= 10
            if damping > 1e8:
                break
        if trial_cost > cost:
            converged = True  # no direction goes down: rounding
            break
        converged = cost - trial_cost <= 1e-10 * cost + 1e-16
        joint, r, cost, damping = trial, r_trial, trial_cost, max(damping / 10, 1e-12)
    return _result(kind, joint, T, whiten, points, cost, iterations, converged)


# A joint under fit: axis [3], the foot point of the centroid on it [3], pitch [], values [n].
_Joint = tuple[Tensor, Tensor, Tensor, Tensor]


def _closed_form(kind: str, T: Tensor) -> _Joint:
    """The common axis of all states: the principal direction of their turns (or slides), and its least-squares line."""
    R, t = T[:, :3, :3], T[:, :3, 3]
    zero = torch.zeros(3).to(t)
    if kind == "fixed":
        return torch.tensor([0.0, 0.0, 1.0]).to(t), zero, zero[0], torch.zeros(len(T)).to(t)
    along = t if kind == "prismatic" else se3_log(T)[:, 3:]
    axis = torch.linalg.svd(along, full_matrices=True).Vh[0]
    values = along @ axis
    if kind == "prismatic":
        return axis, zero, zero[0], values
    slides = t @ axis
    pitch = slides @ values / (values @ values).clamp_min(1e-300) if kind == "screw" else zero[0]
    # A point o of the axis only slides: (1 - R) o = t - slide. Solved across the axis, in two unknowns.
    across = _across(axis)
    A = ((torch.eye(3).to(R) - R) @ across).reshape(-1, 2)
    b = (t - slides[:, None] * axis).reshape(-1)
    H = A.mT @ A
    offset = torch.linalg.solve(H + 1e-28 * torch.eye(2).to(H), A.mT @ b)
    return axis, across @ offset, pitch, values


def _across(axis: Tensor) -> Tensor:
    """Two orthonormal directions across an axis, as columns [3, 2]."""
    return torch.linalg.svd(axis[None], full_matrices=True).Vh[1:].mT


def _residuals(kind: str, joint: _Joint, T: Tensor, whiten: Tensor) -> Tensor:
    """What the model leaves, T = model exp(x), in standard deviations [6 n]."""
    x = se3_log(inverse(joint_motion(kind, *joint)) @ T)
    return (whiten @ x[..., None]).reshape(-1)


def _jacobian(kind: str, joint: _Joint, T: Tensor, whiten: Tensor) -> Tensor:
    """Derivatives of the residuals [6 n, K]: two turns of the axis, two shifts (if it turns), pitch (screw), values."""
    axis, point, pitch, values = joint
    n, turns = len(T), kind != "prismatic"
    across = _across(axis)
    model = joint_motion(kind, *joint)
    body = adjoint(inverse(model)) - torch.eye(6).to(T)
    # Turning the axis about its foot point, and shifting it: the model changes by a conjugation.
    columns = [body @ torch.cat([torch.linalg.cross(point, b), b]) for b in across.unbind(1)]
    if turns:
        columns += [body @ torch.cat([b, torch.zeros_like(b)]) for b in across.unbind(1)]
    if kind == "screw":
        columns.append(torch.cat([values[:, None] * axis, torch.zeros(n, 3).to(T)], -1))
    twist = torch.cat([torch.linalg.cross(point, axis) + pitch * axis, axis]) if turns else torch.cat([axis, 0 * axis])
    changes = torch.cat([torch.stack(columns, -1), torch.diag_embed(torch.ones(n).to(T))[:, None] * twist[:, None]], -1)
    # The change comes in on the model's side of x; the inverse left Jacobian of SE(3) carries it to x.
    x = se3_log(inverse(model) @ T)
    zero = torch.zeros(n, 3, 3).to(T)
    ad = torch.cat([torch.cat([skew(x[:, 3:]), skew(x[:, :3])], -1), torch.cat([zero, skew(x[:, 3:])], -1)], -2)
    carry = torch.eye(6).to(T) - ad / 2 + ad @ ad / 12
    return -(whiten @ carry @ changes).reshape(6 * n, -1)


def _moved(kind: str, joint: _Joint, step: Tensor) -> _Joint:
    axis, point, pitch, values = joint
    across = _across(axis)
    turned = so3_exp(across @ step[:2]) @ axis
    if kind != "prismatic":
        point = point + across @ step[2:4]
        point = point - (point @ turned) * turned
    if kind == "screw":
        pitch = pitch + step[4]
    return turned / torch.linalg.vector_norm(turned), point, pitch, values + step[-len(values) :]


def _result(
    kind: str, joint: _Joint, T: Tensor, whiten: Tensor, points: Tensor, cost: float, iterations: int, converged: bool
) -> JointFit:
    axis, point, pitch, values = joint
    covariance, parameters = {}, 0
    if kind != "fixed":
        J = _jacobian(kind, joint, T, whiten)
        parameters = J.shape[1]
        freedom = J.shape[0] - parameters
        covariance = _covariance(kind, joint, J, max(1.0, cost / freedom) if freedom > 0 else 1.0)
        if values[values.abs().argmax()] < 0:
            axis, values = -axis, -values
            if "axis_origin" in covariance:
                covariance["axis_origin"] = (-torch.tensor(covariance["axis_origin"])).tolist()
    return JointFit(
        type=kind,
        axis=axis,
        origin=point,
        pitch=float(pitch),
        values=torch.cat([torch.zeros(1).to(values), values]),
        residual=mean_distance(points, T, joint_motion(kind, *joint)),
        score=cost + _PENALTY * parameters,
        chi2=cost,
        converged=converged,
        iterations=iterations,
        covariance=covariance,
    )


def _covariance(kind: str, joint: _Joint, J: Tensor, inflation: float) -> dict[str, list]:
    """Blocks of the inverse Hessian. A direction that the data do not see comes out large, not zero."""
    axis, _, _, values = joint
    scale = torch.linalg.vector_norm(J, dim=0).clamp_min(1e-150)
    H = (J / scale).mT @ (J / scale)
    C = inflation * torch.linalg.inv(H + 1e-14 * torch.eye(len(H)).to(H)) / torch.outer(scale, scale)
    across = _across(axis)
    to_axis = -skew(axis) @ across  # a turn w of the axis moves it by w x axis
    n = len(values)
    blocks = {"axis": to_axis @ C[:2, :2] @ to_axis.mT, "values": torch.zeros(n + 1, n + 1).to(C)}
    blocks["values"][1:, 1:] = C[-n:, -n:]
    if kind != "prismatic":
        blocks["origin"] = across @ C[2:4, 2:4] @ across.mT
        blocks["axis_origin"] = to_axis @ C[:2, 2:4] @ across.mT
    return {name: block.tolist() for name, block in blocks.items()}
