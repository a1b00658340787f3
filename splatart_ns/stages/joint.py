"""Stage 3: the joint between two parts, from their relative motion.

Joints of every type are fitted (`joint_solver`), and the noise decides between them. A registration that is wrong by a
length s at the surface turns a part of radius r by about s / r, so the noise model is s^2 times the inverse of the
points' quadratic form: a finger of a few pixels may turn by degrees where a door may not. The score of a type is
chi^2 + 4 per parameter: a freedom must buy two standard deviations. The lowest score wins among the types that are
accepted, whose residual is small or explained by the noise. Two states make all this necessary: there a revolute joint
(5 parameters for 6 numbers) imitates almost every sliding one (3).

More states offer the types of more freedom, as soon as they have fewer parameters than there are numbers. These
imitate simpler ones all the better, so they pay for being rare: three times -2 ln(1 / 50) = 8, so that they must win
even if the noise is 1.7 times what it is said to be. And where even the best type leaves more than the noise, the
noise was underestimated and chi^2 is divided by that excess, or else every freedom would seem to pay (the
quasi-likelihood criterion: Burnham and Anderson, Model Selection, 2002, section 2.5).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from splatart_ns.geometry.se3 import adjoint, inverse, translation
from splatart_ns.stages.joint_fit import UNSEEN_ROTATION, JointFit
from splatart_ns.stages.joint_parameters import JOINT_DOFS
from splatart_ns.stages.joint_solver import best_joints
from splatart_ns.stages.unseen import unknown_covariance

NOISE = 0.003
"""Default registration error of a part's surface, as a share of the object's bounding radius."""
EPSILON = 0.02
"""Default limit of the residual, as a share of the object's bounding radius."""
PRISMATIC_BELOW = 1.2
"""A joint slides if holding the rotation raises the rendering cost by less than this factor."""

# Parameters of a type besides its values.
_SHAPE = {"fixed": 0, "prismatic": 2, "revolute": 4, "screw": 5, "cylindrical": 4, "spherical": 3, "free": 0}
_PENALTY = 4.0  # score of one parameter
_RARE = {"screw": 24.0, "cylindrical": 24.0, "spherical": 24.0}  # score of a type that few objects have
_EXPLAINED = 3.0  # chi^2 per observed number that is still put down to the noise
_MAX_POINTS = 500
_THIN_LEVER = 0.1  # of the part's radius; more, and less, served some states of a pair of scissors worse
_LEAST_LEVER = 0.005  # of the object's radius
_UNDETERMINED_AXIS = math.radians(15)
_UNDETERMINED_ORIGIN = 0.25  # of the object's radius
_UNKNOWN_ROTATION = math.radians(5)


def surface_noise(points: Tensor, noise: float, object_radius: float) -> Tensor:
    """Covariance [6, 6] of a motion about the centroid of points [N, 3], known to `noise` x `object_radius` at them.

    The variance times the inverse of the quadratic form whose value at a small motion is the points' mean squared
    displacement. The lever of a turn is at least a tenth of the part's own radius, as of a thin rod's about itself,
    which shading tells, and 0.005 of the object's.
    """
    x = points - points.mean(0)
    C = x.mT @ x / x.shape[0]
    lever2 = (_THIN_LEVER**2 * C.trace()).clamp_min((_LEAST_LEVER * object_radius) ** 2)
    inertia = (C.trace() + lever2) * torch.eye(3).to(C) - C
    return (noise * object_radius) ** 2 * torch.block_diag(torch.eye(3).to(C), torch.linalg.inv(inertia))


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
    choose from, by default all that have fewer parameters than the known motions have numbers: fixed, prismatic and
    revolute for two states, also screw, cylindrical and spherical for more. For "free" joints there is `free_joint`.
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
    about = translation(centroids)[:, None]
    T = (inverse(about) @ T_rel @ about)[:, 1:]
    floor = [surface_noise(x, noise, object_radius) for x in points]
    errors = torch.stack(floor)[:, None].expand(*T.shape[:2], 6, 6)
    shown = [T_rel.shape[1]] * len(points)
    if covariances is not None:
        to_body = adjoint(inverse(T_rel @ about)[:, 1:])
        known = to_body @ covariances.to(T_rel)[:, 1:] @ to_body.mT
        told = known.isfinite().all(-1).all(-1)
        errors = errors + torch.where(told[..., None, None], known, unknown_covariance(object_radius).to(T))
        shown = (1 + told.sum(-1)).clamp_min(2).tolist()
    whiten = torch.linalg.inv(torch.linalg.cholesky(errors))
    variances, directions = torch.linalg.eigh(errors[..., 3:, 3:])
    worst_rotation = variances.amax((-2, -1)).sqrt()
    # What a turn that nothing shows amounts to, with the slide that comes with it.
    unseen = (variances > UNSEEN_ROTATION**2) / variances
    unseen = pad(errors[..., 3:] @ directions @ torch.diag_embed(unseen) @ directions.mT, (3, 0))

    # The residual is a mean; it needs no more points than these.
    sampled = [(x - c)[:: math.ceil(len(x) / _MAX_POINTS)] for x, c in zip(points, centroids, strict=True)]
    tried = types or types_for(max(shown, default=2))
    fits = zip(*(best_joints(kind, T, whiten, unseen, sampled) for kind in tried), strict=True)
    ratios = render_ratios or [None] * len(points)
    chosen = []
    for pair, c, n, ratio, sigma in zip(fits, centroids, shown, ratios, worst_rotation, strict=True):
        pair = [_scored(replace(f, origin=f.origin + c, shown=n)) for f in pair if types or f.type in types_for(n)]
        chosen.append(_choose(pair, ratio, float(sigma), object_radius, epsilon))
    return chosen


