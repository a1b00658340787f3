"""gsplat's torch formulation of rasterization on a CPU, for comparison.

It is gsplat 1.4.0's own `_torch_impl.accumulate`, with what that takes from CUDA (the list of pairs of a pixel and a
Gaussian, and nerfacc's scan) in torch.
"""

from unittest import mock

import torch
from torch import Tensor

TILE = 16


def _squares(means2d, conics, depths, visible, width, height) -> tuple[Tensor, Tensor]:
    """Tiles and Gaussians [M] of all pairs, by tile and then by depth, from squares of three standard deviations."""
    a, b, c = conics.unbind(-1)
    det = a * c - b * b
    half_trace = (a + c) / (2 * det)
    radii = 3 * (half_trace + (half_trace.square() - 1 / det).clamp_min(0).sqrt()).sqrt()
    grid = torch.tensor([-(-width // TILE), -(-height // TILE)])
    first = ((means2d - radii[:, None]) / TILE).floor().long().clamp_min(0).minimum(grid)
    last = ((means2d + radii[:, None]) / TILE).ceil().long().clamp_min(0).minimum(grid)
    counts = (last - first).clamp_min(0)
    total = counts.prod(-1) * visible
    gaussians = torch.arange(len(means2d)).repeat_interleave(total)
    rank = torch.arange(len(gaussians)) - (total.cumsum(0) - total)[gaussians]
    columns = counts[gaussians, 0]
    x, y = first[gaussians, 0] + rank % columns, first[gaussians, 1] + rank // columns
    tiles = y * grid[0] + x
    order = depths.argsort(stable=True).argsort()[gaussians].add(tiles * len(means2d)).argsort()
    return tiles[order], gaussians[order]


def gsplat_formulation(means2d, conics, opacities, colors, depths, visible, width, height):
    """As `torch_backend.rasterize_to_pixels`, for one camera."""
    from gsplat.cuda._torch_impl import accumulate

    with torch.no_grad():
        pixels, gaussians = _pixel_pairs(means2d[0], conics[0], opacities[0], depths[0], visible[0], width, height)
    with mock.patch("nerfacc.render_weight_from_alpha", _weights):
        cameras = torch.zeros_like(pixels)
        return accumulate(means2d, conics, opacities, colors, gaussians, pixels, cameras, width, height)


def _pixel_pairs(means2d, conics, opacities, depths, visible, width, height):
    """Pixels and Gaussians [M] of all pairs that are drawn, by pixel and then by depth."""
    tiles, gaussians = _squares(means2d, conics, depths, visible, width, height)
    columns = -(-width // TILE)
    pixel = torch.arange(TILE * TILE)
    parts = []
    for tile, g in zip(tiles.split(4096), gaussians.split(4096), strict=True):
        x = (tile % columns * TILE)[:, None] + pixel % TILE
        y = (tile // columns * TILE)[:, None] + pixel // TILE
        dx, dy = x + 0.5 - means2d[g, :1], y + 0.5 - means2d[g, 1:]
        a, b, c = conics[g, :, None].unbind(1)
        alpha = opacities[g, None] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
        drawn = (alpha >= 1 / 255) & (x < width) & (y < height)
        parts.append((*((y * width + x)[drawn], g[:, None].expand_as(drawn)[drawn]), alpha[drawn].clamp_max(0.999)))
    pixels, gaussians, alpha = map(torch.cat, zip(*parts, strict=True))
    pixels, order = pixels.sort(stable=True)
    gaussians, alpha = gaussians[order], alpha[order]
    _, passed = _weights(alpha, pixels, width * height)
    drawn = passed * (1 - alpha) > 1e-4
    return pixels[drawn], gaussians[drawn]


def _weights(alphas, ray_indices, n_rays):
    """Weights and transmittances of samples sorted by ray, as nerfacc's function of this name."""
    logs = (1 - alphas).double().log()
    before = logs.cumsum(0) - logs
    starts = torch.searchsorted(ray_indices, torch.arange(n_rays))
    passed = (before - before[starts[ray_indices]]).exp().float()
    return alphas * passed, passed
