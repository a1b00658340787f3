"""Initial motions of all parts: registration proposes, renderings into the other state's views choose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import from_rotation_translation, so3_log
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.motion_preference import (
    ALIKE,
    AS_WELL,
    DOUBTFUL,
    HALF_TURN,
    OTHERWISE,
    SIMILAR_TURN,
    SUSPECT,
    TURNED_OVER,
    looks_alike,
    prefer_less_turn,
    prefer_slide,
    prefer_turn,
    prefer_upright,
)
from splatart_ns.stages.part_pair import IN_EVEN_LIGHT, PartPair, part_pair
from splatart_ns.stages.refinement import Refinement, increment, refine, shifted
from splatart_ns.stages.registration import MIN_POINTS, distinct, part_points, point_to_plane, register
from splatart_ns.stages.shading import without_shading
from splatart_ns.stages.symmetric_turns import symmetric_turns

VIEWS = 5
"""Views of each state that are compared."""
DOUBTFUL_VIEWS = 12
"""So many where these leave the motion in doubt: what tells may show in few."""
COARSE_PIXELS = 1500
"""Choosing needs no more pixels a view than this."""
TINY_PIXELS = 400
"""Searching widely needs no more than this."""
GLANCE_VIEWS = 2
"""Views of each state, of so few pixels, that tell hopeless candidates."""
HOPELESS = 4.0
"""These cost more than this many times the best."""
FINE_PIXELS = 10000
"""Refining needs as many; coarse images would bias it."""
COARSE_STEPS, FINE_STEPS = 5, 10
"""Iterations of a refinement on few pixels, which only brings near, and on many."""
SIMILAR = 2.5
"""Candidates that cost more than this many times the best are dropped before refining."""
OTHERS = 2
"""So many of these are kept beside the best."""
EXPLAINED = 1.8
"""Of such a part a motion that fits the images of one state at most this many times worse than that state's own
Gaussians is preferred to what fits them as many times worse than it. Right ones measured 0.4 to 1.2 in one of the
states (22 of 25), a wrong one 4."""
ENOUGH = 0.2
"""If that state shows at least this share of the part's pixels."""
SEARCH_STEPS = (0.6, 0.3, 0.15, 0.08)
"""Steps of that search: part radii, and radians."""
STILL_RATIO = 1.2
"""A part whose images fit no motion worse than this many times the best motion did not move."""
RESTS_RATIO = 1.05
"""Whether it did is in doubt where they fit worse than this: parts that rest measured 1.003 to 1.035 (one each of 12
objects), wheels, knobs and a turntable that turned, of which much is hidden, 1.06 to 1.14 (six of two)."""
SHADED_RATIO = 2.0
"""Nor one that fits no motion worse than this and would have turned far, if in even light it fits as well unmoved: what
moved beside it shades it otherwise."""


@dataclass(frozen=True)
class InitialMotion:
    """A part's motion from state 0 to another state, before the poses of all parts are refined together."""

    T: Tensor
    """[4, 4] float64."""
    found: bool
    """False when the part has too few Gaussians in one of the states; T is then the identity."""
    still: bool = False
    """Whether the part did not move; T is then the identity."""
    cost: float = float("nan")
    """Mean Huber cost per pixel of the part (see part_pair)."""
    identity_ratio: float = float("nan")
    """Cost of no motion over the best cost."""
    alike: tuple[Tensor, ...] = ()
    """Motions [4, 4] that turn the part quite otherwise and render as well, the best first."""
    maybe_moved: bool = False
    """Whether another motion fits a still part somewhat better."""


