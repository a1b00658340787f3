"""Which Gaussians the views of a state show, and how much of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from splatart_ns.capture.view import View
from splatart_ns.rasterize.render import render
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.threads import side_by_side

MAX_VIEWS = 40
"""More views than this add nothing to the answer."""


def visibility(splat: Splat, views: Sequence[View]) -> Tensor:
    """What each Gaussian contributes to a view [N], in pixels: its blending weights summed over the image.

    The mean over all views. The gradient of a rendering with respect to a feature channel is the sum of blending
    weights, so one backward pass a view measures all Gaussians.
    """
    splat = splat.detach()
    device = splat.means.device
    views = views[:: -(-len(views) // MAX_VIEWS)]

    def shown_by(view: View) -> Tensor:
        feature = torch.zeros(len(splat), 1, device=device, requires_grad=True)
        camera = view.viewmat[None].to(device), view.K[None].to(device)
        image = render(splat, *camera, view.width, view.height, features=feature, with_depth=False, sh_degree=0)
        return torch.autograd.grad(image.features.sum(), feature)[0][:, 0]

    return sum(side_by_side(shown_by, views)) / len(views)


def shown(seen: Tensor, share: float = 0.98) -> Tensor:
    """Which Gaussians [N] make up `share` of all visibility `seen` [N]; the others are as good as hidden."""
    order = seen.argsort(descending=True)
    enough = seen[order].cumsum(0) - seen[order] < share * seen.sum()
    return torch.zeros_like(enough).scatter(0, order, enough)
