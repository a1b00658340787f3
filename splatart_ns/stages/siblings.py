"""Parts that slide as others do: where a part's own search ends in doubt, it is sought along the ways of the others.

Of a drawer that one state hides but for its front little is left to register, and turned over the rest may fit as well.
But drawers of one body slide along one way, and along a line a motion is found however far it goes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import so3_log, transform_points
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.initial_motion import InitialMotion
from splatart_ns.stages.motion_preference import ALIKE, SLIDE_TURN, TURNED_OVER, looks_alike
from splatart_ns.stages.part_pair import part_pair
from splatart_ns.stages.refinement import shifted
from splatart_ns.stages.render_choice import (
    COARSE_PIXELS,
    DOUBTFUL_VIEWS,
    FINE_PIXELS,
    VIEWS,
    appearance_cost,
)

REACH, STEP = 3.0, 0.1
"""How far along a way a part is sought, to either side, and how densely, in its radii."""
MOVED = 0.3
"""By less than this share of its radius a part may have stayed where it is and turned, as a knob does."""
SAME_WAY = 0.98
"""Ways whose directions' cosine is larger are one."""


def slide_ways(splat: Splat, motions: Mapping[int, InitialMotion]) -> Tensor:
    """Directions [K, 3] along which parts of a labelled splat slid, by id, whose motions are not in doubt, but for what
    looks alike turned over: the plain fronts of a table's only two drawers do."""
    ways: list[Tensor] = []
    for part, motion in motions.items():
        centroid = splat.means.detach()[splat.part_ids == part].mean(0, keepdim=True).to(motion.T)
        turn, shift = so3_log(motion.T[:3, :3]).norm(), (transform_points(motion.T, centroid) - centroid)[0]
        if not motion.found or motion.still or turn > math.radians(SLIDE_TURN) or not shift.any():
            continue
        if any(so3_log(other[:3, :3]).norm() < TURNED_OVER for other in motion.alike):
            continue
        way = shift / shift.norm()
        if all(abs(float(way @ other)) < SAME_WAY for other in ways):
            ways.append(way)
    return torch.stack(ways) if ways else torch.zeros(0, 3, dtype=torch.float64)


def slid_alike(
    splats: tuple[Splat, Splat],
    views: tuple[Sequence[View], Sequence[View]],
    part: int,
    motion: InitialMotion,
    ways: Tensor,
) -> InitialMotion:
    """A part's motion between two states, or a slide along one of `ways` [K, 3] that renders nearly as well.

    Args:
        splats: The labelled splats of the one and the other state.
        views: Their training views.
    """
    if len(ways) == 0:
        return motion
    coarse = part_pair(splats, views, part, VIEWS, COARSE_PIXELS)
    fine = part_pair(splats, views, part, DOUBTFUL_VIEWS, FINE_PIXELS)
    if coarse is None or fine is None:
        return motion
    far = coarse.radius * torch.arange(-REACH, REACH + STEP / 2, STEP).to(motion.T)
    slides = torch.eye(4).to(motion.T).repeat(len(ways), len(far), 1, 1)
    slides[..., :3, 3] = far[:, None] * ways[:, None].to(motion.T)
    starts = [along[int(appearance_cost(coarse, along).argmin())] for along in slides]
    known = [motion.T, *motion.alike]
    found = [shifted(fine, start) for start in starts]
    ends = torch.stack([*known, *(end.T for end in found)])
    cost = appearance_cost(fine, ends)
    shift = (transform_points(ends, fine.centroid[None])[:, 0] - fine.centroid).norm(dim=-1)
    good = [i for i in range(len(known), len(ends)) if shift[i] > MOVED * fine.radius and cost[i] < ALIKE * cost[0]]
    if not good:
        return motion
    best = min(good, key=lambda i: cost[i])
    others = (ends[i] for i in range(len(known)) if looks_alike(ends.cpu().numpy(), cost, best, i))
    end = found[best - len(known)]
    ratio = motion.identity_ratio * motion.cost / max(end.cost, 1e-12)
    return replace(motion, T=end.T, cost=end.cost, identity_ratio=ratio, alike=tuple(others))