def initial_motion(
    splats: tuple[Splat, Splat],
    views: tuple[Sequence[View], Sequence[View]],
    seen: tuple[Tensor, Tensor],
    part: int,
    seed: int = 0,
) -> InitialMotion:
    """The motion of one part between two states.

    Args:
        splats: The labelled splats of the one and the other state.
        views: Their training views.
        seen: The `visibility` of each state's Gaussians.
    """
    source, target = (part_points(s, v, part) for s, v in zip(splats, seen, strict=True))
    identity = torch.eye(4, dtype=torch.float64, device=splats[0].means.device)
    if min(len(source.xyz), len(target.xyz)) < MIN_POINTS:
        return InitialMotion(identity, found=False)
    coarse = part_pair(splats, views, part, VIEWS, COARSE_PIXELS)
    fine = part_pair(splats, views, part, VIEWS, FINE_PIXELS)
    if fine is not None:
        own_cost, identity_cost = fine.own_cost(), float(fine.cost(identity[None])[0])
        if identity_cost < STILL_RATIO * own_cost:  # no motion fits much better than a state's own Gaussians
            return InitialMotion(identity, found=True, still=True, cost=identity_cost, identity_ratio=1.0)
    registered = torch.from_numpy(register(source, target, seed)).to(identity)
    if coarse is None or fine is None:
        return InitialMotion(registered[0], found=True)
    tiny = part_pair(splats, views, part, GLANCE_VIEWS, TINY_PIXELS)
    proposed = torch.cat([identity[None], registered])
    glance = appearance_cost(tiny, proposed)
    hopeful = proposed[torch.from_numpy(glance <= HOPELESS * glance.min())]
    closer = torch.from_numpy(point_to_plane(source, target, hopeful.numpy(force=True))).to(identity)
    everything, candidates = torch.cat([proposed, closer]), torch.cat([hopeful, closer])
    chosen = choose(coarse, candidates, SIMILAR)
    if float(coarse.cost(identity[None])[0]) < STILL_RATIO * float(coarse.cost(chosen[:1])[0]):
        chosen = identity[None]
    ends = refined(coarse, fine, chosen)
    if min(e.cost for e in ends) > SUSPECT * own_cost:
        ends += searched_widely(part_pair(splats, views, part, 3, TINY_PIXELS), coarse, fine, everything)
    T, cost, order = ranked(fine, ends)
    state = None
    if ends[order[0]].cost > SUSPECT * own_cost:
        state, ends = explained_by_one_state(coarse, fine, everything, ends, order[0])
    if state is not None:
        coarse, fine = coarse.shown_by(state), fine.shown_by(state)
        identity_cost = float(fine.cost(identity[None])[0])
        T, cost, order = ranked(fine, ends)
    moved = identity_cost >= STILL_RATIO * ends[order[0]].cost
    doubtful = in_doubt(tiny, coarse, fine, T, cost, order, moved)
    if len(doubtful):
        coarse, fine = (part_pair(splats, views, part, DOUBTFUL_VIEWS, n) for n in (COARSE_PIXELS, FINE_PIXELS))
        if state is not None:
            coarse, fine = coarse.shown_by(state), fine.shown_by(state)
        identity_cost = float(fine.cost(identity[None])[0])
        ends = refined(coarse, fine, choose(coarse, torch.cat([doubtful, candidates]), SIMILAR))
        T, cost, order = ranked(fine, ends)
    best = ends[order[0]]
    identity_ratio = identity_cost / max(best.cost, 1e-12)
    still = identity_ratio < STILL_RATIO
    least = min(end.cost for end in ends)  # the preferred one may cost more, and says nothing of rest
    if not still and identity_cost < SHADED_RATIO * least and so3_log(best.T[:3, :3]).norm() > OTHERWISE / 2:
        even = part_pair(splats, views, part, DOUBTFUL_VIEWS, FINE_PIXELS)
        stayed, turned = replace(even, **IN_EVEN_LIGHT).cost(torch.stack([identity, best.T])).tolist()
        still = stayed < STILL_RATIO * turned
    maybe_moved = still and identity_ratio > RESTS_RATIO
    own = own_appearance(fine)
    alike = () if still else tuple(ends[i].T for i in order if looks_alike(T, cost, order[0], i, own))
    return InitialMotion(
        identity if still else best.T,
        found=True,
        still=still,
        cost=best.cost,
        identity_ratio=identity_ratio,
        alike=alike,
        maybe_moved=maybe_moved,
    )


def searched_widely(small: PartPair, coarse: PartPair, fine: PartPair, candidates: Tensor) -> list[Refinement]:
    """What compass searches from the most hopeful of `candidates` [C, 4, 4], on few pixels, end in, refined."""
    wide = torch.stack([search(small, T) for T in choose(coarse, candidates, float("inf"), keep=5)])
    return [refine(fine, T, FINE_STEPS) for T in choose(coarse, wide, 1.5)]


