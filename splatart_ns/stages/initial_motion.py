"""The initial motion of a part between two states: registration proposes, renderings into the other state choose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import so3_log
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.motion_preference import OTHERWISE, SUSPECT
from splatart_ns.stages.part_pair import IN_EVEN_LIGHT, PartPair, part_pair
from splatart_ns.stages.registration import MIN_POINTS, PartPoints, part_points, point_to_plane, register
from splatart_ns.stages.render_choice import (
    DOUBTFUL_VIEWS,
    FINE_PIXELS,
    HOPELESS,
    SIMILAR,
    TINY_PIXELS,
    VIEWS,
    appearance_cost,
    choose,
    explained_by_one_state,
    in_doubt,
    part_look,
    ranked,
    refined,
    searched_widely,
)

GLANCE_VIEWS, WIDE_VIEWS = 2, 3
"""Views of each state, of `TINY_PIXELS`, that tell hopeless candidates, and those in which is searched widely."""
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
    look = part_look(splats, views, part, VIEWS)
    if look is not None:
        own_cost, unmoved_cost = look.fine.own_cost(), look.unmoved_cost()
        if unmoved_cost < STILL_RATIO * own_cost:  # no motion fits much better than a state's own Gaussians
            return InitialMotion(identity, found=True, still=True, cost=unmoved_cost, identity_ratio=1.0)
    registered = torch.from_numpy(register(source, target, seed)).to(identity)
    if look is None:
        return InitialMotion(registered[0], found=True)

    glance = part_pair(splats, views, part, GLANCE_VIEWS, TINY_PIXELS)
    proposed = torch.cat([identity[None], registered])
    hopeful, closer = _hopeful(glance, proposed, source, target)
    everything, candidates = torch.cat([proposed, closer]), torch.cat([hopeful, closer])
    ends = refined(look, _worth_refining(look.coarse, candidates))
    if min(end.cost for end in ends) > SUSPECT * own_cost:
        ends += searched_widely(part_pair(splats, views, part, WIDE_VIEWS, TINY_PIXELS), look, everything)
    ranking = ranked(look.fine, ends)

    shown = views
    one = explained_by_one_state(look, everything, ranking.best) if ranking.best.cost > SUSPECT * own_cost else None
    if one is not None:
        state, rivals = one
        shown = (views[0], ()) if state == 0 else ((), views[1])
        look = look.shown_by(state)
        ranking = ranked(look.fine, rivals)

    moved = look.unmoved_cost() >= STILL_RATIO * ranking.best.cost
    doubtful = in_doubt(glance, look.coarse, ranking, moved)
    if len(doubtful):
        look = part_look(splats, shown, part, DOUBTFUL_VIEWS)
        ranking = ranked(look.fine, refined(look, choose(look.coarse, torch.cat([doubtful, candidates]), SIMILAR)))

    best, unmoved_cost = ranking.best, look.unmoved_cost()
    identity_ratio = unmoved_cost / max(best.cost, 1e-12)
    still = identity_ratio < STILL_RATIO
    least = min(end.cost for end in ranking.ends)  # the preferred one may cost more, and says nothing of rest
    turned_far = so3_log(best.T[:3, :3]).norm() > OTHERWISE / 2
    if not still and turned_far and unmoved_cost < SHADED_RATIO * least:
        still = _fits_as_well_unmoved(part_pair(splats, views, part, DOUBTFUL_VIEWS, FINE_PIXELS), best.T)
    return InitialMotion(
        identity if still else best.T,
        found=True,
        still=still,
        cost=best.cost,
        identity_ratio=identity_ratio,
        alike=() if still else tuple(ranking.alike()),
        maybe_moved=still and identity_ratio > RESTS_RATIO,
    )


def _hopeful(glance: PartPair, T: Tensor, source: PartPoints, target: PartPoints) -> tuple[Tensor, Tensor]:
    """Those of motions T [C, 4, 4] that a glance does not rule out, and what they become by the shapes alone."""
    cost = appearance_cost(glance, T)
    hopeful = T[torch.from_numpy(cost <= HOPELESS * cost.min())]
    return hopeful, torch.from_numpy(point_to_plane(source, target, hopeful.numpy(force=True))).to(T)


def _worth_refining(coarse: PartPair, candidates: Tensor) -> Tensor:
    """The best of `candidates` [C, 4, 4]; no motion alone if that is about as good."""
    chosen = choose(coarse, candidates, SIMILAR)
    identity = torch.eye(4).to(chosen)[None]
    unmoved, best = coarse.cost(torch.cat([identity, chosen[:1]])).tolist()
    return identity if unmoved < STILL_RATIO * best else chosen


def _fits_as_well_unmoved(pair: PartPair, T: Tensor) -> bool:
    """Whether in even light a motion T [4, 4] fits hardly better than none."""
    unmoved, moved = replace(pair, **IN_EVEN_LIGHT).cost(torch.stack([torch.eye(4).to(T), T])).tolist()
    return unmoved < STILL_RATIO * moved
