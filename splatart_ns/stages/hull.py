"""Where Gaussians start: on the surface that the views' depth or stereo tells, else in and on the silhouettes' hull."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from splatart_ns.capture.capture import REACH, UNLABELLED
from splatart_ns.capture.hull import admitted, footprint, missing, outermost, project, visible, voxel_grid
from splatart_ns.capture.seen_surface import SeenSurface, measured_surface
from splatart_ns.capture.view import View
from splatart_ns.stages.stereo import stereo_surface

MIN_POINTS_PER_PART = {2: 2000, 6: 1000}
"""Least number of points of a part, by the number of parts up to which it holds."""
MIN_POINTS_OTHERWISE = 350
MIN_POINTS_PER_PIXEL = 6
"""And at most so many for each pixel of the part in the view that shows most of it: a button needs no hundreds."""
AGREED = 4
"""Power of the share of views that agree on a point's part, by which such points are drawn: of those of a thumb's base
95 instead of 50 % lie on it then, of buttons all as before."""
POINTS_PER_PIXEL, POINTS_PER_PART = 1, 300
"""Points for each pixel of the mean silhouette, and for each part, at most: more Gaussians than that learn nothing that
the images show. Scissors of 3900 pixels from 4000, 5500 or 8000 points have equal errors and pictures, at .75, .9 and 1
of the seconds; of an arm of 10 parts and 6200 pixels 5500 are too few."""
ON_SURFACE = 0.5
"""Share of the points that start on the hull's surface where none is found at all: plain walls keep to it, but with
all of them hollows fill up."""
BESIDE = 2
"""Voxels around a surface that is found where nothing else starts."""
SLACKS = (2, 4, 6, 9, 13)
COARSE, FINE = 48, 96
"""Voxels along the longest side, of the box of all objects and of the object's own."""
UNCOVERED = 0.005
"""A hull fills silhouettes if it misses no more than this share of them. Of exact cameras it missed none; of cameras
that were half a degree and half a percent off, with thin parts, half."""
EDGE_ON, FAINT, EDGE_ON_UNCOVERED = 0.02, 60, 1e-4
"""Silhouettes lose what is thinner than a pixel, as a flap seen from its edge. Where this share of many views may err,
and pixels (0..255) count that are covered by a quarter, exact cameras of flaps and wires missed nothing, cameras a
tenth of a degree off 0.0003 of the silhouettes at least."""


Hull = tuple[Tensor, float]
"""Centres [N, 3] of the occupied voxels, and the voxels' size."""


@dataclass(frozen=True)
class SeedPoints:
    """Points to start Gaussians from, in the normalised world."""

    xyz: Tensor
    """[N, 3]."""
    rgb: Tensor
    """[N, 3] in 0..255, nerfstudio's convention for seed points."""
    normals: Tensor
    """Of the surface they lie on [N, 3]; 0 where it is not known."""

    @classmethod
    def without_normals(cls, xyz: Tensor, rgb: Tensor) -> SeedPoints:
        return cls(xyz, rgb, torch.zeros_like(xyz))

    def joined(self, other: SeedPoints) -> SeedPoints:
        xyz, normals = torch.cat([self.xyz, other.xyz]), torch.cat([self.normals, other.normals])
        return SeedPoints(xyz, torch.cat([self.rgb, other.rgb.to(self.rgb)]), normals)

    def drawn(self, count: int, generator: torch.Generator) -> SeedPoints:
        """At most `count` of the points, drawn at random."""
        chosen = torch.randperm(len(self.xyz), generator=generator)[:count]
        return SeedPoints(self.xyz[chosen], self.rgb[chosen], self.normals[chosen])


class Slack(NamedTuple):
    """By how much silhouettes contradict each other."""

    pixels: int = 0
    """By so many they must be widened before one hull fills them: cameras or masks are not exact."""
    views: int = 0
    """So many of them lose what the others show, as seen from its edge."""


EXACT = Slack()


def inside_silhouettes(views: Sequence[View], grid: Tensor, dilate: int, erring: int = 0) -> Tensor:
    """Which points [N, 3] lie inside every silhouette but `erring` ones, and are seen at all: [N] bool.

    Beyond an image's border see `admitted`. A view with an empty silhouette, which would leave no point at all, says
    nothing, nor do pixels that its mask leaves out. `dilate` widens the silhouettes by so many pixels. If views may
    err, what is `FAINT` counts.
    """
    left = torch.arange(len(grid))
    seen, missed = torch.zeros(len(grid), dtype=torch.bool), torch.zeros(len(grid), dtype=torch.int32)
    for view in views:
        silhouette = view.alpha > (FAINT if erring else 127)
        if not silhouette.any():
            continue
        if view.mask is not None:
            silhouette = silhouette | ~view.mask
        lets, inside = admitted(view, silhouette, grid[left], dilate)
        missed += ~lets
        # Most points fall to the first few views; the others need not look at them.
        stays = missed <= erring
        left, seen, missed = left[stays], (seen | inside)[stays], missed[stays]
    return torch.zeros(len(grid), dtype=torch.bool).index_fill_(0, left[seen], True)


