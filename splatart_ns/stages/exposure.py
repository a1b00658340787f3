"""Frames that were exposed differently, brought to one exposure: a phone's camera adapts between frames."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from splatart_ns.capture.view import View
from splatart_ns.rasterize.render import render
from splatart_ns.splats.splat import Splat

CLIPPED = 250
"""Pixels this bright may have been cut off and tell no gain."""
DARK = 10 / 255
"""Nor do channels darker than this, of which rounding and reflections are much: their gains are drawn to 1."""
FRAMES = 16
"""From so many frames on, gains are taken apart into what goes with the direction of view and the rest."""


@torch.no_grad()
def frame_gains(splat: Splat, views: Sequence[View], sh_degree: int | None = None) -> Tensor:
    """How many times brighter than the splat each view's image is, by channel [N, 3].

    Least squares between rendering and image on the object's pixels, as far as they count; 1 where none does, and the
    geometric mean of the others is 1.
    """
    gains, tell = [], []
    for view in views:
        camera = view.viewmat[None].to(splat.means), view.K[None].to(splat.means)
        rendering = render(splat, *camera, view.width, view.height, with_depth=False, sh_degree=sh_degree)
        counts = (rendering.accumulation[0] > 0.9) & (view.rgb < CLIPPED).all(-1, keepdim=True).to(splat.means.device)
        if view.alpha is not None:
            counts &= (view.alpha > 250)[..., None].to(counts.device)
        if view.mask is not None:
            counts &= view.mask[..., None].to(counts.device)
        shown = rendering.rgb[0] * counts
        image = view.rgb.to(shown) / 255 * counts
        dark = DARK**2 * counts.sum()
        gains.append(((shown * image).sum((0, 1)) + dark) / (shown.square().sum((0, 1)) + dark).clamp_min(1e-12))
        tell.append(counts.any())
    gains, tell = torch.stack(gains), torch.stack(tell)
    if tell.any():
        gains = gains / gains[tell].log().mean(0).exp()
    return torch.where(tell[:, None], gains, 1.0)


def unevenness(gains: Tensor, views: Sequence[View]) -> float:
    """Standard deviation of the logarithms of the views' gains [N, 3], as far as it is their exposures'.

    What goes linearly with the direction of view is light: an object is brighter from where the sun is. And a view or
    two may show what the splat has not learned yet, as a blade from its edge. So it is that of what is left, told by
    the median of its absolute values (Hampel 1974, "The influence curve and its role in robust estimation").
    """
    # On the CPU, where least squares need no full rank: views from one height have none.
    logs = gains.log().cpu()
    viewmats = torch.stack([view.viewmat for view in views]).to(logs)
    terms = torch.ones_like(logs[:, :1])
    if len(views) >= FRAMES:
        # The camera looks along its z axis, the third row of the rotation.
        terms = torch.cat([terms, viewmats[:, 2, :3]], -1)
    rest = logs - terms @ torch.linalg.lstsq(terms, logs).solution
    fewer = len(views) / max(1, len(views) - terms.shape[1])
    return 1.4826 * fewer**0.5 * float((rest - rest.median(0).values).abs().median())


def at_gain(rgb: Tensor, gain: Tensor) -> Tensor:
    """An image [H, W, 3], uint8 or 0..1, without its gain [3]."""
    top = 255 if rgb.dtype == torch.uint8 else 1
    out = (rgb.float() / gain.to(rgb.device)).clamp(0, top)
    return out.round().to(torch.uint8) if rgb.dtype == torch.uint8 else out
