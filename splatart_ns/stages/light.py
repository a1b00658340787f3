"""Colours of renderings and images, compared as if both were lit alike.

Light stays in the world while parts turn, so a moved part is rendered brighter here and darker there than it is. Where
surfaces are smooth, light changes slowly over the image, and edges, prints and creases stay sharp whatever the light:
what is left of the difference once the mean brightness over a few pixels agrees says where the part is, also of a grey
one.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

REACH = 2
"""Pixels to each side over which a mean goes, twice."""
DARK = 0.02
"""Added to means of brightness before they are divided: that of black says nothing."""
MOST = 3.0
"""A light is at most so many times brighter or darker than the other."""


def light_ratio(rgba: Tensor, wanted: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """How many times brighter the `wanted` picture [H, W, 4] is lit than others [K, H, W, 4] are, and how far their
    brightness, once multiplied by that, tells [K, H, W].

    All are colours over black with their silhouettes, 0..1. Pixels of `weight` [H, W] 0 count in no mean. Towards the
    silhouettes means have little to go by, and brightness tells less.
    """
    light, shown = _light(rgba, weight)
    light_wanted, shown_wanted = _light(wanted[None], weight)
    return (light_wanted / light).clamp_(1 / MOST, MOST), shown.mul_(shown_wanted)


def _light(rgba: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Of pictures [K, H, W, 4] how the part is lit around a pixel, and how much of it is there: [K, H, W]."""
    bright = rgba @ torch.tensor([1 / 3, 1 / 3, 1 / 3, 0]).to(rgba)
    around, shown = _mean(torch.stack([bright, rgba[..., 3]]).mul_(weight))
    return (around / (shown + DARK)).add_(DARK), shown


def _mean(x: Tensor) -> Tensor:
    """Means [..., H, W] over squares, twice; outside is 0. Shifted pictures are added: pooling takes 5 times longer."""
    for dim, sides in ((-1, (REACH, REACH)), (-2, (0, 0, REACH, REACH))):
        for _ in range(2):
            padded, size = pad(x, sides), x.shape[dim]
            x = padded.narrow(dim, 0, size).clone()
            for shift in range(1, 2 * REACH + 1):
                x += padded.narrow(dim, shift, size)
            x /= 2 * REACH + 1
    return x
