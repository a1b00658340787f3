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

More states offer the types of more freedom, as soon as they have fewer parameters than there are numbers. These
imitate simpler ones all the better, so they pay for being rare: three times -2 ln(1 / 50) = 8, so that they must win
even if the noise is 1.7 times what it is said to be. And where even the best type leaves more than the noise, the
noise was underestimated and chi^2 is divided by that excess, or else every freedom would seem to pay (the
quasi-likelihood criterion: Burnham and Anderson, Model Selection, 2002, section 2.5).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from splatart_ns.geometry.se3 import (
    adjoint,
    from_rotation_translation,
    inverse,
    se3_exp,
    se3_log,
    so3_log,
    transform_points,
)
from splatart_ns.stages.joint_parameters import (
    JOINT_DOFS,
    Joints,
    across,
    body_twists,
    covariance_blocks,
    inverse_left_jacobian,
    joint_motion,
    model_motions,
    moved,
    values_of,
)

NOISE = 0.003
"""Default registration error of a part's surface, as a share of the object's bounding radius."""
EPSILON = 0.02
"""Default limit of the residual, as a share of the object's bounding radius."""
PRISMATIC_BELOW = 1.2
"""A joint slides if holding the rotation raises the rendering cost by less than this factor."""
UNSEEN_ROTATION = math.radians(30)
"""A turn known no better than this is not seen: the part may have turned by any angle."""

