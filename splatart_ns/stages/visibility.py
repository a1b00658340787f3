"""Which Gaussians the views of a state show, and how much of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from splatart_ns.capture.view import View, evenly
from splatart_ns.rasterize.render import Rendering, render
from splatart_ns.splats.splat import Splat
from splatart_ns.threads import side_by_side

MAX_VIEWS = 40
"""More views than this add nothing to the answer."""


HIDDEN = 0.03
"""A Gaussian of which the `clearest` view shows less lies behind others, and no image says what is there."""


def visibility(splat: Splat, views: Sequence[View]) -> Tensor:
    """What each Gaussian contributes to a view [N], in pixels: its blending weights summed over the image.

    The mean over all views.
    """
    return looked_at(splat, views)[0]


def clearest(splat: Splat, views: Sequence[View]) -> Tensor:
    """The share of each Gaussian [N] that the view shows which shows it best: 1 if nothing is before it there."""
    return looked_at(splat, views)[1]


def looked_at(splat: Splat, views: Sequence[View]) -> tuple[Tensor, Tensor]:
    """`visibility` and `clearest` at the price of one."""
    views = evenly(views, MAX_VIEWS)
    contributions, alone = map(torch.stack, zip(*side_by_side(partial(_contribution, splat), views), strict=True))
    share = torch.where(alone > 0, contributions / alone.clamp_min(1e-6), 0.0)
    return contributions.mean(0), share.amax(0)


def _contribution(splat: Splat, view: View) -> tuple[Tensor, Tensor]:
    """What each Gaussian contributes to a view [N], and what it would if nothing were before it [N], in pixels.

    The gradient of a rendering with respect to a feature channel is the sum of blending weights, so one backward pass
    measures all Gaussians.
    """
    splat = splat.detach()
    device = splat.means.device
    feature = torch.zeros(len(splat), 1, device=device, requires_grad=True)
    camera = view.viewmat[None].to(device), view.K[None].to(device)
    rendering = render(splat, *camera, view.width, view.height, features=feature, with_depth=False, sh_degree=0)
    contribution = torch.autograd.grad(rendering.features.sum(), feature)[0][:, 0]
    return contribution, unobstructed(splat, rendering)


def unobstructed(splat: Splat, rendering: Rendering) -> Tensor:
    """What each Gaussian would contribute to the first image of a rendering [N], in pixels, if nothing were before it.

    That is its opacity times the integral of exp(-x^T C x / 2), 2 pi / sqrt(|C|).
    """
    a, b, c = rendering.info["conics"][0].detach().unbind(-1)
    radii = rendering.info["radii"][0]  # [N], or [N, 2] of newer versions of gsplat
    drawn = (radii if radii.ndim == 1 else radii.amin(-1)) > 0
    alone = splat.opacities.detach() * 2 * math.pi / (a * c - b * b).clamp_min(1e-12).sqrt()
    return torch.where(drawn, alone, 0.0)


def shown_of_parts(splats: Sequence[Splat], seen: Sequence[Tensor], num_parts: int) -> Tensor:
    """How much of each part 1..P each state shows [S, P]: the sums of its Gaussians' `visibility`, `seen` [N]."""
    amounts = []
    for splat, of_splat in zip(splats, seen, strict=True):
        amount = torch.zeros(num_parts + 1).index_add(0, splat.part_ids.cpu(), of_splat.cpu().float())
        amounts.append(amount[1:])
    return torch.stack(amounts)


def shown(seen: Tensor, share: float = 0.98) -> Tensor:
    """Which Gaussians [N] make up `share` of all visibility `seen` [N]; the others are as good as hidden."""
    order = seen.argsort(descending=True)
    enough = seen[order].cumsum(0) - seen[order] < share * seen.sum()
    return torch.zeros_like(enough).scatter(0, order, enough)
