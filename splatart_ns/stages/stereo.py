"""The surface of an object that stereo between the views of one state finds, with normals.

Silhouettes do not tell how deep a hollow is, and Gaussians that start before or behind a wall mostly stay there: it
looks right from there too, but for textures far too faint to move them. Correlating patches sees those.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from splatart_ns.capture.hull import footprint, project
from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import inverse
from splatart_ns.rasterize.rasterization import has_numba

CELLS = 40_000
"""So many places are looked for, about. With 15,000 or 60,000, and 3 or 5 passes, they lie nearly as near the truth."""
LEAST_STRIDE = 3
"""Pixels between places, at least."""
PASSES = 3
OTHERS = 6
"""Views that each is compared with: half of them may have a place hidden."""
LEAST_ANGLE = 4.0
"""Degrees between views below which depth hardly shows."""
UNLIKE = 0.6
"""A place is found where patches are less unlike (1 - correlation): with true normals, of two cabinets' bodies 19 of 20
below 0.2 are right, and 17 of 20 from there to 0.4 ..."""
TOLERANCE = 0.01
"""... and where one other view finds the same depth, to this relative error."""
_IN_FRONT = 2.0
"""Voxels that a place must lie before a surface to be free, for the surface's own error ..."""
_FREED_BY = 2
"""... in so many views."""


@dataclass(frozen=True)
class StereoSurface:
    """Where views agree to see a surface."""

    xyz: Tensor
    """[N, 3] in the normalised world."""
    normals: Tensor
    """Towards the side that is seen [N, 3], unit."""
    rgb: Tensor
    """[N, 3] float32, 0..255."""
    views: Sequence[View]
    depth: Tensor
    """What each view sees in its cells [V, h, w]; infinite where nothing was found."""
    stride: int
    """Side of a cell, pixels."""

    def judged(self, points: Tensor, size: float) -> tuple[Tensor, Tensor]:
        """Which of some points [N, 3] lie before surfaces, by twice a `size` and more: [N] bool; and in which share of
        the views nothing is found where they are [N].

        Views look past a rim: a surface is behind a point where it fills all cells around.
        """
        looking, blank, before = torch.zeros(3, len(points))
        for view, depth in zip(self.views, self.depth, strict=True):
            row, column, z, inside = _cells(view, points, self.stride)
            near, far = -F.max_pool2d(-depth[None], 3, stride=1, padding=1)[0], F.max_pool2d(depth[None], 3, 1, 1)[0]
            looking += inside
            blank += inside & depth.isinf()[row, column]
            before += inside & far.isfinite()[row, column] & (z < near[row, column] - _IN_FRONT * size)
        return before >= _FREED_BY, torch.where(looking > 0, blank / looking, 1.0)


def stereo_surface(views: Sequence[View], voxels: Tensor, size: float) -> StereoSurface:
    """What stereo finds between the nearest and the farthest voxel of a hull on each ray.

    Args:
        views: Those of one state, with their alpha.
        voxels: Centres of the outermost voxels of a hull [N, 3].
        size: Side of a voxel.

    The search is random, but the same for the same images. Without numba, or with fewer than three views, nothing is
    found.
    """
    if len(views) < 3 or not has_numba():
        nothing = torch.zeros(0, 3)
        return StereoSurface(nothing, nothing, nothing, (), torch.zeros(0, 1, 1), 1)
    from splatart_ns.rasterize.numba_runtime import even_bounds, num_workers, run
    from splatart_ns.stages.patch_match import HIDDEN, match

    shown = [view.alpha > 127 if view.mask is None else (view.alpha > 127) & view.mask for view in views]
    stride = max(LEAST_STRIDE, math.ceil((sum(int(s.sum()) for s in shown) / CELLS) ** 0.5))
    height, width = max(view.height for view in views), max(view.width for view in views)
    bright = np.full((len(views), height, width), HIDDEN, np.uint16)
    bounds = torch.zeros(len(views), 2, math.ceil(height / stride), math.ceil(width / stride))
    for i, (view, here) in enumerate(zip(views, shown, strict=True)):
        bright[i, : view.height, : view.width] = np.where(here, view.rgb.sum(-1), HIDDEN)
        bounds[i] = _bounds(view, voxels, size, stride, bounds.shape[2:])
    K = torch.stack([view.K for view in views])[:, [0, 1, 0, 1], [0, 1, 2, 2]]
    poses = torch.stack([view.viewmat for view in views]).double()
    others = _others(poses, voxels.mean(0).double())
    T = (poses[others] @ inverse(poses)[:, None]).float()
    given = [x.contiguous().numpy() for x in (K, others, T[..., :3, :3], T[..., :3, 3], *bounds.unbind(1))]
    depth, normals = np.zeros(given[-1].shape, np.float32), np.zeros((*given[-1].shape, 3), np.float32)
    unlike = np.full_like(depth, 2.0)
    workers = even_bounds(len(views), min(num_workers(), len(views)))
    run(match, workers, bright, *given, stride, PASSES, depth, normals, unlike)
    depth = torch.from_numpy(np.where(unlike < UNLIKE, depth, np.inf))
    return _agreed(views, others, depth, torch.from_numpy(normals), stride)