def in_doubt(
    tiny: PartPair, coarse: PartPair, fine: PartPair, T: np.ndarray, cost: np.ndarray, order: list[int], moved: bool
) -> Tensor:
    """Motions [K, 4, 4] among which more views must choose: those of T [C, 4, 4], `ranked` by cost [C] and order, and
    what `turned_alike` finds. None where the first of them, or that the part did not move, is beyond doubt."""
    known = torch.from_numpy(T[order]).to(fine.centroid.device)
    turned = turned_alike(tiny, coarse, known[0]) if moved else known[:0]
    times = DOUBTFUL if so3_log(known[0, :3, :3]).norm() > TURNED_OVER else ALIKE
    own = own_appearance(fine)
    if len(turned) or moved and any(looks_alike(T, cost, order[0], i, own, times) for i in order):
        return torch.cat([known, turned])
    return known[:0]


def explained_by_one_state(
    coarse: PartPair, fine: PartPair, candidates: Tensor, ends: Sequence[Refinement], best: int
) -> tuple[int | None, Sequence[Refinement]]:
    """The state whose images a motion explains that the best of `ends` does not, and that motion with its rivals.

    A drawer that is shut in one state shows nothing but its front there: moved to where the other state shows all of
    it, it misses most of that, and may miss less if it is turned so as to cover it. Moved the other way, all that is
    seen is there. None, and `ends`, where no motion explains the images of a state.
    """
    for state in (0, 1):
        few, many = coarse.shown_by(state), fine.shown_by(state)
        if many.area < ENOUGH * fine.area:
            continue
        rivals = refined(few, many, choose(few, candidates, SIMILAR))
        least = min(end.cost for end in rivals)
        if least < EXPLAINED * many.own_cost() and float(many.cost(ends[best].T[None])[0]) > EXPLAINED * least:
            return state, rivals
    return None, ends


def turned_alike(tiny: PartPair, coarse: PartPair, T: Tensor) -> Tensor:
    """Motions [K, 4, 4] quite other than T [4, 4] that a symmetric part, turned so that it looks alike, may have made.

    Registration may have missed the right one of them.
    """
    R, centroid = symmetric_turns(coarse.splats[0]), coarse.centroid
    turned = torch.cat([T[None], T @ from_rotation_translation(R, centroid - R @ centroid)])
    cost = appearance_cost(tiny, turned)
    turned = turned[1:][torch.from_numpy(cost[1:] <= HOPELESS * cost[0])]
    if len(turned) == 0:
        return turned
    nearest = [refine(coarse, near, COARSE_STEPS).T for near in choose(coarse, turned, float("inf"))]
    ends = torch.stack([T, *nearest])
    cost, motions = appearance_cost(coarse, ends), ends.cpu().numpy()
    own = own_appearance(coarse)
    return ends[[i for i in range(len(ends)) if looks_alike(motions, cost, 0, i, own)]]


def alike_in_even_light(
    splats: tuple[Splat, Splat],
    views: tuple[Sequence[View], Sequence[View]],
    part: int,
    T: Tensor,
    candidates: Tensor,
) -> list[Tensor]:
    """Motions [4, 4] near `candidates` [C, 4, 4] that in even light render a part nearly as well as T [4, 4] does, or
    as each state's own Gaussians do, the best first.

    In even light nothing is told by how what turned is lit, nor by how what is turned over would be.
    """
    if len(candidates) == 0:
        return []
    coarse = part_pair(splats, views, part, VIEWS, COARSE_PIXELS)
    fine = part_pair(splats, views, part, DOUBTFUL_VIEWS, FINE_PIXELS)
    if coarse is None or fine is None:
        return []
    even, evenly = (replace(pair, **IN_EVEN_LIGHT) for pair in (coarse, fine))
    near = [refine(even, start, COARSE_STEPS) for start in choose(coarse, candidates, float("inf"))]
    least = min(end.cost for end in near)
    ends = [refine(evenly, end.T, FINE_STEPS) for end in near if end.cost <= SIMILAR_TURN * least]
    limit = max(ALIKE * refine(evenly, T, FINE_STEPS).cost, AS_WELL * evenly.own_cost())
    return [end.T for end in sorted(ends, key=lambda end: end.cost) if end.cost < limit]


