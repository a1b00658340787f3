"""What images do not say: where the object ends in opaque ones, by their labels or a labelled splat, and which part is
where in unlabelled ones."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from splatart_ns.capture.capture import UNLABELLED
from splatart_ns.capture.view import View
from splatart_ns.rasterize.render import render
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.semantic import part_image


def with_silhouette(view: View) -> View | None:
    """The view with an alpha, for opaque images from their labels; None for one that has neither.

    Unlabelled pixels count in no loss.
    """
    if view.alpha is not None or view.labels is None:
        return None if view.alpha is None else view
    alpha = 255 * ((view.labels > 0) & (view.labels != UNLABELLED)).to(torch.uint8)
    counts = view.labels != UNLABELLED
    return replace(view, alpha=alpha, mask=counts if view.mask is None else view.mask & counts)


STEEPER = 4.0
"""A rendered silhouette is none of the object where its Gaussians' share is three eighths, and all where it is five."""


def rendered_silhouette(view: View, splat: Splat) -> View:
    """The view with the alpha that a labelled splat of object and surroundings shows: its share of parts' Gaussians.

    Steeper than that share is: things are opaque, but for pixels at their edges, while Gaussians of the object let what
    is behind them through, of which training does not ask that it be the object's.
    """
    share = 1 - _shares(view, splat)[..., 0]
    alpha = (0.5 + STEEPER * (share - 0.5)).clamp(0, 1)
    return replace(view, alpha=(255 * alpha).round().to(torch.uint8), outlined_by_splat=True)


SHOWN = 0.1
"""Where a splat shows less than this of the object, it does not know what is there."""


def with_rendered_labels(view: View, splat: Splat) -> View:
    """The view, which has an alpha, with the labels that a labelled splat shows where it has none of its own."""
    if view.labels is not None:
        return view
    of_parts = _shares(view, splat)[..., 1:]
    labels = torch.where(of_parts.sum(-1) >= SHOWN, of_parts.argmax(-1) + 1, UNLABELLED)
    return replace(view, labels=labels.where(view.alpha > 0, 0).to(torch.uint8))


@torch.no_grad()
def _shares(view: View, splat: Splat) -> Tensor:
    """How much of each pixel is background and each part by a labelled splat [H, W, P + 1], on the view's device."""
    camera = view.viewmat[None].to(splat.means), view.K[None].to(splat.means)
    rendering = render(
        splat, *camera, view.width, view.height, features=splat.part_probabilities, with_depth=False, sh_degree=0
    )
    return part_image(rendering)[0].to(view.rgb.device)
