"""Joints of all pairs of parts, either of which may be the parent."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from splatart_ns.geometry.se3 import adjoint, inverse, transform_points, translation
from splatart_ns.stages.joint import EPSILON, NOISE, fit_joints, surface_noise, types_for
from splatart_ns.stages.joint_constraint import JointConstraint
from splatart_ns.stages.joint_descent import descend_joint
from splatart_ns.stages.joint_fit import JointFit, free_joint
from splatart_ns.stages.unseen import known_states, may_have_turned, relative_motion, states_shown


def fit_pairs(
    points: dict[int, Tensor],
    motions: dict[int, Tensor],
    object_radius: float,
    *,
    covariances: dict[int, Tensor] | None = None,
    render_ratios: dict[tuple[int, int], float] | None = None,
    noise: float = NOISE,
    epsilon: float = EPSILON,
    types: Sequence[str] | None = None,
) -> dict[tuple[int, int], JointFit]:
    """Joints of all pairs by (parent, child), both ways round; arguments as in `infer_tree` and `fit_joint`."""
    motions = {p: T.double() for p, T in motions.items()}
    states = known_states(motions, covariances)
    # What stood still is known exactly: all errors of the pair are the other part's, which is then the child.
    still = {p: bool(states[p].all()) and stood_still(p, motions, covariances) for p in points}
    # So is what is not known at state 0.
    order = sorted(points, key=lambda p: (not states[p][0], not still[p], p))
    pairs = [(a, b) for k, a in enumerate(order) for b in order[k + 1 :]]
    if not pairs:
        return {}
    ratios = render_ratios or {}
    # The parent's error reaches the child by its lever arm; the child's own is added by `fit_joints`.
    errors = {p: surface_error(points[p].double(), motions[p], noise, object_radius) for p in points}
    errors |= {p: torch.zeros_like(errors[p]) for p in points if still[p]}
    relative = [relative_motion(motions[a], motions[b], states[a], states[b]) for a, b in pairs]
    T_rel, places, known_rel = (torch.stack(of_pairs) for of_pairs in zip(*relative, strict=True))
    to_parent = adjoint(torch.stack([inverse(motions[a]) for a, _ in pairs]))
    known = torch.stack([errors[a] for a, _ in pairs])
    if covariances is not None:
        moved = {p: covariances[p] * (not still[p]) for p in points}
        known = known + torch.stack([moved[a] + moved[b] for a, b in pairs]).to(known)
    known = torch.where(known_rel[..., None, None], known, torch.nan)
    fits = fit_joints(
        T_rel,
        [transform_points(place, points[b].to(place)) for (_, b), place in zip(pairs, places, strict=True)],
        object_radius,
        to_parent @ known @ to_parent.mT,
        noise,
        epsilon,
        [ratios.get((a, b), ratios.get((b, a))) for a, b in pairs],
        types,
    )
    return _both_ways(pairs, fits, T_rel, points)


def told_pair(
    constraint: JointConstraint,
    joints: Mapping[tuple[int, int], JointFit],
    points: dict[int, Tensor],
    motions: dict[int, Tensor],
    object_radius: float,
    excluded: Collection[str] = (),
    **settings: Any,
) -> dict[tuple[int, int], JointFit]:
    """The joints, both ways round, of a pair of parts as the user wants them, accepted or not; none where the types
    that are ruled out leave none.

    `excluded`: the types that the user rules out; `settings` as in `fit_pairs`.
    """
    kind, pair = constraint.type, (constraint.parent, constraint.child)
    edges = pair, pair[::-1]
    fits = {edge: joints[edge] for edge in edges if edge in joints}
    num_shown = states_shown(known_states(motions, settings.get("covariances")), pair)
    if constraint.forbidden:
        if kind is None or not fits:
            return {}
        if fits[pair].type not in excluded:
            return fits
        types = [t for t in types_for(num_shown) if t not in excluded]
        return fit_pairs(points, motions, object_radius, types=types, **settings) if types else {}
    if kind is None and not (fits and fits[pair].accepted):
        # Of two states a turn about a line and a slide along it explain every motion.
        kind = "cylindrical" if num_shown == 2 and "cylindrical" not in excluded else "free"
    if kind == "free":
        fits = {(a, b): free_joint(inverse(motions[a].double()) @ motions[b].double(), points[b]) for a, b in edges}
    elif kind is not None:
        fits = fit_pairs(points, motions, object_radius, types=[kind], **settings)
    return fits


def descend_pairs(
    points: dict[int, Tensor], motions: dict[int, Tensor], object_radius: float, epsilon: float = EPSILON
) -> dict[tuple[int, int], JointFit]:
    """As `fit_pairs`, in the paper's way: of a revolute and a prismatic joint by gradient descent, the better one."""
    pairs = [(a, b) for a in sorted(points) for b in sorted(points) if a < b]
    T_rel = [inverse(motions[a].double()) @ motions[b].double() for a, b in pairs]
    fits = []
    for (_, b), T in zip(pairs, T_rel, strict=True):
        both = [descend_joint(kind, T, points[b]) for kind in ("revolute", "prismatic")]
        best = min(both, key=lambda fit: fit.residual)
        fits.append(replace(best, accepted=best.residual <= epsilon * object_radius))
    return _both_ways(pairs, fits, T_rel, points)


def _both_ways(
    pairs: list[tuple[int, int]], fits: Sequence[JointFit], T_rel: Sequence[Tensor], points: dict[int, Tensor]
) -> dict[tuple[int, int], JointFit]:
    """Joints by (parent, child) from those of pairs (a, b) with motions T_rel of b relative to a."""
    joints = {}
    for (a, b), fit, T in zip(pairs, fits, T_rel, strict=True):
        joints[a, b] = fit
        joints[b, a] = fit.reversed(points[a], inverse(T))
    return joints


def stood_still(part: int, motions: Mapping[int, Tensor], covariances: Mapping[int, Tensor] | None = None) -> bool:
    """Whether a part did not move at all; if its covariances are given, neither may it have turned unseen."""
    T = motions[part]
    return bool((T == torch.eye(4).to(T)).all()) and not (covariances and may_have_turned(covariances[part]).any())


def surface_error(points: Tensor, T: Tensor, noise: float, object_radius: float) -> Tensor:
    """The covariances [S, 6, 6] that the noise gives a part's motions, about the world's origin."""
    to_world = adjoint(T @ translation(points.mean(0).to(T)))
    return to_world @ surface_noise(points, noise, object_radius) @ to_world.mT