def slack(views: Sequence[View]) -> tuple[Slack, Hull | None]:
    """How much silhouettes must be allowed before one hull fills all of them, and that hull.

    No pixels where the cameras are exact, or some, or the most of `SLACKS` where even that does not do.
    """
    few = round(EDGE_ON * len(views))
    for allowed in (EXACT, *([Slack(views=few)] if few > 0 else []), *map(Slack, SLACKS)):
        hull = visual_hull(views, slack=allowed)
        if hull is not None and _uncovered(views, *hull) < (EDGE_ON_UNCOVERED if allowed.views else UNCOVERED):
            break
    return allowed, hull


def _uncovered(views: Sequence[View], voxels: Tensor, size: float) -> float:
    """The share of the silhouettes that no voxel projects to."""
    missed, total = 0.0, 0.0
    for view in views:
        silhouette = view.alpha > 127
        if view.mask is not None:
            silhouette = silhouette & view.mask
        missed += float(missing(view, silhouette, voxels, max(1, footprint(view, size))).sum())
        total += float(silhouette.sum())
    return missed / max(total, 1.0)


def visual_hull(views: Sequence[View], slack: Slack = EXACT) -> Hull | None:
    """The voxels inside all silhouettes, but for what `slack` allows; None when no voxel is occupied.

    Two passes: a coarse one finds the object's box, a fine one fills it. Silhouettes are widened by a voxel's
    `footprint`, in the fine pass by half of it.
    """
    low, high = torch.full((3,), -REACH), torch.full((3,), REACH)
    for count, share in ((COARSE, 1.0), (FINE, 0.5)):
        grid, size = voxel_grid(low, high, count)
        grid = grid.reshape(-1, 3)
        dilate = slack.pixels + max(footprint(view, share * size) for view in views)
        grid = grid[inside_silhouettes(views, grid, dilate, slack.views)]
        if len(grid) == 0:
            return None
        low, high = grid.amin(0) - size, grid.amax(0) + size
    return grid, size


def surface(voxels: Tensor, size: float) -> Tensor:
    """Which of some voxels with centres [N, 3] are their `outermost` [M]."""
    cell = ((voxels - voxels.amin(0)) / size).round().long()
    full = torch.zeros((cell.amax(0) + 1).tolist(), dtype=torch.bool)
    full[cell.unbind(-1)] = True
    return outermost(full)[cell.unbind(-1)].nonzero()[:, 0]


def seen_surface(views: Sequence[View], voxels: Tensor, size: float) -> SeenSurface:
    """What the views' own depth tells of a hull's object; if that is nothing, what stereo finds."""
    measured = measured_surface(views)
    return measured if len(measured.xyz) > 0 else stereo_surface(views, voxels[surface(voxels, size)], size)


