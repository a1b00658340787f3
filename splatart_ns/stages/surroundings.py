"""What surrounds the object where images are opaque: points to start its Gaussians from."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor

from splatart_ns.capture.hull import project
from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import inverse
from splatart_ns.stages.hull import SeedPoints

_NEAREST, _FARTHEST, _DEPTHS = 0.3, 12.0, 64
"""Depths that are tried along a ray, evenly in their inverse, in distances of the camera from the world's origin."""
_MOST_VIEWS = 24
_LEAST_VIEWS = 3
_BLURS = (1.0, 3.0)


def surrounding_points(views: Sequence[View], count: int, generator: torch.Generator) -> SeedPoints:
    """Points on all that the views show: each on the ray of a pixel drawn at random, where the views' colours agree.

    A plane sweep for single pixels: the depth is taken at which the median difference between the pixel and what the
    views show there, of blurred colours, is least. Where no depth is seen by three views, one is drawn at random.
    """
    index = torch.randint(len(views), (count,), generator=generator)
    place = torch.rand(count, 2, generator=generator)
    points, colours = torch.zeros(count, _DEPTHS, 3), torch.zeros(count, 3)
    own = torch.zeros(count, 3 * len(_BLURS))
    every, looks = -(-len(views) // _MOST_VIEWS), []
    for i, view in enumerate(views):
        blurred = _blurred(view)
        if i % every == 0:
            looks.append((view, blurred))
        mine = (index == i).nonzero()[:, 0]
        column = (place[mine, 0] * view.width).long()
        row = (place[mine, 1] * view.height).long()
        T_world_camera = inverse(view.viewmat)
        distance = float(T_world_camera[:3, 3].norm())
        depths = distance / torch.linspace(1 / _NEAREST, 1 / _FARTHEST, _DEPTHS)
        pixels = torch.stack([column + 0.5, row + 0.5, torch.ones(len(mine))], -1)
        rays = pixels @ torch.linalg.inv(view.K).T @ T_world_camera[:3, :3].T
        points[mine] = T_world_camera[:3, 3] + depths[:, None] * rays[:, None]
        colours[mine] = view.rgb[row, column].float()
        own[mine] = blurred[row, column]
    differences = []
    for view, image in looks:
        column, row, _, visible = project(view, points.reshape(-1, 3))
        difference = (image[row, column].reshape(count, _DEPTHS, -1) - own[:, None]).abs().mean(-1)
        differences.append(torch.where(visible.reshape(count, _DEPTHS), difference, torch.nan))
    differences = torch.stack(differences)
    known = differences.isfinite().sum(0) >= _LEAST_VIEWS
    cost = torch.where(known, differences.nanmedian(0).values, torch.inf)
    best = torch.where(known.any(1), cost.argmin(1), torch.randint(_DEPTHS, (count,), generator=generator))
    return SeedPoints.without_normals(points[torch.arange(count), best], colours)


def _blurred(view: View) -> Tensor:
    """Colours [H, W, 3 per blur] in 0..255."""
    image = view.rgb.permute(2, 0, 1)[None].float()
    sizes = [2 * round(2 * sigma) + 1 for sigma in _BLURS]
    blurs = [gaussian_blur2d(image, (size, size), (sigma, sigma)) for size, sigma in zip(sizes, _BLURS, strict=True)]
    return torch.cat(blurs, 1)[0].permute(1, 2, 0)
