"""What images show to be empty, and comparing parts without Gaussians that reach into it.

Where no view of its own state looks, behind a hinge or into a gap, nothing keeps a Gaussian from reaching too far. As
the part moves this haze comes to light, at one side of it, and less of it does if the part moves less: doors seem to
have turned by a fifth of a degree too little. The other state's images tell haze from the part: it lies on background.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from splatart_ns.capture.hull import project
from splatart_ns.capture.view import View, evenly
from splatart_ns.geometry.se3 import inverse, transform_points
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.part_pair import PartPair
from splatart_ns.stages.visibility import MAX_VIEWS

EXTENT = 2.0
"""How far out a Gaussian must be clear of the background, in standard deviations."""
OFTEN, MOSTLY = 0.1, 0.5
"""What a larger share of a state's views, or of those that look there, show in its free space is not there: above an
object in a room faint Gaussians hung where few views look."""
FEW = 0.1
"""Where a larger share of a part's Gaussians is not there, its pose is rather wrong, or the silhouettes are."""
MOST = 0.5
"""Where more than this share of a part's Gaussians reach into the background, its motion is not about right."""


@dataclass(frozen=True)
class FreeSpace:
    """Views of one state, and where they are empty."""

    views: Sequence[View]
    empty: Sequence[Tensor]
    """The background of each [H, W] bool, without the pixels next to what is not, or may not be."""

    @staticmethod
    def of(views: Sequence[View]) -> FreeSpace:
        """Of views that tell a background, at most `MAX_VIEWS` of them."""
        chosen, empty = [], []
        for view in evenly(views, MAX_VIEWS):
            if view.alpha is None and view.labels is None:
                continue
            background = view.labels == 0 if view.alpha is None else view.alpha < 128
            if view.mask is not None:
                background &= view.mask
            beside = F.max_pool2d((~background).float()[None], 3, stride=1, padding=1)[0] > 0
            chosen.append(view)
            empty.append(~beside)
        return FreeSpace(chosen, empty)

    def reached_by(self, splat: Splat) -> Tensor:
        """Which Gaussians [N] bool have an end in it."""
        ends = splat.ends(EXTENT)
        reached = torch.zeros(ends.shape[:2], dtype=torch.bool, device=ends.device)
        for view, empty in zip(self.views, self.empty, strict=True):
            column, row, _, inside = project(view, ends)
            reached |= inside & empty[row, column]
        return reached.any(1)

    def holds(self, points: Tensor) -> Tensor:
        """Which points [N, 3] `OFTEN`, or wherever they are in the image `MOSTLY`, show in it [N] bool."""
        looks, times = torch.zeros(2, len(points), device=points.device)
        for view, empty in zip(self.views, self.empty, strict=True):
            column, row, _, inside = project(view, points)
            looks += inside
            times += inside & empty[row, column]
        return (times > OFTEN * len(self.views)) | (times > MOSTLY * looks)


def strays(splat: Splat, free: Sequence[FreeSpace], T: Tensor, known: Tensor) -> Tensor:
    """Which Gaussians [N] bool of a labelled splat in the canonical frame some state's views show in free space.

    A drawer that is open in one state hides in its cabinet what is wrongly its own there; once it is shut, that sticks
    out at the back.

    Args:
        free: Of each state.
        T: Poses of parts 1..P [S, P, 4, 4].
        known: Which of them were found [S, P] bool. Nor are those believed that bring more than a `FEW` there.
    """
    found = torch.zeros(len(splat), dtype=torch.bool, device=splat.means.device)
    for of_state, poses, told in zip(free, T.to(splat.means), known.tolist(), strict=True):
        for p in range(len(poses)):
            own = (splat.part_ids == p + 1).nonzero()[:, 0]
            if told[p] and len(own):
                stray = of_state.holds(transform_points(poses[p], splat.means[own]))
                if stray.float().mean() <= FEW:
                    found[own[stray]] = True
    return found


def without_haze(pair: PartPair, T: Tensor, free: tuple[FreeSpace, FreeSpace]) -> PartPair:
    """The pair without Gaussians that its motion T [4, 4] brings into the other state's free space; `free`: of both.

    The same pair if there are none, or too many to be haze.
    """
    ways = zip(pair.splats, (T, inverse(T)), reversed(free), strict=True)
    hazy = [space.reached_by(splat.transformed(motion)) for splat, motion, space in ways]
    if not any(h.any() for h in hazy) or max(float(h.float().mean()) for h in hazy) > MOST:
        return pair
    return replace(pair, splats=tuple(s.select(~h) for s, h in zip(pair.splats, hazy, strict=True)))
