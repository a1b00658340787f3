"""Where the object ends in opaque images: by their labels, or by a labelled splat of object and surroundings."""

from __future__ import annotations

from dataclasses import replace

import torch

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


@torch.no_grad()
def rendered_silhouette(view: View, splat: Splat) -> View:
    """The view with the alpha that a labelled splat of object and surroundings shows: its share of parts' Gaussians."""
    camera = view.viewmat[None].to(splat.means), view.K[None].to(splat.means)
    rendering = render(
        splat, *camera, view.width, view.height, features=splat.part_probabilities, with_depth=False, sh_degree=0
    )
    share = 1 - part_image(rendering)[0, ..., 0]
    return replace(view, alpha=(255 * share.clamp(0, 1)).round().to(torch.uint8).to(view.rgb.device))
