"""Which of several proposed motions of a part is right: renderings into the views of the other state tell."""

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
    TURNED_OVER,
    looks_alike,
    prefer_less_turn,
    prefer_slide,
    prefer_turn,
    prefer_upright,
)
from splatart_ns.stages.part_pair import IN_EVEN_LIGHT, PartPair, part_pair
from splatart_ns.stages.refinement import Refinement, increment, refine, shifted
from splatart_ns.stages.registration import distinct
from splatart_ns.stages.shading import without_shading
from splatart_ns.stages.symmetric_turns import symmetric_turns

VIEWS = 5
"""Views of each state that are compared."""
DOUBTFUL_VIEWS = 12
"""So many where these leave the motion in doubt: what tells may show in few."""
COARSE_PIXELS = 1500
"""Choosing needs no more pixels a view than this."""
TINY_PIXELS = 400
"""A glance, and searching widely, need no more than this."""
HOPELESS = 4.0
"""Candidates that at a glance cost more than this many times the best are not looked at again."""
FINE_PIXELS = 10000
"""Refining needs as many; coarse images would bias it."""
COARSE_STEPS, FINE_STEPS = 5, 10
"""Iterations of a refinement on few pixels, which only brings near, and on many."""
SIMILAR = 2.5
"""Candidates that cost more than this many times the best are dropped before refining."""
REFINED_SIMILAR = 1.5
"""Once refined on few pixels, those that cost more than this many times the best are not refined on many."""
KEPT, OTHERS = 3, 2
"""So many of the best are kept, and beside them so many that turn the part quite otherwise."""
WIDE_STARTS = 5
"""A wide search starts from so many."""
EXPLAINED = 1.8
"""Of a part of which one state hides most, a motion that fits the images of one state at most this many times worse
than that state's own Gaussians is preferred to what fits them as many times worse than it. Right ones measured 0.4 to
1.2 in one of the states (22 of 25), a wrong one 4."""
ENOUGH = 0.2
"""If that state shows at least this share of the part's pixels."""
SEARCH_STEPS = (0.6, 0.3, 0.15, 0.08)
"""Steps of a wide search: part radii, and radians."""


@dataclass(frozen=True)
class PartLook:
    """One part in two states at few pixels, which bring near, and at many, which refine and rank."""

    coarse: PartPair
    fine: PartPair

    def shown_by(self, state: int) -> PartLook:
        """The look at the images of one state alone (see `PartPair.shown_by`)."""
        return PartLook(self.coarse.shown_by(state), self.fine.shown_by(state))

    def unmoved_cost(self) -> float:
        """What it costs that the part did not move."""
        return float(self.fine.cost(torch.eye(4).to(self.fine.centroid)[None])[0])


def part_look(
    splats: tuple[Splat, Splat], views: tuple[Sequence[View], Sequence[View]], part: int, num_views: int
) -> PartLook | None:
    """A look at a part in up to `num_views` views of each state; None where there is no `part_pair`."""
    coarse, fine = (part_pair(splats, views, part, num_views, pixels) for pixels in (COARSE_PIXELS, FINE_PIXELS))
    return None if coarse is None or fine is None else PartLook(coarse, fine)


@dataclass(frozen=True)
class Ranking:
    """Refined motions in the order in which they are preferred."""

    ends: Sequence[Refinement]
    T: np.ndarray
    """Theirs [C, 4, 4]."""
    cost: np.ndarray
    """Their `appearance_cost` [C]."""
    order: list[int]
    """The distinct ones, the preferred first."""
    own: float
    """The `own_appearance` of the pair by which they are ranked."""

    @property
    def best(self) -> Refinement:
        return self.ends[self.order[0]]

    def alike(self, times: float = ALIKE) -> list[Tensor]:
        """Those [4, 4] that turn the part quite otherwise than the best and render as well (see `looks_alike`)."""
        best = self.order[0]
        return [self.ends[i].T for i in self.order if looks_alike(self.T, self.cost, best, i, self.own, times)]


