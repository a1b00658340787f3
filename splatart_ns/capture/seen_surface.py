"""The surface of an object as the views of one state see it: by their own depth, or by `stages.stereo`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from splatart_ns.capture.hull import project
from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import inverse

CELLS = 40_000
"""So many places are looked for, about. By stereo with 15,000 or 60,000 they lie nearly as near the truth."""
LEAST_STRIDE = 3
"""Pixels between places, at least."""
OTHERS = 6
"""Views that each is compared with: half of them may have a place hidden."""
LEAST_ANGLE = 4.0
"""Degrees between views below which depth hardly shows."""
TOLERANCE = 0.01
"""A place counts where one other view finds the same depth, to this relative error. (Two would leave 57 % of what
one of ten views measured.)"""
_IN_FRONT = 2.0
"""Voxels that a place must lie before a surface to be free, for the surface's own error ..."""
_FREED_BY = 2
"""... in so many views."""
LEAST_CONFIRMED = 0.3
"""Depths of which other views confirm a smaller share are of another unit, or of other cameras."""
ODD = 0.7
"""A view's depth is wrong if others confirm a smaller share of it than so much of the median view's: of another frame's
depth half is confirmed by chance, of sound ones 0.89 and more."""
_OBLIQUE = 0.15
"""Least cosine between a ray and the normal of what it meets; less is a step between two surfaces."""