def types_for(states: int) -> list[str]:
    """The types that have fewer parameters than the motions of that many states have numbers, the simplest first."""
    return [kind for kind in JOINT_DOFS if _freedom(kind, states) > 0]


def _freedom(kind: str, states: int) -> int:
    """How many of the observed numbers a type leaves over."""
    return (6 - JOINT_DOFS[kind]) * (states - 1) - _SHAPE[kind]


def _scored(fit: JointFit) -> JointFit:
    parameters = 6 * (fit.num_shown - 1) - _freedom(fit.type, fit.num_shown)
    return replace(fit, score=fit.chi2 + _PENALTY * parameters + _RARE.get(fit.type, 0.0))


def _choose(
    fits: list[JointFit], render_ratio: float | None, rotation_sigma: float, object_radius: float, epsilon: float
) -> JointFit:
    states = fits[0].num_shown
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
        if rotation_sigma > UNSEEN_ROTATION:  # light alone may tell such turns apart: it overrules no other motion
            allowed = [f for f in allowed if f.accepted]
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


def leaves_unexplained(fit: JointFit) -> bool:
    """Whether a joint leaves more of the motions than the noise explains, however small its residual is.

    It may be two joints in a row, or one of the two parts was posed wrongly.
    """
    return _freedom(fit.type, fit.num_shown) > 0 and fit.chi2 > _explained(fit.type, fit.num_shown)


def _explained(kind: str, states: int) -> float:
    """The chi^2 that is still put down to the noise; for a type that imitates others, by what it leaves over only."""
    return _EXPLAINED * (_freedom(kind, states) if kind in _RARE else 6 * (states - 1))


def _undetermined(fit: JointFit, object_radius: float, rotation_sigma: float) -> list[str]:
    notes = []
    if fit.type == "fixed":
        notes.append("The parts did not move relative to each other, so axis, origin and type are undetermined.")
    if fit.type in ("fixed", "prismatic") and rotation_sigma > UNSEEN_ROTATION:
        notes.append("The part looks alike from some sides, so that it may have turned unseen.")
    sigma = {
        name: math.sqrt(torch.linalg.eigvalsh(C)[-1].clamp_min(0))
        for name, C in fit.covariance.items()
        if name in ("axis", "origin")
    }
    if sigma.get("axis", 0.0) > _UNDETERMINED_AXIS:
        degrees = math.degrees(min(sigma["axis"], math.pi))
        notes.append(f"The axis is undetermined: its standard deviation is {degrees:.0f} degrees.")
    if sigma.get("origin", 0.0) > _UNDETERMINED_ORIGIN * object_radius:
        share = sigma["origin"] / object_radius
        notes.append(f"The origin is undetermined: its standard deviation is {share:.2g} of the object's radius.")
    if not fit.converged:
        notes.append("The fit did not converge, so its figures and their uncertainty are rough.")
    if fit.type in ("revolute", "screw"):
        most = math.sqrt(fit.covariance["values"].diagonal().max().clamp_min(0))
        if most > UNSEEN_ROTATION:
            degrees = math.degrees(min(most, math.pi))
            notes.append(f"The values are undetermined: their standard deviation is up to {degrees:.0f} degrees.")
    return notes
