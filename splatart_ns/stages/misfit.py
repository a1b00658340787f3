"""How far a splat is from the images that it shall show."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from splatart_ns.capture.view import View
from splatart_ns.rasterize.render import render
from splatart_ns.splats.splat import Splat
from splatart_ns.threads import side_by_side

_FEW_VIEWS = 8
FAR, HARDLY = 10.0, 1e-3
"""Posed parts do not fit a state if they are so many times as far from its images as its own splat, which is hardly off
at the second. In 73 states of 33 sound captures it was 5.9 times at most; where labels had other ids in one of two
states, 11 to 400."""


def difference(splat: Splat, view: View) -> Tensor:
    """The rendering minus the image, of premultiplied colour and accumulation, where the loss looks: [H, W, 4]."""
    rendering = render(splat, view.viewmat[None], view.K[None], view.width, view.height, with_depth=False)
    image = torch.cat([rendering.rgb[0], rendering.accumulation[0]], dim=-1)
    target = torch.cat([view.rgb_on(torch.zeros(3).to(view.rgb.device)), view.alpha[..., None] / 255], dim=-1).to(image)
    if view.mask is not None:
        image, target = (x * view.mask[..., None].to(image) for x in (image, target))
    return image - target


@torch.no_grad()
def misfit(splat: Splat, views: Sequence[View]) -> float:
    """The squared difference from a few of the views, evenly spread, for each pixel that the object covers."""
    few = views[:: -(-len(views) // _FEW_VIEWS)]
    error = sum(side_by_side(lambda k: float(difference(splat, few[k]).square().sum()), range(len(few))))
    return error / max(sum(float(view.alpha.float().sum()) / 255 for view in few), 1.0)