# Parameters of a type besides its values.
_SHAPE = {"fixed": 0, "prismatic": 2, "revolute": 4, "screw": 5, "cylindrical": 4, "spherical": 3, "free": 0}
_PENALTY = 4.0  # score of one parameter
_RARE = {"screw": 24.0, "cylindrical": 24.0, "spherical": 24.0}  # score of a type that few objects have
_EXPLAINED = 3.0  # chi^2 per observed number that is still put down to the noise
_MAX_ITERATIONS = 100
_HOPELESS = 1e3  # chi^2 per observed number of a fit that is not worth many digits
_MAX_HOPELESS = 30  # nor many iterations
_CREEP = 1e-3  # chi^2
_MAX_POINTS = 500
_LEAST_LEVER = 0.005  # of the object's radius
_UNDETERMINED_AXIS = math.radians(15)
_UNDETERMINED_ORIGIN = 0.25  # of the object's radius
_UNKNOWN_ROTATION = math.radians(5)


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
    def limits(self) -> tuple[float, float] | None:
        """The observed range of the value; None for more than one degree of freedom."""
        return (float(self.values.min()), float(self.values.max())) if self.dofs <= 1 else None

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
            flipped = replace(self, values=-self.values)
            return replace(flipped, residual=mean_distance(points, T_rel[1:], flipped.motion(flipped.values[1:])))
        centroid = points.mean(0)
        along = float(self.axis @ (centroid - self.origin))
        covariance = dict(self.covariance)
        if "origin" in covariance:
            C_a, C_o, C_ao = (torch.tensor(covariance[k]).to(self.axis) for k in ("axis", "origin", "axis_origin"))
            across = torch.eye(3).to(self.axis) - torch.outer(self.axis, self.axis)
            slid = C_o + along * (C_ao + C_ao.mT) + along**2 * C_a
            covariance["origin"] = (across @ slid @ across).tolist()
            covariance["axis_origin"] = (-(C_ao + along * C_a) @ across).tolist()
        flipped = replace(self, axis=-self.axis, origin=self.origin + along * self.axis, covariance=covariance)
        return replace(flipped, residual=mean_distance(points, T_rel[1:], flipped.motion(self.values[1:])))


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
    types: Sequence[str] | None = None,
) -> JointFit:
    """The joint that explains how a child moves relative to its parent.

    `T_rel` [S, 4, 4]: canonical motion of the child relative to its parent's, T_rel[0] = 1, at least two states.
    `points` [N, 3]: the child's points at state 0. `covariance` [S, 6, 6]: of the motions, T_true = exp(d) T_rel with
    d = (translation, rotation) about the world's origin; without it, and always as a floor, the surface noise of the
    module's head at `noise` times `object_radius` (the child's own bounding radius where the object's is not given).
    Types that leave more than `epsilon` x `object_radius`, and more than the noise explains, are not accepted.
    `render_ratio`: rendering cost with the rotation held over the cost of the free fit; where given, it alone chooses
    between turning and sliding. A covariance that is not finite says that the motion is unknown. `types`: those to
    choose from, by default all that have fewer parameters than the motions have numbers: fixed, prismatic and revolute
    for two states, also screw, cylindrical and spherical for more. For "free" joints there is `free_joint`.
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
    types: Sequence[str] | None = None,
) -> list[JointFit]:
    """`fit_joint` for B pairs at once: motions [B, S, 4, 4], covariances [B, S, 6, 6], points and ratios one a pair."""
    T_rel = T_rel.double()
    points = [x.to(T_rel) for x in points]
    if T_rel.shape[1] < 2:
        raise ValueError(f"a joint needs the motions of at least two states, not {T_rel.shape[1]}")
    # About the child's centroid translation and rotation are nearly independent, and numbers stay small.
    centroids = torch.stack([x.mean(0) for x in points])
    types = types or types_for(T_rel.shape[1])
    about = from_rotation_translation(torch.eye(3).to(T_rel), centroids)[:, None]
    T = (inverse(about) @ T_rel @ about)[:, 1:]
    floor = [surface_noise(x, noise, object_radius) for x in points]
    errors = torch.stack(floor)[:, None].expand(*T.shape[:2], 6, 6)
    if covariances is not None:
        to_body = adjoint(inverse(T_rel @ about)[:, 1:])
        known = to_body @ covariances.to(T_rel)[:, 1:] @ to_body.mT
        unknown = torch.diag(torch.tensor([10 * object_radius] * 3 + [10.0] * 3).to(T)) ** 2
        errors = errors + torch.where(known.isfinite().all(-1).all(-1)[..., None, None], known, unknown)
    whiten = torch.linalg.inv(torch.linalg.cholesky(errors))
    variances, directions = torch.linalg.eigh(errors[..., 3:, 3:])
    worst_rotation = variances.amax((-2, -1)).sqrt()
    # What a turn that nothing shows amounts to, with the slide that comes with it.
    unseen = (variances > UNSEEN_ROTATION**2) / variances
    unseen = pad(errors[..., 3:] @ directions @ torch.diag_embed(unseen) @ directions.mT, (3, 0))

    # The residual is a mean; it needs no more points than these.
    sampled = [(x - c)[:: math.ceil(len(x) / _MAX_POINTS)] for x, c in zip(points, centroids, strict=True)]
    fits = zip(*(_fit(kind, T, whiten, unseen, sampled) for kind in types), strict=True)
    ratios = render_ratios or [None] * len(points)
    return [
        _choose([replace(f, origin=f.origin + c) for f in pair], ratio, float(sigma), object_radius, epsilon)
        for pair, c, ratio, sigma in zip(fits, centroids, ratios, worst_rotation, strict=True)
    ]


def free_joint(T_rel: Tensor, points: Tensor) -> JointFit:
    """The joint that leaves a child [N, 3] all freedom, with its motions [S, 4, 4] relative to the parent."""
    T_rel = T_rel.double()
    z = torch.tensor([0.0, 0.0, 1.0]).to(T_rel)
    return JointFit("free", z, points.to(T_rel).mean(0), 0.0, se3_log(T_rel), residual=0.0, chi2=0.0)


def types_for(states: int) -> list[str]:
    """The types that have fewer parameters than the motions of that many states have numbers, the simplest first."""
    return [kind for kind in JOINT_DOFS if _freedom(kind, states) > 0]


def _freedom(kind: str, states: int) -> int:
    """How many of the observed numbers a type leaves over."""
    return (6 - JOINT_DOFS[kind]) * (states - 1) - _SHAPE[kind]


def _choose(
    fits: list[JointFit], render_ratio: float | None, rotation_sigma: float, object_radius: float, epsilon: float
) -> JointFit:
    states = len(fits[0].values)
    # Two states leave too few numbers to tell by how much the noise was underestimated.
    left = {f.type: f.chi2 / _freedom(f.type, states) for f in fits if states > 2 and _freedom(f.type, states) > 0}
    excess = max(1.0, min(left.values(), default=1.0))
    fits = [
        replace(
            f,
            score=f.score - f.chi2 + f.chi2 / excess,
            accepted=f.residual <= epsilon * object_radius or f.chi2 <= _explained(f.type, states),
        )
        for f in fits
    ]
    best = min(fits, key=lambda f: (not f.accepted, f.score))
    if render_ratio is not None and best.type != "fixed":
        slides = render_ratio < PRISMATIC_BELOW
        allowed = [f for f in fits if f.type != "fixed" and (f.type == "prismatic") == slides]
        best = min(allowed, key=lambda f: f.score, default=best)
    others = sorted((f for f in fits if f is not best), key=lambda f: f.score)
    unknown_turn = best.type == "prismatic" and rotation_sigma > _UNKNOWN_ROTATION
    unseen_turn = best.type in ("fixed", "prismatic") and rotation_sigma > UNSEEN_ROTATION
    close = any(f.score < best.score + _PENALTY for f in others)
    return replace(
        best,
        ambiguous=unseen_turn or render_ratio is None and (close or unknown_turn),
        alternatives=[{"type": f.type, "residual": f.residual, "score": f.score} for f in others],
        undetermined=_undetermined(best, object_radius, rotation_sigma),
        covariance={name: block.tolist() for name, block in best.covariance.items()},
    )


def _explained(kind: str, states: int) -> float:
    """The chi^2 that is still put down to the noise; for a type that imitates others, by what it leaves over only."""
    return _EXPLAINED * (_freedom(kind, states) if kind in _RARE else 6 * (states - 1))


def _undetermined(fit: JointFit, object_radius: float, rotation_sigma: float) -> list[str]:
    notes = []
    if fit.type == "fixed":
        notes.append("The parts did not move relative to each other, so axis, origin and type are undetermined.")
    if fit.type in ("fixed", "prismatic") and rotation_sigma > UNSEEN_ROTATION:
        notes.append("The part looks alike from some sides, so that it may have turned unseen.")
    sigma = {k: math.sqrt(torch.linalg.eigvalsh(C)[-1].clamp_min(0)) for k, C in fit.covariance.items()}
    if sigma.get("axis", 0.0) > _UNDETERMINED_AXIS:
        degrees = math.degrees(min(sigma["axis"], math.pi))
        notes.append(f"The axis is undetermined: its standard deviation is {degrees:.0f} degrees.")
    if sigma.get("origin", 0.0) > _UNDETERMINED_ORIGIN * object_radius:
        share = sigma["origin"] / object_radius
        notes.append(f"The origin is undetermined: its standard deviation is {share:.2g} of the object's radius.")
    if not fit.converged:
        notes.append("The fit did not converge, so its figures and their uncertainty are rough.")
    if fit.type in ("revolute", "screw") and sigma["values"] > UNSEEN_ROTATION:
        degrees = math.degrees(min(sigma["values"], math.pi))
        notes.append(f"The values are undetermined: their standard deviation is up to {degrees:.0f} degrees.")
    return notes


def _fit(kind: str, T: Tensor, whiten: Tensor, unseen: Tensor, points: list[Tensor]) -> list[JointFit]:
    """The best joints of one type for motions T [B, n, 4, 4] of states 1 and up; the centroid is the origin.

    Their covariances are tensors still. `unseen` [B, n, 6, 6] takes from a small motion what nothing shows. Along it
    the motions may be anywhere, far beyond where a covariance means something: they are put where the joint has them.
    """
    levers = torch.stack([x.square().sum(-1).mean().sqrt() for x in points]).clamp_min(1e-9)
    joints, iterations, converged = _descended(kind, _closed_form(kind, T), T, whiten, levers)
    if unseen.any():
        back = se3_exp(-(unseen @ se3_log(inverse(model_motions(kind, joints)) @ T)[..., None])[..., 0])
        T, whiten = T @ back, whiten @ adjoint(back)
        joints, more, converged = _descended(kind, joints, T, whiten, levers)
        iterations = iterations + more
    cost = _residuals(kind, joints, T, whiten).square().sum(-1)
    return _results(kind, joints, T, whiten, points, cost, iterations, converged)


def _descended(kind: str, joints: Joints, T: Tensor, whiten: Tensor, levers: Tensor) -> tuple[Joints, Tensor, Tensor]:
    """Joints of least cost by Levenberg-Marquardt, its iterations [B], and whether they converged [B]."""
    joints = tuple(a.clone() for a in joints)
    r = _residuals(kind, joints, T, whiten)
    cost, damping = (r * r).sum(-1), torch.full_like(T[:, 0, 0, 0], 1e-6)
    last_gain = torch.full_like(cost, math.inf)
    iterations = torch.zeros_like(cost, dtype=torch.long)
    converged = torch.full_like(iterations, kind == "fixed", dtype=torch.bool)
    for k in range(_MAX_ITERATIONS):
        hopeless = cost > _HOPELESS * r.shape[1]
        open_ = (~converged & ~(hopeless & (k >= _MAX_HOPELESS))).nonzero()[:, 0]
        if len(open_) == 0:
            break
        now, T_now, whiten_now = tuple(a[open_] for a in joints), T[open_], whiten[open_]
        H, g, scale = normal_equations(_jacobian(kind, now, T_now, whiten_now), r[open_])
        step = torch.linalg.solve(H + damping[open_, None, None] * torch.eye(H.shape[-1]).to(H), -g) / scale
        trial = moved(kind, now, step, levers[open_])
        r_trial = _residuals(kind, trial, T_now, whiten_now)
        trial_cost = (r_trial * r_trial).sum(-1)
        better, gain = trial_cost <= cost[open_], cost[open_] - trial_cost
        # Where no step goes down any more only rounding is left. Far axes creep along their valley to no purpose.
        tolerance = torch.where(hopeless[open_], 1e-4, 1e-8)
        creeps = (gain > 0.25 * last_gain[open_]) & (gain <= _CREEP * (cost[open_] / r.shape[1]).clamp_min(1))
        done = creeps | (gain <= tolerance * cost[open_] + 1e-16)
        converged[open_] = torch.where(better, done, damping[open_] > 1e6)
        last_gain[open_] = torch.where(better, gain, last_gain[open_])
        damping[open_] = torch.where(better, (damping[open_] / 10).clamp_min(1e-12), damping[open_] * 10)
        iterations[open_] += 1
        found = open_[better]
        for a, b in zip((*joints, r, cost), (*trial, r_trial, trial_cost), strict=True):
            a[found] = b[better]
    return joints, iterations, converged


def normal_equations(J: Tensor, r: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """J^T J and J^T r for columns of unit length, and their lengths: so that metres and radians weigh the same."""
    scale = torch.linalg.vector_norm(J, dim=-2).clamp_min(1e-60)
    J = J / scale[..., None, :]
    return J.mT @ J, (J.mT @ r[..., None])[..., 0], scale


def inverse_hessian(J: Tensor) -> Tensor:
    """(J^T J)^-1 [..., K, K]; a direction that the data do not see comes out large, not infinite."""
    H, _, scale = normal_equations(J, J[..., 0])
    C = torch.linalg.inv(H + 1e-14 * torch.eye(H.shape[-1]).to(H))
    return C / (scale[..., :, None] * scale[..., None, :])


def _closed_form(kind: str, T: Tensor) -> Joints:
    """The common axis of all states: the principal direction of their turns (or slides), and its least-squares line.

    Of spherical joints the least-squares centre.
    """
    R, t = T[..., :3, :3], T[..., :3, 3]
    zero, up = torch.zeros_like(t[:, 0]), torch.tensor([0.0, 0.0, 1.0]).to(t).expand_as(t[:, 0])
    if kind == "fixed":
        return up, zero, zero[:, 0], t[..., :0]
    if kind == "spherical":
        return up, _fixed_point(R, t, torch.eye(3).to(t).expand(len(t), 3, 3)), zero[:, 0], so3_log(R)
    along = t if kind == "prismatic" else so3_log(R)
    axis = torch.linalg.svd(along).Vh[:, 0]
    values = along @ axis[..., None]
    if kind == "prismatic":
        return axis, zero, zero[:, 0], values
    slides = t @ axis[..., None]
    pitch = zero[:, 0]
    if kind == "screw":
        pitch = (slides * values).sum((-2, -1)) / (values * values).sum((-2, -1)).clamp_min(1e-300)
    point = _fixed_point(R, t - slides * axis[:, None], across(axis))
    return axis, point, pitch, torch.cat([slides, values], -1) if kind == "cylindrical" else values


def _fixed_point(R: Tensor, t: Tensor, span: Tensor) -> Tensor:
    """The points [B, 3] in the span of columns [B, 3, K] that the motions (R, t) [B, n] move least."""
    A = ((torch.eye(3).to(R) - R) @ span[:, None]).flatten(1, 2)
    # The tiny constants matter to directions without a turn across them only: the point is then next to the centroid.
    H = A.mT @ A
    tiny = 1e-28 + 1e-14 * H.diagonal(dim1=-2, dim2=-1).sum(-1)
    damped = H + tiny[:, None, None] * torch.eye(H.shape[-1]).to(H)
    return (span @ torch.linalg.solve(damped, A.mT @ t.flatten(1, 2)[..., None]))[..., 0]


def _residuals(kind: str, joints: Joints, T: Tensor, whiten: Tensor) -> Tensor:
    """What the model leaves, T = model exp(x), in standard deviations [B, 6 n]."""
    x = se3_log(inverse(model_motions(kind, joints)) @ T)
    return (whiten @ x[..., None]).flatten(1)


def _jacobian(kind: str, joints: Joints, T: Tensor, whiten: Tensor) -> Tensor:
    """Derivatives [B, 6 n, K] of the residuals by the parameters of `body_twists`."""
    x = se3_log(inverse(model_motions(kind, joints)) @ T)
    return -(whiten @ inverse_left_jacobian(x) @ body_twists(kind, joints)).flatten(1, 2)


def _results(
    kind: str,
    joints: Joints,
    T: Tensor,
    whiten: Tensor,
    points: list[Tensor],
    cost: Tensor,
    iterations: Tensor,
    converged: Tensor,
) -> list[JointFit]:
    axis, point, pitch, values = joints
    model = model_motions(kind, joints)
    if kind in ("revolute", "cylindrical"):
        turns = torch.remainder(values[..., -1:] + math.pi, 2 * math.pi) - math.pi
        values = torch.cat([values[..., :-1], turns], -1)
    sign = torch.ones_like(cost)[:, None]
    if kind not in ("fixed", "spherical"):
        last = values[..., -1]
        sign = torch.where(last.gather(1, last.abs().argmax(1, keepdim=True)) < 0, -sign, sign)
    covariances = [{}] * len(points) if kind == "fixed" else _covariances(kind, joints, T, whiten, cost, sign)
    axis, values = axis * sign, values_of(kind, pad(values * sign[..., None], (0, 0, 1, 0)))
    parameters = whiten.shape[1] * 6 - _freedom(kind, values.shape[1])
    return [
        JointFit(
            type=kind,
            axis=axis[i],
            origin=point[i],
            pitch=float(pitch[i]),
            values=values[i],
            residual=mean_distance(points[i], T[i], model[i]),
            score=float(cost[i]) + _PENALTY * parameters + _RARE.get(kind, 0.0),
            chi2=float(cost[i]),
            converged=bool(converged[i]),
            iterations=int(iterations[i]),
            covariance=covariances[i],
        )
        for i in range(len(points))
    ]


def _covariances(
    kind: str, joints: Joints, T: Tensor, whiten: Tensor, cost: Tensor, sign: Tensor
) -> list[dict[str, Tensor]]:
    """Blocks of the inverse Hessian. A direction that the data do not see comes out large, not zero.

    `sign` [B, 1]: -1 where axis and values are to be turned round.
    """
    axis, _, _, values = joints
    J = _jacobian(kind, joints, T, whiten)
    freedom = J.shape[1] - J.shape[2]
    inflation = (cost / freedom).clamp_min(1) if freedom > 0 else torch.ones_like(cost)
    C = inflation[:, None, None] * inverse_hessian(J)
    blocks = covariance_blocks(kind, axis, values, C)
    if "axis_origin" in blocks:
        blocks["axis_origin"] = sign[..., None] * blocks["axis_origin"]
    return [{name: block[i] for name, block in blocks.items()} for i in range(len(J))]
