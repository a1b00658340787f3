"""Parts that no image shows in some states: what is known of their motions, and where they are put.

A pose whose covariance is not finite is unknown. Two parts are compared in the states in which both are known. Where
one of them is not known at state 0, the first such state takes its place: the child is put where it was then relative
to its parent, and its joint has the same value. In other unknown states it moves with its parent.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from splatart_ns.geometry.se3 import inverse, skew, so3_log
from splatart_ns.stages.articulate import KinematicTree
from splatart_ns.stages.joint_fit import UNSEEN_ROTATION

_UNTURNED = 5
"""Degrees by which a part that did not turn, or about its axis of symmetry alone, may seem to have turned."""


def known_states(motions: Mapping[int, Tensor], covariances: Mapping[int, Tensor] | None) -> dict[int, Tensor]:
    """Of each part [S] bool, from covariances [S, 6, 6]; all if there are none."""
    if covariances is None:
        return {p: torch.ones(len(T), dtype=torch.bool, device=T.device) for p, T in motions.items()}
    return {p: covariances[p].isfinite().flatten(1).all(-1) for p in motions}


def unknown_covariance(object_radius: float) -> Tensor:
    """That of a motion [6, 6] of which nothing is known, (translation, rotation): finite, but wider than all that is
    likely."""
    return torch.diag(torch.tensor([10 * object_radius] * 3 + [10.0] * 3, dtype=torch.float64)) ** 2


def may_have_turned(covariances: Tensor) -> Tensor:
    """Which motions [...], from their covariances [..., 6, 6], are of parts that may have turned by any angle."""
    rotation = covariances[..., 3:, 3:].double().nan_to_num()
    return torch.linalg.eigvalsh(rotation)[..., -1] > UNSEEN_ROTATION**2


def unturned(T: Tensor) -> Tensor:
    """Which motions T [..., 4, 4] hardly turn a part: bool [...]."""
    return so3_log(T[..., :3, :3]).norm(dim=-1) < math.radians(_UNTURNED)


def least_turn(T: Tensor, axis: Tensor) -> Tensor:
    """The angle about an axis [3] after which a motion T [4, 4] turns least.

    About the axis w it makes the trace of exp(angle [w]x) R largest: w^T R w + cos (tr R - w^T R w) + sin tr([w]x R).
    """
    R = T[:3, :3]
    return torch.atan2((skew(axis) @ R).trace(), R.trace() - axis @ R @ axis)


def as_seen(covariances: Tensor) -> Tensor:
    """Covariances [..., 6, 6] of parts that turned by nothing about the lines about which images do not tell it."""
    C = covariances.double()
    variances, directions = torch.linalg.eigh(C[..., 3:, 3:].nan_to_num())
    unseen = torch.where(variances > UNSEEN_ROTATION**2, 1 / variances.clamp_min(1e-300), 0.0)
    gain = C[..., 3:] @ directions @ torch.diag_embed(unseen) @ directions.mT
    return C - gain @ C[..., 3:, :]


def states_shown(known: Mapping[int, Tensor], pair: tuple[int, int]) -> int:
    """In how many states two parts are compared, 2 at least, from what is `known` of each [S]."""
    a, b = pair
    return max(2, int((known[a] & known[b]).sum()))


def leads_blindly(known_a: Tensor, known_b: Tensor) -> bool:
    """Whether part b was seen in states in which part a was not, and a joint to a would say nothing of its motion: no
    two states show both [S]."""
    return int((known_a & known_b).sum()) < 2 and bool((known_b & ~known_a).any())


def relative_motion(T_a: Tensor, T_b: Tensor, known_a: Tensor, known_b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """How part b moves relative to part a, from their motions [S, 4, 4] and what is known of them [S].

    Returns:
        The motions [S, 4, 4], the first the identity; where b is to be put at state 0 first, [4, 4] in the canonical
        frame; and which of the motions say something [S].
    """
    known = known_a & known_b
    R, eye = inverse(T_a) @ T_b, torch.eye(4).to(T_b)
    if known.all():
        return R, eye, known
    place = eye
    if not known[0] and known.any():
        first = int(known.int().argmax())
        place = R[first]
        known = known & (torch.arange(len(known), device=known.device) != first)
    return torch.where(known[:, None, None], R @ inverse(place), eye), place, known


def place_unseen(
    tree: KinematicTree, motions: Mapping[int, Tensor], known: Mapping[int, Tensor]
) -> tuple[dict[int, Tensor], dict[int, Tensor], dict[int, Tensor]]:
    """Where the parts of a tree are put at state 0, [4, 4] by part; their motions from there [S, 4, 4], those that are
    unknown being their parents'; and which of these say something [S]."""
    places = {p: torch.eye(4).to(T) for p, T in motions.items()}
    motions, known = dict(motions), dict(known)
    for joint in tree.joints:
        a, b = joint.parent, joint.child
        if not known[b].all():
            R, places[b], known[b] = relative_motion(motions[a], motions[b], torch.ones_like(known[b]), known[b])
            motions[b] = motions[a] @ R
    return places, motions, known
