"""Which Gaussians of the parts both of two states show, and comparing parts by these alone.

A drawer's inside that only the open state shows has no Gaussians in the shut one's splat: there the two differ however
right the motion is, and a motion that hides the difference is preferred.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import inverse
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.part_pair import PartPair, PartView
from splatart_ns.stages.visibility import clearest

AS_CLEARLY = 0.5
"""The other state shows a Gaussian too if its clearest view there shows this share of what that of its own does."""
LEAST = 0.25
"""Where less than this share of a part's pixels shows what both states show, all of them are compared."""


def covisible(
    splats: tuple[Splat, Splat], views: tuple[Sequence[View], Sequence[View]], clear: tuple[Tensor, Tensor], T: Tensor
) -> tuple[Tensor, Tensor]:
    """Which Gaussians of each state the other state shows as well [N] bool.

    Args:
        splats: The labelled splats of two states.
        views: Their training views.
        clear: `clearest` of each state's Gaussians [N] in its own views.
        T: Motions of the parts from the first state to the second [P, 4, 4].
    """
    shown = []
    for splat, elsewhere, own, motion in zip(splats, reversed(views), clear, (T, inverse(T)), strict=True):
        moved = splat.transformed(torch.cat([torch.eye(4).to(T)[None], motion])[splat.part_ids])
        shown.append(clearest(moved, elsewhere) >= AS_CLEARLY * own)
    return shown[0], shown[1]


def compared_by_common(pair: PartPair, common: Sequence[Tensor]) -> PartPair:
    """The pair without the pixels that show what only one state shows.

    `common`: which Gaussians of the part in each state [N] bool both states show.
    """
    if common[0].all() and common[1].all():
        return pair
    pieces = []
    for splat, views, both in zip(pair.splats, pair.views, common, strict=True):
        masked = tuple(replace(view, weight=view.weight * (1 - view.share(splat, ~both))) for view in views)
        if share_left(views, masked) < LEAST:
            return pair
        pieces.append(masked)
    return replace(pair, views=(pieces[0], pieces[1]))


def share_left(views: Sequence[PartView], masked: Sequence[PartView]) -> float:
    """The share of a part's pixels that views with smaller weights still count."""
    own, left = (sum(float((v.weight * v.rgba[..., 3]).sum()) for v in some) for some in (views, masked))
    return left / own if own > 0 else 0.0
