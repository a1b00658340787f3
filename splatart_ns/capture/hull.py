"""The visual hull of one state's silhouettes, the silhouettes that do not fit the others, what each view sees of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from splatart_ns.capture.capture import REACH, UNLABELLED
from splatart_ns.capture.view import View
from splatart_ns.geometry.camera import project_points

UNCOVERED = 0.03
"""Silhouettes fit each other where no more of each than this share lies outside the hull's projection."""
POSES_MEND = "check that poses are camera-to-world in OpenGL axes, the intrinsics, and that masks are white inside"
_LEAST_AGREEMENT = 0.75
_COARSE, _FINE = 40, 64
_MOST_ODD = 0.25
_SUSPECTS = 3


def silhouette(view: View) -> Tensor | None:
    """What a view says of the object's outline, bool [H, W]: its alpha, else its labels, else nothing."""
    if view.alpha is not None:
        return view.alpha > 127
    if view.labels is not None and not bool((view.labels == UNLABELLED).any()):
        return view.labels > 0
    return None


@dataclass
class Carving:
    """A grid of voxels, and which of them the views let be inside the object."""

    views: Sequence[View]
    """Those with a silhouette."""
    points: Tensor
    """Centres of the voxels [X, Y, Z, 3] in the views' world."""
    size: float
    """Side of a voxel."""
    accepted: Tensor
    """Whether view v lets a voxel be inside, bool [V, X, Y, Z] (see `admitted`)."""
    seen: Tensor
    """Whether a voxel falls into an image at all, bool [X, Y, Z]."""

    def inside(self, views: Tensor) -> Tensor:
        """The voxels that all chosen `views` (bool [V]) let be inside: [X, Y, Z] bool."""
        return self.accepted[views].all(0) & self.seen

    def surface(self, views: Tensor) -> Tensor:
        """The centres [N, 3] of the outermost of these voxels."""
        return self.points[outermost(self.inside(views))]

    def missing(self, view: View, hull: Tensor) -> Tensor:
        """The pixels [H, W] of a view's silhouette that none of the voxels `hull` [N, 3] projects to."""
        return missing(view, silhouette(view), hull, footprint(view, self.size))

    def uncovered(self, views: Tensor) -> Tensor:
        """The share of each view's silhouette [V] that the hull of `views` (bool [V]) misses; 0 for the other views."""
        shares, hull = torch.zeros(len(self.views)), self.points[self.inside(views)]
        for i in torch.nonzero(views).flatten().tolist():
            view = self.views[i]
            shares[i] = self.missing(view, hull).sum() / silhouette(view).sum()
        return shares


def carve(views: Sequence[View]) -> Carving:
    """Carve a box around all that 3 of 4 views agree on. Every view needs a silhouette that is not empty."""
    low, high = torch.full((3,), -REACH), torch.full((3,), REACH)
    for count in (_COARSE, _FINE):
        points, size = voxel_grid(low, high, count)
        accepted = torch.zeros(len(views), *points.shape[:3], dtype=torch.bool)
        seen = torch.zeros(points.shape[:3], dtype=torch.bool)
        for i, view in enumerate(views):
            lets, inside = admitted(view, silhouette(view), points.reshape(-1, 3), footprint(view, size))
            accepted[i] = lets.reshape(seen.shape)
            seen |= inside.reshape(seen.shape)
        full = (accepted.sum(0) >= (1 - _MOST_ODD) * len(views)) & seen
        if not full.any():
            break
        low, high = points[full].amin(0) - 2 * size, points[full].amax(0) + 2 * size
    return Carving(views, points, size, accepted, seen)


def contradiction(carving: Carving) -> str | None:
    """What is wrong with silhouettes of which too few have a point in common; else None."""
    agreement = float((carving.accepted.sum(0) * carving.seen).max()) / len(carving.views)
    if agreement >= _LEAST_AGREEMENT:
        return None
    return f"the silhouettes contradict each other: no point lies inside more than {agreement:.0%} of them"


