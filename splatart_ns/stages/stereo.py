"""The surface of an object that stereo between the views of one state finds, with normals.

Silhouettes do not tell how deep a hollow is, and Gaussians that start before or behind a wall mostly stay there: it
looks right from there too, but for textures far too faint to move them. Correlating patches sees those.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from splatart_ns.capture.hull import footprint
from splatart_ns.capture.seen_surface import SeenSurface, agreed, cells, grid, neighbours, object_pixels
from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import inverse
from splatart_ns.rasterize.rasterization import has_numba
from splatart_ns.stages.planar_region import with_planes
from splatart_ns.threads import num_threads

PASSES = 3
"""With 5 places lie nearly as near the truth."""
UNLIKE = 0.6
"""A place is found where patches are less unlike (1 - correlation): with true normals, of two cabinets' bodies 19 of 20
below 0.2 are right, and 17 of 20 from there to 0.4."""


def stereo_surface(views: Sequence[View], voxels: Tensor, size: float) -> SeenSurface:
    """What stereo finds between the nearest and the farthest voxel of a hull on each ray.

    Args:
        views: Those of one state, with their alpha.
        voxels: Centres of the outermost voxels of a hull [N, 3].
        size: Side of a voxel.

    The search is random, but the same for the same images. Without numba, or with fewer than three views, nothing is
    found.
    """
    if len(views) < 3 or not has_numba():
        return SeenSurface.nothing()
    from splatart_ns.rasterize.numba_runtime import even_bounds, run
    from splatart_ns.stages.patch_match import HIDDEN, match

    shown = [object_pixels(view) for view in views]
    stride, shape = grid(views, shown)
    size_of_largest = max(view.height for view in views), max(view.width for view in views)
    bright = np.full((len(views), *size_of_largest), HIDDEN, np.uint16)
    bounds = torch.zeros(len(views), 2, *shape)
    for i, (view, here) in enumerate(zip(views, shown, strict=True)):
        bright[i, : view.height, : view.width] = np.where(here, view.rgb.sum(-1), HIDDEN)
        bounds[i] = _bounds(view, voxels, size, stride, shape)
    K = torch.stack([view.K for view in views])[:, [0, 1, 0, 1], [0, 1, 2, 2]]
    poses = torch.stack([view.viewmat for view in views]).double()
    others = neighbours(poses, voxels.mean(0).double())
    T = (poses[others] @ inverse(poses)[:, None]).float()
    given = [x.contiguous().numpy() for x in (K, others, T[..., :3, :3], T[..., :3, 3], *bounds.unbind(1))]
    depth, normals = np.zeros(given[-1].shape, np.float32), np.zeros((*given[-1].shape, 3), np.float32)
    unlike = np.full_like(depth, 2.0)
    workers = even_bounds(len(views), min(num_threads(), len(views)))
    run(match, workers, bright, *given, stride, PASSES, depth, normals, unlike)
    depth = torch.from_numpy(np.where(unlike < UNLIKE, depth, np.inf))
    normals = torch.from_numpy(normals)
    found = agreed(views, others, depth, normals, stride)
    return with_planes(views, others, found, normals, *bounds.unbind(1))


def _bounds(view: View, voxels: Tensor, size: float, stride: int, shape: Sequence[int]) -> Tensor:
    """Depths [2, h, w] between which the hull lies in each cell; the first is not less where it does not."""
    row, column, z, inside = cells(view, voxels, stride)
    cell = (row * shape[1] + column)[inside]
    ends = torch.full((2, shape[0] * shape[1]), torch.inf)
    for end, depth in zip(ends, (z, -z), strict=True):
        end.scatter_reduce_(0, cell, depth[inside], "amin")
    reach = math.ceil(footprint(view, size) / stride)
    near, far = -F.max_pool2d(-ends.reshape(2, *shape), 2 * reach + 1, stride=1, padding=reach)
    return torch.stack([(near - size).clamp_min(1e-3), size - far])