def _cells(view: View, points: Tensor, stride: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Row and column of the cells that points [N, 3] project to, their depth, and whether they do [N]."""
    column, row, z, inside = project(view, points)
    return row // stride, column // stride, z, inside


def _bounds(view: View, voxels: Tensor, size: float, stride: int, shape: Sequence[int]) -> Tensor:
    """Depths [2, h, w] between which the hull lies in each cell; the first is not less where it does not."""
    row, column, z, inside = _cells(view, voxels, stride)
    cell = (row * shape[1] + column)[inside]
    ends = torch.full((2, shape[0] * shape[1]), torch.inf)
    for end, depth in zip(ends, (z, -z), strict=True):
        end.scatter_reduce_(0, cell, depth[inside], "amin")
    reach = math.ceil(footprint(view, size) / stride)
    near, far = -F.max_pool2d(-ends.reshape(2, *shape), 2 * reach + 1, stride=1, padding=reach)
    return torch.stack([(near - size).clamp_min(1e-3), size - far])


def _others(poses: Tensor, centre: Tensor) -> Tensor:
    """For each view [V, 4, 4] the `OTHERS` that look at `centre` [3] from the next directions, but not the same."""
    directions = F.normalize(inverse(poses)[:, :3, 3] - centre, dim=-1)
    angle = (directions @ directions.mT).clamp(-1, 1).acos()
    angle[angle < math.radians(LEAST_ANGLE)] += 2 * math.pi
    return angle.argsort(-1)[:, : min(OTHERS, len(poses) - 1)]


def _agreed(views: Sequence[View], others: Tensor, depth: Tensor, normals: Tensor, stride: int) -> StereoSurface:
    """The places that another view finds as well, of depths [V, h, w], infinite where there are none."""
    agreed = torch.full_like(depth, torch.inf)
    found = []
    for i, view in enumerate(views):
        row, column = depth[i].isfinite().nonzero().unbind(-1)
        z = depth[i, row, column]
        y, x = stride * row + stride // 2, stride * column + stride // 2
        ray = torch.stack([x + 0.5, y + 0.5, torch.ones(len(x))], -1) @ torch.linalg.inv(view.K).mT
        xyz = (ray * z[:, None] - view.viewmat[:3, 3]) @ view.viewmat[:3, :3]
        keep = torch.zeros(len(xyz), dtype=torch.bool)
        for other in others[i].tolist():
            r, c, d, inside = _cells(views[other], xyz, stride)
            near = F.pad(depth[other], (1,) * 4, value=torch.inf).unfold(0, 3, 1).unfold(1, 3, 1)[r, c]
            keep |= inside & (((near - d[:, None, None]).abs() / d[:, None, None]).amin((1, 2)) < TOLERANCE)
        row, column, y, x = row[keep], column[keep], y[keep], x[keep]
        agreed[i, row, column] = z[keep]
        found.append((xyz[keep], normals[i, row, column] @ view.viewmat[:3, :3], view.rgb[y, x].float()))
    xyz, normals, rgb = (torch.cat(column) for column in zip(*found, strict=True))
    return StereoSurface(xyz, normals, rgb, views, agreed, stride)
