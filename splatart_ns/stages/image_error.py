"""How far a splat is from the images that it shall show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from splatart_ns.capture.view import View, evenly
from splatart_ns.errors import InputError
from splatart_ns.rasterize.render import Rendering, render
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.semantic import part_image
from splatart_ns.threads import side_by_side

MAX_VIEWS = 8
"""Of a state are looked at, evenly spread."""


@dataclass(frozen=True)
class ImageError:
    """What some views say of a splat."""

    psnr: float
    """Decibels, on white, the mean over the views."""
    of_object: float
    """Squared difference of premultiplied colour and accumulation, for each pixel that the object covers."""
    by_part: Tensor
    """What the pixels that show the background and each part add to that [P + 1]."""


def image_error(splat: Splat, views: Sequence[View]) -> ImageError:
    """How a splat shows some of `views`, which have alphas. What their masks leave out does not count.

    Raises:
        InputError: The masks leave nothing of any view.
    """
    views = [view for view in views if view.mask is None or view.mask.any()]
    if not views:
        raise InputError("the masks leave no pixel of any training image of a state: larger images or other masks do")
    chosen = evenly(views, MAX_VIEWS)
    psnr, by_part = (torch.stack(of) for of in zip(*side_by_side(lambda v: _error(splat, v), chosen), strict=True))
    by_part = by_part.sum(0) / max(sum(float(view.alpha.float().sum()) / 255 for view in chosen), 1.0)
    return ImageError(float(psnr.mean()), float(by_part.sum()), by_part)


def difference(rendering: Rendering, view: View) -> Tensor:
    """The rendering minus the image, of premultiplied colour and accumulation, where the loss looks: [H, W, 4]."""
    image = torch.cat([rendering.rgb[0], rendering.accumulation[0]], dim=-1)
    target = torch.cat([view.rgb_on(torch.zeros(3).to(view.rgb.device)), view.alpha[..., None] / 255], dim=-1).to(image)
    return image - target if view.mask is None else (image - target) * view.mask[..., None].to(image)


@torch.no_grad()
def _error(splat: Splat, view: View) -> tuple[Tensor, Tensor]:
    """Of one view: the PSNR; and the squared difference by part [P + 1], summed over pixels."""
    features = splat.part_probabilities
    rendering = render(splat, view.viewmat[None], view.K[None], view.width, view.height, features=features)
    off = difference(rendering, view)
    counts = off[..., 0].numel() if view.mask is None else int(view.mask.sum())
    psnr = -10 * ((off[..., :3] - off[..., 3:]).square().mean(-1).sum() / counts).clamp_min(1e-10).log10()
    shown = part_image(rendering)[0].argmax(-1).flatten()
    by_part = off.new_zeros(features.shape[-1]).index_add(0, shown, off.square().sum(-1).flatten())
    return psnr, by_part