def refined(coarse: PartPair, fine: PartPair, candidates: Tensor) -> list[Refinement]:
    """The motions [C, 4, 4] refined on many pixels, of several those that render best once refined on few.

    If the best turns the part over, `mere_shifts` come last, for `prefer_slide`.
    """
    if len(candidates) > 1:
        near = [refine(coarse, T, COARSE_STEPS) for T in candidates]
        least = min(near, key=lambda end: end.cost)
        half_turn = so3_log(least.T[:3, :3]).norm() > HALF_TURN  # to which `prefer_less_turn` may prefer dearer ones
        times = DOUBTFUL if half_turn else 1.5
        candidates = choose(coarse, torch.stack([end.T for end in near]), times, own=own_appearance(coarse))
    ends = [refine(fine, T, FINE_STEPS) for T in candidates]
    return [*ends, *mere_shifts(fine, ends)]


def mere_shifts(pair: PartPair, ends: Sequence[Refinement]) -> list[Refinement]:
    """If the best of some motions turns a part over: shifts to where that puts it, and to where the one does that turns
    it least.

    What is turned over comes to lie elsewhere: a tray that was pushed in, by half its width.
    """
    turns = [float(so3_log(end.T[:3, :3]).norm()) for end in ends]
    best = min(range(len(ends)), key=lambda i: ends[i].cost)
    if turns[best] <= TURNED_OVER:
        return []
    straightest = min(range(len(ends)), key=turns.__getitem__)
    return [shifted(pair, ends[i].T) for i in dict.fromkeys((best, straightest))]


def ranked(pair: PartPair, ends: Sequence[Refinement]) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Motions [C, 4, 4], what they cost [C], and the distinct ones of them in the order in which they are preferred."""
    T = torch.stack([e.T for e in ends])
    cost, T = appearance_cost(pair, T), T.cpu().numpy()
    order = distinct(T, cost, pair.centroid.cpu().numpy(), pair.radius)
    own = own_appearance(pair)
    upright = cost[order[0]] < AS_WELL * own and prefer_upright(T, cost, order)
    order = upright or prefer_slide(T, cost, order, own)
    return T, cost, prefer_less_turn(T, cost, prefer_turn(T, cost, order, pair.radius))


def search(pair: PartPair, T: Tensor) -> Tensor:
    """A motion near T [4, 4] that renders better, by a compass search with ever smaller steps (Hooke and Jeeves 1961).

    Gauss-Newton sees no further than a few pixels; this steps over what lies between.
    """
    moves = torch.cat([torch.eye(6), -torch.eye(6)]).to(T)
    cost = float(pair.cost(T[None])[0])
    for step in SEARCH_STEPS:
        for _ in range(4):
            trials = increment(T.expand(len(moves), 4, 4), step * moves, pair.centroid, pair.radius)
            costs = pair.cost(trials)
            if float(costs.min()) >= cost:
                break
            T, cost = trials[costs.argmin()], float(costs.min())
    return T


def appearance_cost(pair: PartPair, T: Tensor) -> np.ndarray:
    """Of motions T [C, 4, 4]: the mean cost with the colours as they are lit, and with their hues alone [C]."""
    return (0.5 * (pair.cost(T) + without_shading(pair).cost(T))).cpu().numpy()


def own_appearance(pair: PartPair) -> float:
    """What `appearance_cost` would be if each state's Gaussians were looked at in their own state's views.

    A motion that costs no more fits as well as any: what fits still better does so by what no image of its own state
    shows, as a button that is turned over does by its back.
    """
    return 0.5 * (pair.own_cost() + without_shading(pair).own_cost())


def choose(pair: PartPair, candidates: Tensor, similar: float, keep: int = 3, own: float = 0.0) -> Tensor:
    """The distinct motions [K, 4, 4] among `candidates` [C, 4, 4] that render best, best first.

    At most `keep`, and a few that turn the part quite otherwise: those may be one motion found several times. None
    costs more than `similar` times the best, but for what fits as each state's `own` Gaussians do.
    """
    cost = appearance_cost(pair, candidates)
    order = distinct(candidates.cpu().numpy(), cost, pair.centroid.cpu().numpy(), pair.radius)
    R = Rotation.from_matrix(candidates[:, :3, :3].cpu().numpy())
    chosen = order[:keep]
    for i in order[keep:]:
        if len(chosen) < keep + OTHERS and (R[chosen] * R[i].inv()).magnitude().min() > OTHERWISE:
            chosen.append(i)
    limit = max(similar * cost[order[0]], AS_WELL * own)
    return candidates[[i for i in chosen if cost[i] <= limit]]