def seed_points(
    views: Sequence[View], num_parts: int, count: int, generator: torch.Generator, hull: Hull, found: SeenSurface
) -> SeedPoints:
    """At most `count` points on the surface that is `found` and in the hull, and more for parts below a least number.

    Every view needs its alpha. Small silhouettes get fewer points. The least number keeps small parts from starving: a
    finger of a robot would get a dozen points otherwise.
    """
    pixels = sum(int((view.alpha > 127).sum()) for view in views) / len(views)
    count = min(count, round(POINTS_PER_PIXEL * pixels) + POINTS_PER_PART * num_parts)
    places = _places(*hull, found)
    labels, share = likely_parts(views, places.xyz, hull[1], num_parts)
    least = next((n for limit, n in MIN_POINTS_PER_PART.items() if num_parts <= limit), MIN_POINTS_OTHERWISE)
    least = min(least, count // num_parts)
    drawn = [places.weight.multinomial(count, replacement=True, generator=generator)]
    for part in range(1, num_parts + 1):
        most = max((int((view.labels == part).sum()) for view in views if view.labels is not None), default=0)
        missing = min(least, MIN_POINTS_PER_PIXEL * most) - int((labels[drawn[0]] == part).sum())
        if missing > 0 and (labels == part).any():
            weight = places.weight * (labels == part) * share**AGREED
            drawn.append(weight.multinomial(missing, replacement=True, generator=generator))
    return places.points(torch.cat(drawn), views, hull[1], generator)


@dataclass(frozen=True)
class _Places:
    """Where points may start: on surfaces, and in voxels of the hull."""

    xyz: Tensor
    """[N, 3]."""
    normals: Tensor
    """Of surfaces; 0 of voxels [N, 3]."""
    rgb: Tensor
    """Of surfaces; not a number of voxels [N, 3]."""
    weight: Tensor
    """How often each is drawn, compared with the others [N]."""

    def points(self, chosen: Tensor, views: Sequence[View], size: float, generator: torch.Generator) -> SeedPoints:
        """A point for each place `chosen` [M]: anywhere in a voxel, on a surface as far aside."""
        normals = self.normals[chosen]
        aside = size * (torch.rand(len(chosen), 3, generator=generator) - 0.5)
        xyz = self.xyz[chosen] + aside - (aside * normals).sum(-1, keepdim=True) * normals
        rgb = torch.where(self.rgb[chosen].isnan(), _mean_colours(views, xyz), self.rgb[chosen])
        return SeedPoints(xyz, rgb, normals)


def _places(voxels: Tensor, size: float, found: SeenSurface) -> _Places:
    """The surface that is found, each voxel of it alike; where none is, the hull less what is free."""
    free, blank = found.judged(voxels, size)
    low, voxels, blank = voxels.amin(0), voxels[~free], blank[~free]
    cell = ((voxels - low) / size).round().long()
    at = ((found.xyz - low) / size).round().long().clamp_min(0)
    shape = torch.cat([cell, at]).amax(0) + 1
    full, crowd = torch.zeros(*shape, dtype=torch.bool), torch.zeros(*shape)
    full[cell.unbind(-1)] = True
    crowd.index_put_(at.unbind(-1), torch.ones(len(at)), accumulate=True)
    beside = F.max_pool3d(crowd[None], 2 * BESIDE + 1, stride=1, padding=BESIDE)[0][cell.unbind(-1)] > 0
    # A surface would be found, but in views that cannot see it, or not match it: these are few where it is not.
    outer = blank * (outermost(full)[cell.unbind(-1)] & ~beside)
    unfound = outer.sum() / (outer.sum() + (crowd > 0).sum()).clamp_min(1e-6)
    within = (1 - ON_SURFACE) * unfound
    weight = (1 - within) * outer + within * outer.sum() / max(int((~beside).sum()), 1) * ~beside
    unknown = torch.zeros_like(voxels)
    return _Places(
        torch.cat([found.xyz, voxels]),
        torch.cat([found.normals, unknown]),
        torch.cat([found.rgb, unknown + torch.nan]),
        # Beside a surface that is found voxels are for parts that have no other places.
        torch.cat([1 / crowd[at.unbind(-1)], torch.where(beside, 1e-6, weight)]),
    )


def likely_parts(views: Sequence[View], points: Tensor, size: float, num_parts: int) -> tuple[Tensor, Tensor]:
    """The part of each of a hull's points [N], 0 where no view shows one, and the share of the views that show a part
    there in which it is this one [N]. `size` is that of the hull's voxels.

    The part is the one that most labelled views show there of those that see the point: of a knob before a door half of
    the views show the door. Points that none sees are judged by all views.
    """
    votes, seen = (torch.zeros(len(points), num_parts + 1) for _ in range(2))
    rows = torch.arange(len(points))
    for view in views:
        if view.labels is None:
            continue
        column, row, _, inside = project(view, points)
        label = view.labels[row, column].long()
        shown = inside & (label != UNLABELLED) & (label > 0)
        votes[rows[shown], label[shown]] += 1
        shown &= visible(view, points, size)
        seen[rows[shown], label[shown]] += 1
    labels = torch.where(seen.any(-1), seen.argmax(-1), votes.argmax(-1))
    return labels, votes[rows, labels] / votes.sum(-1).clamp_min(1)


def _mean_colours(views: Sequence[View], points: Tensor) -> Tensor:
    """Mean colour [N, 3], 0..255, over the views in whose silhouette a point falls; grey where there is none."""
    total, weight = torch.zeros(len(points), 3), torch.zeros(len(points), 1)
    for view in views:
        column, row, _, inside = project(view, points)
        shown = (inside & (view.alpha[row, column] > 127)).float()[:, None]
        total += shown * view.rgb[row, column].float()
        weight += shown
    return torch.where(weight > 0, total / weight.clamp_min(1), torch.full_like(total, 127.5))
