"""Which state each part is registered against: state 0, or, where that shows hardly any of it, the one that shows most.

Motions M[s] since a reference state and T[s] since state 0 differ by where the part was at state 0:
T[s] = M[s] M[0]^-1. Where no image tells, it is put where it was at its reference state, T[s] = M[s]; the covariance of
its pose at state 0 is NaN, and the other covariances are those of M[s].
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import adjoint, inverse, skew, transform_points
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.pose import part_extents
from splatart_ns.stages.pose_evidence import refine_poses, rotation_held_ratios
from splatart_ns.stages.visibility import shown_of_parts

SHARE = 0.1
"""A part of which state 0 shows less than this share of what another state shows is registered against that one."""
SURE = 0.1
"""Largest standard deviation, in radians and in radii of the part, of a pose at state 0 that a part's other poses can
be counted from. Theirs are never better than its own."""


def reference_states(splats: Sequence[Splat], seen: Sequence[Tensor], num_parts: int) -> list[int]:
    """A state for each part 1..P; `seen` [N] is each splat's `visibility`."""
    amount = shown_of_parts(splats, seen, num_parts)
    return torch.where(amount[0] < SHARE * amount.amax(0), amount.argmax(0), 0).tolist()


def since_state_0(M: Tensor, known: Tensor) -> Tensor:
    """Motions T [S, P, 4, 4] since state 0 from those since the parts' reference states; `known` [S, P] bool."""
    eye = torch.eye(4).to(M)
    T = M @ inverse(torch.where(known[0][:, None, None], M[0], eye))
    return torch.cat([eye.expand_as(T[:1]), T[1:]])


def since_reference(T: Tensor, reference: Sequence[int]) -> Tensor:
    """Motions M [S, P, 4, 4] since the parts' reference states from those since state 0."""
    return T @ inverse(T[list(reference), torch.arange(T.shape[1])])


def refine_known_poses(
    splats: Sequence[Splat],
    views: Sequence[Sequence[View]],
    T: Tensor,
    frozen: Tensor,
    reference: Sequence[int],
    known: Tensor,
    clear: Sequence[Tensor] | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`refine_poses` and `rotation_held_ratios` of every part against its reference state.

    Args:
        splats: One labelled splat per state.
        views: Training views of each state.
        T: Poses [S, P, 4, 4] since state 0.
        frozen: Which of them stay as they are [S, P] bool.
        reference: Each part's reference state.
        known: Which poses were found [S, P] bool.
        clear: See `refine_poses`.

    Returns:
        The refined poses, their covariances [S, P, 6, 6] (NaN where not known), the ratios [P, P], and which poses that
        were to stay do not fit [S, P] bool.
    """
    S, P = T.shape[:2]
    M = since_reference(T, reference)
    covariances = torch.full((S, P, 6, 6), torch.nan, dtype=torch.float64, device=T.device)
    misfits = torch.zeros(S, P, dtype=torch.bool)
    frozen = frozen & known  # where no motion was found nothing is known to rest
    frozen[list(reference), torch.arange(P)] = True
    for order, parts in _groups(reference, known):
        chosen = _chosen(splats, views, order, parts)
        shares = clear and [clear[s][_of(splats[s], parts)] for s in order]
        refined, certainty, unfit = refine_poses(*chosen, M[order], frozen[order], shares)
        for p in parts:
            M[order, p], covariances[order, p], misfits[order, p] = refined[:, p], certainty[:, p], unfit[:, p]
    for p, first in enumerate(reference):
        if first == 0:
            continue
        if not is_sure(M[0, p], covariances[0, p], *(x[p] for x in part_extents(splats[first], P)), SURE):
            covariances[0, p] = torch.nan
            continue
        # M = exp(d) M_true, so that T = M[s] M[0]^-1 has the errors of both.
        Ad = adjoint(M[:, p] @ inverse(M[0, p]))
        covariances[:, p] += Ad @ covariances[0, p] @ Ad.mT
        covariances[0, p] = 0
    certain = covariances.isfinite().flatten(2).all(-1)
    T = since_state_0(M, certain)
    ratios = torch.full((P, P), torch.nan, device=T.device)
    for order, parts in _groups(reference, certain):
        since_first = T[order] @ inverse(T[order[0]])
        found = rotation_held_ratios(*_chosen(splats, views, order, parts), since_first).to(ratios)
        against = certain[order].all(0)[:, None]
        ratios[:, parts] = torch.where(against, found[:, parts], torch.nan)
    return T, covariances, ratios, misfits


def _groups(reference: Sequence[int], known: Tensor) -> Iterator[tuple[list[int], list[int]]]:
    """States, the reference first, and the parts (counted from 0) that are known in just these."""
    groups: dict[tuple[int, ...], list[int]] = {}
    for p, first in enumerate(reference):
        states = (first, *(s for s in range(len(known)) if s != first and known[s, p]))
        groups.setdefault(states, []).append(p)
    yield from ((list(states), parts) for states, parts in groups.items())


def _chosen(
    splats: Sequence[Splat], views: Sequence[Sequence[View]], states: Sequence[int], parts: Sequence[int]
) -> tuple[list[Splat], list[Sequence[View]]]:
    """Some states in another order, with some parts (counted from 0) alone."""
    return [splats[s].select(_of(splats[s], parts)) for s in states], [views[s] for s in states]


def _of(splat: Splat, parts: Sequence[int]) -> Tensor:
    """Which Gaussians [N] are of some parts (counted from 0)."""
    return torch.isin(splat.part_ids, torch.tensor(parts).to(splat.part_ids) + 1)


def is_sure(M: Tensor, covariance: Tensor, centroid: Tensor, radius: Tensor, within: float) -> bool:
    """Whether no standard deviation of a pose M [4, 4] is larger than `within`, in radians and in radii of the
    part; `centroid` [3] of the part before it."""
    if not covariance.isfinite().all():
        return False
    shift = torch.cat([torch.eye(3).to(M), -skew(transform_points(M, centroid[None])[0])], dim=1)
    variances = (
        torch.linalg.eigvalsh(shift @ covariance @ shift.mT)[-1],
        torch.linalg.eigvalsh(covariance[3:, 3:])[-1],
    )
    return bool(variances[0] <= (within * radius) ** 2) and bool(variances[1] <= within**2)
