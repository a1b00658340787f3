"""Parts that lie flush with others, like a shut door in its frame, and what tells where those are.

Around a part the images show other parts, which might hide it, so their pixels say nothing of where it is. But where
the part's surface goes on into them, nothing hides it: they say that it is not there. Without them a shut door may
cover its frame at no cost, and only its far edges hold it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from splatart_ns.capture.capture import UNLABELLED
from splatart_ns.capture.hull import project
from splatart_ns.capture.view import View, box
from splatart_ns.geometry.se3 import inverse
from splatart_ns.rasterize.render import render
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.covisibility import share_left
from splatart_ns.stages.part_pair import PartPair, best_views
from splatart_ns.stages.visibility import MAX_VIEWS
from splatart_ns.threads import side_by_side

FLUSH = 0.6
"""A part is flush where the images show more than this share of its border against other parts: links of robots have
up to .5, shut doors and drawers .7 to 1."""
REACH = 8
"""Pixels around a part that can say that it is not there."""
TOLERANCE = 2.0
"""How much nearer another part must be to hide it, in pixels of its own distance."""
EXTENT = 2.0
"""How far out a Gaussian must be in sight, in standard deviations."""
TRACE = 0.1
"""The share of a pixel from which on it does not count, if Gaussians make it up that are not in sight to there."""
LEAST = 0.1
"""Where less than this share of a part's pixels is left in both states together, all of them count."""


def is_flush(views: Sequence[View], part: int) -> bool:
    """Whether more than `FLUSH` of a part's border lies against other parts."""
    return border_against_others(views, part) > FLUSH


def border_against_others(views: Sequence[View], part: int) -> float:
    """The share of a part's border, in labelled views, that lies against other parts; 0 where none shows it."""
    against = torch.zeros(2)
    for view in best_views(views, part, MAX_VIEWS):
        for labels in (view.labels, view.labels.T):
            for inside, beside in ((labels[1:], labels[:-1]), (labels[:-1], labels[1:])):
                beside = beside[(inside == part) & (beside != part) & (beside != UNLABELLED)]
                against += torch.stack([(beside == 0).sum(), (beside > 0).sum()]).cpu()
    return float(against[1] / against.sum().clamp_min(1))


def surface_depths(splat: Splat, views: Sequence[View]) -> list[Tensor]:
    """How far a splat's surface is in each view [H, W], infinite where it is not."""

    @torch.no_grad()
    def look(view: View) -> Tensor:
        camera = view.viewmat[None], view.K[None], view.width, view.height
        rendering = render(splat, *camera, sh_degree=0)
        return torch.where(rendering.accumulation > 0.5, rendering.depth, torch.inf)[0, ..., 0]

    return side_by_side(look, views)


def without_neighbours(view: View, depth: Tensor, part: int) -> View:
    """The view with background where other parts' pixels say that a part is not there.

    Those are the ones around it whose surface, of `depth` [H, W], does not lie before that of the part's nearest pixel.
    """
    own = None if view.labels is None else (view.labels == part) & depth.isfinite()
    if own is None or not own.any():
        return view
    left, top, right, bottom = box(own)
    piece = slice(max(0, top - REACH), bottom + REACH), slice(max(0, left - REACH), right + REACH)
    labels, depth = view.labels[piece], depth[piece]
    distance, nearest = distance_transform_edt(~own[piece].cpu().numpy(), return_indices=True)
    distance, (row, column) = (torch.from_numpy(x).to(depth.device) for x in (distance, nearest))
    surface = depth[row.long(), column.long()] * (1 - TOLERANCE / view.K[0, 0])
    other = (labels != part) & (labels != 0) & (labels != UNLABELLED)
    absent = other & (distance <= REACH) & depth.isfinite() & (surface <= depth)
    emptied = {}
    for name, pixels in (("labels", view.labels), ("alpha", view.alpha)):
        if pixels is not None:
            emptied[name] = pixels.clone()
            emptied[name][piece][absent] = 0
    return replace(view, **emptied)


def in_sight(splat: Splat, views: Sequence[View], depths: Sequence[Tensor], part: int) -> Tensor:
    """Which Gaussians of a part [N] bool have both ends in some view.

    The others reach, as nothing kept them from it, into what no view shows, and are seen to when the part moves. An end
    that a labelled view shows on another part is not in it.
    """
    ends, thickness = splat.ends(EXTENT), splat.scales.amin(-1, keepdim=True)
    seen = torch.zeros(ends.shape[:2], dtype=torch.bool, device=ends.device)
    for view, depth in zip(views, depths, strict=True):
        column, row, z, inside = project(view, ends)
        inside &= z <= depth[row, column] + TOLERANCE * (z / view.K[0, 0] + thickness)
        if view.labels is not None:
            label = view.labels[row, column]
            inside &= (label == part) | (label == 0) | (label == UNLABELLED)
        seen |= inside
    return seen.all(1)


def compared_by_seen(pair: PartPair, T: Tensor, seen: Sequence[Tensor]) -> PartPair:
    """The pair without the pixels that show, after the motion T [4, 4], Gaussians that are not `in_sight` in their own
    state [N] bool each; as it is where hardly any would be left."""
    pieces = []
    ways = zip(pair.splats, (T, inverse(T)), seen, reversed(pair.views), strict=True)
    for splat, motion, known, views in ways:
        moved = splat.transformed(motion)
        clear = [(1 - v.share(moved, ~known) / TRACE).clamp_min(0) for v in views]
        pieces.append(tuple(replace(v, weight=v.weight * c) for v, c in zip(views, clear, strict=True)))
    left = share_left([*pair.views[1], *pair.views[0]], [*pieces[0], *pieces[1]])
    return pair if left < LEAST else replace(pair, views=(pieces[1], pieces[0]))