def searched_widely(small: PartPair, look: PartLook, candidates: Tensor) -> list[Refinement]:
    """What compass searches from the most hopeful of `candidates` [C, 4, 4], on few pixels, end in, refined."""
    starts = choose(look.coarse, candidates, float("inf"), keep=WIDE_STARTS)
    found = torch.stack([search(small, T) for T in starts])
    return [refine(look.fine, T, FINE_STEPS) for T in choose(look.coarse, found, REFINED_SIMILAR)]


def in_doubt(glance: PartPair, coarse: PartPair, ranking: Ranking, moved: bool) -> Tensor:
    """Motions [K, 4, 4] among which more views must choose: those ranked, and what `turned_alike` finds. None where the
    best of them, or that the part did not move, is beyond doubt."""
    known = torch.stack([ranking.ends[i].T for i in ranking.order])
    turned = turned_alike(glance, coarse, known[0]) if moved else known[:0]
    times = DOUBTFUL if so3_log(known[0, :3, :3]).norm() > TURNED_OVER else ALIKE
    return torch.cat([known, turned]) if len(turned) or moved and ranking.alike(times) else known[:0]


def explained_by_one_state(look: PartLook, candidates: Tensor, best: Refinement) -> tuple[int, list[Refinement]] | None:
    """The state whose images a motion explains that the `best` one does not, and that motion with its rivals.

    A drawer that is shut in one state shows nothing but its front there: moved to where the other state shows all of
    it, it misses most of that, and may miss less if it is turned so as to cover it. Moved the other way, all that is
    seen is there. None where no motion explains the images of a state.
    """
    for state in (0, 1):
        one = look.shown_by(state)
        if one.fine.area < ENOUGH * look.fine.area:
            continue
        rivals = refined(one, choose(one.coarse, candidates, SIMILAR))
        least = min(end.cost for end in rivals)
        if least < EXPLAINED * one.fine.own_cost() and float(one.fine.cost(best.T[None])[0]) > EXPLAINED * least:
            return state, rivals
    return None


def turned_alike(glance: PartPair, coarse: PartPair, T: Tensor) -> Tensor:
    """Motions [K, 4, 4] quite other than T [4, 4] that a symmetric part, turned so that it looks alike, may have made.

    Registration may have missed the right one of them.
    """
    R, centroid = symmetric_turns(coarse.splats[0]), coarse.centroid
    turned = torch.cat([T[None], T @ from_rotation_translation(R, centroid - R @ centroid)])
    cost = appearance_cost(glance, turned)
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


def refined(look: PartLook, candidates: Tensor) -> list[Refinement]:
    """The motions [C, 4, 4] refined on many pixels, of several those that render best once refined on few.

    If the best turns the part over, `mere_shifts` come last, for `prefer_slide`.
    """
    if len(candidates) > 1:
        near = [refine(look.coarse, T, COARSE_STEPS) for T in candidates]
        least = min(near, key=lambda end: end.cost)
        half_turn = so3_log(least.T[:3, :3]).norm() > HALF_TURN  # to which `prefer_less_turn` may prefer dearer ones
        times = DOUBTFUL if half_turn else REFINED_SIMILAR
        nearer = torch.stack([end.T for end in near])
        candidates = choose(look.coarse, nearer, times, own=own_appearance(look.coarse))
    ends = [refine(look.fine, T, FINE_STEPS) for T in candidates]
    return [*ends, *mere_shifts(look.fine, ends)]


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


def ranked(pair: PartPair, ends: Sequence[Refinement]) -> Ranking:
    """Refined motions by what they cost, and by what parts of objects do (see `motion_preference`)."""
    T = torch.stack([e.T for e in ends])
    cost, T = appearance_cost(pair, T), T.cpu().numpy()
    order = distinct(T, cost, pair.centroid.cpu().numpy(), pair.radius)
    own = own_appearance(pair)
    upright = cost[order[0]] < AS_WELL * own and prefer_upright(T, cost, order)
    order = upright or prefer_slide(T, cost, order, own)
    return Ranking(ends, T, cost, prefer_less_turn(T, cost, prefer_turn(T, cost, order, pair.radius)), own)


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


def choose(pair: PartPair, candidates: Tensor, similar: float, keep: int = KEPT, own: float = 0.0) -> Tensor:
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