def fitting_views(carving: Carving) -> Tensor | None:
    """The views whose silhouettes fit each other, bool [V]; None if more than a tenth of them, and three, do not.

    As long as the hull does not cover all silhouettes, the view goes without which they are covered best. Tried are
    those that are covered worst themselves, and those that alone, or nearly so, reject voxels that others miss. Then
    those come back that do no harm.
    """

    def deficit(views: Tensor) -> float:
        return float((carving.uncovered(views) - UNCOVERED).clamp_min(0).sum())

    def without(views: Tensor, i: int) -> Tensor:
        return views & (torch.arange(len(views)) != i)

    views = torch.ones(len(carving.views), dtype=torch.bool)
    removed: list[int] = []
    while deficit(views) > 0:
        if len(removed) >= max(3, len(views) // 10):
            return None
        suspects = {*carving.uncovered(views).topk(_SUSPECTS).indices.tolist()}
        suspects |= {*_blame(carving, views).topk(_SUSPECTS).indices.tolist()}
        removed.append(min(suspects, key=lambda i: deficit(without(views, i))))
        views = without(views, removed[-1])
    for i in removed[:-1]:
        views[i] = True
        views[i] = deficit(views) == 0
    return views


def _blame(carving: Carving, views: Tensor) -> Tensor:
    """How much each view [V] takes from the hull that other silhouettes miss. A voxel's blame goes to those that reject
    it, and falls with the square of their number: where all but one agree, that one is wrong."""
    rejected = ~carving.accepted[views]
    times = rejected.sum(0)
    near = (times > 0) & (times <= max(1, _MOST_ODD * len(rejected))) & carving.seen
    wanted, hull = torch.zeros(int(near.sum())), carving.points[carving.inside(views)]
    for i in torch.nonzero(views).flatten().tolist():
        column, row, _, inside = project(carving.views[i], carving.points[near])
        wanted += inside & carving.missing(carving.views[i], hull)[row, column]
    blame = torch.zeros(len(views))
    blame[views] = (rejected[:, near] * (wanted / times[near] ** 2)).sum(1)
    return blame


def voxel_grid(low: Tensor, high: Tensor, count: int) -> tuple[Tensor, float]:
    """Centres [X, Y, Z, 3] of voxels that fill the box from `low` to `high` [3], `count` along its longest side, and
    their size."""
    size = float((high - low).max()) / count
    axes = [torch.arange(float(a) + size / 2, float(b), size) for a, b in zip(low, high, strict=True)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1), size


def admitted(view: View, mask: Tensor, points: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Which points [N, 3] a view's silhouette `mask` [H, W], widened by `reach` pixels, lets be inside the object, and
    which fall into the image: [N] bool each.

    A point beyond the image's border is outside, unless the silhouette is cut off by the border: then the view says
    nothing of it.
    """
    border = torch.cat([*mask[[0, -1]], *mask[:, [0, -1]].T])
    column, row, _, inside = project(view, points)
    return torch.where(inside, widened(mask, reach)[row, column], border.any()), inside


def missing(view: View, mask: Tensor, hull: Tensor, reach: int) -> Tensor:
    """The pixels [H, W] of a view's silhouette `mask` [H, W] that have none within `reach` to which one of the voxels
    `hull` [N, 3] projects."""
    column, row, _, inside = project(view, hull)
    hit = torch.zeros_like(mask)
    hit[row[inside], column[inside]] = True
    return mask & ~widened(hit, reach)


def outermost(full: Tensor) -> Tensor:
    """Which voxels of those that are `full` [X, Y, Z] bool do not have all six neighbours."""
    padded = F.pad(full, (1,) * 6)
    inner = full.clone()
    for axis in range(3):
        for step in (-1, 1):
            inner &= padded.roll(step, axis)[1:-1, 1:-1, 1:-1]
    return full & ~inner


def project(view: View, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixel column and row [N] (clamped into the image), depth [N], and whether the point falls into the image."""
    pixels, depth = project_points(points, view.viewmat, view.K)
    u, v = pixels.floor().unbind(-1)
    inside = (depth > 0) & (u >= 0) & (u < view.width) & (v >= 0) & (v < view.height)
    return u.clamp(0, view.width - 1).long(), v.clamp(0, view.height - 1).long(), depth, inside


@dataclass(frozen=True)
class DepthBuffer:
    """How voxels of a hull's surface lie before each other in a view, in cells as wide as a voxel."""

    inside: Tensor
    """Whether each falls into the image, bool [N]."""
    depth: Tensor
    """Along the optical axis [N]."""
    cell: Tensor
    """Which one it falls into [N], row by row."""
    shape: tuple[int, int]
    """Rows and columns of cells."""
    tolerance: float
    """How far behind another one a voxel may be seen: the surface is that rough."""

    @classmethod
    def of(cls, view: View, points: Tensor, size: float) -> DepthBuffer:
        """Of voxels' centres [N, 3]."""
        column, row, depth, inside = project(view, points)
        middle = float(depth[inside].median()) if inside.any() else 1.0
        cell = max(1, round(1.2 * size * float(view.K[0, 0]) / middle))
        height, width = view.height // cell + 1, view.width // cell + 1
        return cls(inside, depth, row // cell * width + column // cell, (height, width), 2.5 * size)

    def nearest(self, those: Tensor) -> Tensor:
        """The depth [N] of the first of `those` voxels (bool [N]) where each one is; infinite where there is none."""
        first = torch.full((self.shape[0] * self.shape[1],), torch.inf)
        those = those & self.inside
        first.scatter_reduce_(0, self.cell[those], self.depth[those], "amin")
        # The minimum over the neighbours closes the gaps between points.
        return -F.max_pool2d(-first.reshape(1, *self.shape), 3, stride=1, padding=1).flatten()[self.cell]

    def visible(self) -> Tensor:
        """Which voxels the view sees, none before them: [N] bool; some by edges it does not."""
        return self.inside & (self.depth < self.nearest(self.inside) + self.tolerance)

    def as_near(self, those: Tensor) -> Tensor:
        """Where one of `those` voxels (bool [N]) is before each one, or hardly behind it: [N] bool."""
        return self.nearest(those) < self.depth + self.tolerance


def visible(view: View, points: Tensor, size: float) -> Tensor:
    """Which voxels [N, 3] of a hull's surface a view sees, none before them: [N] bool; some by edges it does not."""
    return DepthBuffer.of(view, points, size).visible()


def footprint(view: View, size: float) -> int:
    """Half a voxel's diagonal in pixels, so that no thin part falls between the voxels' centres; at most the image."""
    pixels = 0.87 * size * float(view.K[0, 0] / view.viewmat[:3, 3].norm().clamp_min(0.1))
    return round(min(max(view.width, view.height), pixels))


def widened(mask: Tensor, reach: int) -> Tensor:
    """A mask [H, W] with all pixels that are at most `reach` pixels aside and up or down."""
    square = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return torch.from_numpy(cv2.dilate(mask.numpy().view(np.uint8), square)).bool()
