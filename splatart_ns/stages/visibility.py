"""Which Gaussians the views of a state show, and how much of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from splatart_ns.capture.view import View
from splatart_ns.rasterize.render import render
from splatart_ns.splats.splat import Splat

MAX_VIEWS = 40
"""More views than this add nothing to the answer."""
SEEN = 0.05
"""A Gaussian whose visibility is less is hidden: no image says where it should be."""


def visibility(splat: Splat, views: Sequence[View]) -> Tensor:
    """The most that each Gaussian contributes to any view [N], in pixels: its blending weights summed over the image.

    The gradient of a rendering with respect to a feature channel is the sum of blending weights, so one backward pass
    a view measures all Gaussians.
    """
    splat = splat.detach()
    most = torch.zeros(len(splat), device=splat.means.device)
    for view in views[:: -(-len(views) // MAX_VIEWS)]:
        feature = torch.zeros(len(splat), 1, device=most.device, requires_grad=True)
        camera = view.viewmat[None].to(most.device), view.K[None].to(most.device)
        with torch.enable_grad():
            image = render(splat, *camera, view.width, view.height, features=feature, with_depth=False, sh_degree=0)
            (gradient,) = torch.autograd.grad(image.features.sum(), feature)
        most = torch.maximum(most, gradient[:, 0])
    return most