@dataclass(frozen=True)
class SeenSurface:
    """Where views agree to see a surface."""

    xyz: Tensor
    """[N, 3] in the normalised world."""
    normals: Tensor
    """Towards the side that is seen [N, 3], unit; 0 where unknown."""
    rgb: Tensor
    """[N, 3] float32, 0..255."""
    views: Sequence[View]
    depth: Tensor
    """What each view sees in its cells [V, h, w]; infinite where nothing was found."""
    stride: int
    """Side of a cell, pixels. A cell's depth is that of its middle pixel."""
    confirmed: float = 1.0
    """The share of what views found that another view finds as well."""

    @classmethod
    def nothing(cls, views: Sequence[View] = (), confirmed: float = 1.0) -> SeenSurface:
        """No surface, of views that find none or contradict each other."""
        return cls(*torch.zeros(3, 0, 3), views, torch.full((len(views), 1, 1), torch.inf), 1, confirmed)

    def judged(self, points: Tensor, size: float) -> tuple[Tensor, Tensor]:
        """Which of some points [N, 3] lie before surfaces, by twice a `size` and more: [N] bool; and in which share of
        the views nothing is found where they are [N], of those that find anything.

        Views look past a rim: a surface is behind a point where it fills all cells around.
        """
        looking, blank, before = torch.zeros(3, len(points))
        for view, depth in zip(self.views, self.depth, strict=True):
            if not depth.isfinite().any():
                continue
            row, column, z, inside = cells(view, points, self.stride)
            near, far = -F.max_pool2d(-depth[None], 3, stride=1, padding=1)[0], F.max_pool2d(depth[None], 3, 1, 1)[0]
            looking += inside
            blank += inside & depth.isinf()[row, column]
            before += inside & far.isfinite()[row, column] & (z < near[row, column] - _IN_FRONT * size)
        return before >= _FREED_BY, torch.where(looking > 0, blank / looking, 1.0)

    def passed(self, points: Tensor, widths: Tensor, size: float) -> Tensor:
        """Which of some points [N, 3] views see past, and none sees a surface at: [N] bool.

        By twice a `size`, or what a cell spans where that is more. A view of which a cell spans twice a point's width
        [N] does not see past it: its middle pixel shows what is beside.
        """
        past, at = torch.zeros(2, len(points), dtype=torch.int32)
        for view, depth in zip(self.views, self.depth, strict=True):
            if not depth.isfinite().any():
                continue
            row, column, z, inside = cells(view, points, self.stride)
            reach = (self.stride / 2 * z / view.K[0, 0]).clamp_min(size)
            behind = torch.where(inside, depth[row, column] - z, torch.inf)
            past += (behind > _IN_FRONT * reach) & behind.isfinite() & (widths > reach)
            at += behind.abs() <= _IN_FRONT * reach
        return (past >= _FREED_BY) & (at == 0)

    def trusted_views(self) -> list[View]:
        """The views, without what their own depth has in cells where no other view confirms it."""
        return [replace(view, depth=self._trusted(i)) for i, view in enumerate(self.views)]

    def _trusted(self, i: int) -> Tensor | None:
        if self.views[i].depth is None:
            return None
        row, column = (torch.arange(n) // self.stride for n in self.views[i].depth.shape)
        last = self.depth.shape[1] - 1, self.depth.shape[2] - 1
        kept = self.depth[i].isfinite()[row.clamp_max(last[0])][:, column.clamp_max(last[1])]
        return self.views[i].depth * kept


def measured_surface(views: Sequence[View]) -> SeenSurface:
    """What the depth of the views of a state says, where others say the same; nothing of views that contradict the
    others, and nothing at all where most do.

    What lies beside the object, where they have an alpha, does not count.
    """
    shown = [v.depth > 0 if v.depth is not None else torch.zeros(v.height, v.width, dtype=torch.bool) for v in views]
    shown = [s & object_pixels(view) for view, s in zip(views, shown, strict=True)]
    if all(view.depth is None for view in views):
        return SeenSurface.nothing(views)
    stride, shape = grid(views, shown)
    depth = torch.full((len(views), *shape), torch.inf)
    normals = torch.zeros(*depth.shape, 3)
    for i, (view, here) in enumerate(zip(views, shown, strict=True)):
        if view.depth is not None:
            middle = torch.where(here, view.depth, torch.inf)[stride // 2 :: stride, stride // 2 :: stride]
            depth[i, : middle.shape[0], : middle.shape[1]] = middle
            normals[i] = _normals(view, depth[i], stride)
    having = torch.tensor([bool(d.isfinite().any()) for d in depth]).nonzero()[:, 0]
    poses = torch.stack([view.viewmat for view in views]).double()[having]
    # They look at the middle of the normalised world.
    nearest = having[neighbours(poses, torch.zeros(3).to(poses))]
    others = torch.zeros(len(views), nearest.shape[-1], dtype=torch.long)
    others[having] = nearest
    found = agreed(views, others, depth, normals, stride)
    share = found.depth.isfinite().sum((1, 2)) / depth.isfinite().sum((1, 2)).clamp_min(1)
    odd = torch.zeros_like(share) > 0
    odd[having] = share[having] < ODD * share[having].median() if len(having) else False
    if odd.any():  # what they confirmed of others, they confirmed by chance
        depth[odd] = torch.inf
        found = replace(agreed(views, others, depth, normals, stride), confirmed=found.confirmed)
    return found if found.confirmed >= LEAST_CONFIRMED else SeenSurface.nothing(views, found.confirmed)


def object_pixels(view: View) -> Tensor:
    """Where a view shows the object, as far as it knows, and counts: [H, W] bool."""
    shown = torch.ones(view.height, view.width, dtype=torch.bool) if view.alpha is None else view.alpha > 127
    return shown if view.mask is None else shown & view.mask


def grid(views: Sequence[View], shown: Sequence[Tensor]) -> tuple[int, tuple[int, int]]:
    """The stride of about `CELLS` cells on what is `shown`, and how many rows and columns the largest view has."""
    stride = max(LEAST_STRIDE, math.ceil((sum(int(s.sum()) for s in shown) / CELLS) ** 0.5))
    height, width = max(view.height for view in views), max(view.width for view in views)
    return stride, (math.ceil(height / stride), math.ceil(width / stride))


def cells(view: View, points: Tensor, stride: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Row and column of the cells that points [N, 3] project to, their depth, and whether they do [N]."""
    column, row, z, inside = project(view, points)
    return row // stride, column // stride, z, inside


def neighbours(poses: Tensor, centre: Tensor) -> Tensor:
    """For each view [V, 4, 4] the `OTHERS` that look at `centre` [3] from the next directions, but not the same."""
    directions = F.normalize(inverse(poses)[:, :3, 3] - centre, dim=-1)
    angle = (directions @ directions.mT).clamp(-1, 1).acos()
    angle[angle < math.radians(LEAST_ANGLE)] += 2 * math.pi
    return angle.argsort(-1)[:, : min(OTHERS, len(poses) - 1)]


def agreed(views: Sequence[View], others: Tensor, depth: Tensor, normals: Tensor, stride: int) -> SeenSurface:
    """The places that another view finds as well, of depths [V, h, w], infinite where there are none.

    Args:
        others: The views that each is compared with [V, S].
        normals: In the views' own frames [V, h, w, 3].
    """
    kept = torch.full_like(depth, torch.inf)
    found = []
    for i, view in enumerate(views):
        row, column = depth[i].isfinite().nonzero().unbind(-1)
        z = depth[i, row, column]
        y, x = stride * row + stride // 2, stride * column + stride // 2
        xyz = (pixel_rays(view, y, x) * z[:, None] - view.viewmat[:3, 3]) @ view.viewmat[:3, :3]
        keep = torch.zeros(len(xyz), dtype=torch.bool)
        for other in others[i].tolist():
            r, c, d, inside = cells(views[other], xyz, stride)
            near = F.pad(depth[other], (1,) * 4, value=torch.inf).unfold(0, 3, 1).unfold(1, 3, 1)[r, c]
            keep |= inside & (((near - d[:, None, None]).abs() / d[:, None, None]).amin((1, 2)) < TOLERANCE)
        row, column, y, x = row[keep], column[keep], y[keep], x[keep]
        kept[i, row, column] = z[keep]
        found.append((xyz[keep], normals[i, row, column] @ view.viewmat[:3, :3], view.rgb[y, x].float()))
    xyz, normals, rgb = (torch.cat(column) for column in zip(*found, strict=True))
    confirmed = float(kept.isfinite().sum() / depth.isfinite().sum().clamp_min(1))
    return SeenSurface(xyz, normals, rgb, views, kept, stride, confirmed)


def pixel_rays(view: View, row: Tensor, column: Tensor) -> Tensor:
    """Through the centres of pixels [...]: [..., 3], 1 along the optical axis."""
    return torch.stack([column + 0.5, row + 0.5, torch.ones_like(row)], -1).float() @ torch.linalg.inv(view.K).mT


def _normals(view: View, depth: Tensor, stride: int) -> Tensor:
    """Of cells' depth [h, w], from the neighbours on both sides: [h, w, 3] in the view's frame, 0 where unknown."""
    row, column = torch.meshgrid(*(stride * torch.arange(n) + stride // 2 for n in depth.shape), indexing="ij")
    rays = pixel_rays(view, row, column)
    xyz = F.pad(rays * depth[..., None], (0, 0, 1, 1, 1, 1), value=torch.inf)
    normals = torch.linalg.cross(xyz[1:-1, 2:] - xyz[1:-1, :-2], xyz[2:, 1:-1] - xyz[:-2, 1:-1])
    normals = F.normalize(normals, dim=-1)
    facing = (normals * F.normalize(rays, dim=-1)).sum(-1, keepdim=True)
    # What is not finite fails the comparison.
    return torch.where(facing.abs() > _OBLIQUE, -facing.sign() * normals, 0)
