"""Colours of renderings and images, compared as if both were lit alike.

Light stays in the world while parts turn, so a moved part is rendered brighter here and darker there than it is. Where
surfaces are smooth, light changes slowly over the image, and edges, prints and creases stay sharp whatever the light:
once the mean brightness over a few pixels agrees, what is left says where the part is, also of a grey one.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

REACH = 2
"""Pixels to each side over which a mean goes, twice (`_mean` is written for two)."""
DARK = 0.02
"""Added to means of brightness before they are divided: that of black says nothing."""
MOST = 3.0
"""A light is at most so many times brighter or darker than the other."""


def even_light(rgba: Tensor, wanted: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """By what colours of pictures [K, H, W, 4] are multiplied [K, H, W] to be lit as the `wanted` one [H, W, 4] is, and
    how far inside both silhouettes pixels lie [K, H, W], 0..1: towards the edges means have little to go by.

    All are colours over black with their silhouettes, 0..1. Pixels of `weight` [H, W] 0 count in no mean.
    """
    shown, light = _lit(rgba, weight)
    shown_wanted, light_wanted = _lit(wanted[None], weight)
    return (light_wanted / light).clamp_(1 / MOST, MOST), shown.mul_(shown_wanted)


def _lit(rgba: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Of pictures [K, H, W, 4] how much of the part is around, and how it is lit there: [K, H, W]."""
    bright = rgba @ torch.tensor([1 / 3, 1 / 3, 1 / 3, 0]).to(rgba)
    around, shown = _mean(torch.stack([bright, rgba[..., 3]]), weight)
    return shown, (around / (shown + DARK)).add_(DARK)


def _mean(x: Tensor, weight: Tensor) -> Tensor:
    """Means [..., H, W] over squares, twice, of x times `weight` [H, W]; outside is 0. Overwrites x.

    Shifted pictures are added, each five as four and one: pooling takes 5 times longer.
    """
    x *= weight / (2 * REACH + 1) ** 4
    for dim, sides in ((-1, (REACH, REACH)), (-2, (0, 0, REACH, REACH))):
        for _ in range(2):
            padded, size = pad(x, sides), x.shape[dim]
            two = padded.narrow(dim, 0, size + 2) + padded.narrow(dim, 1, size + 2)
            x = two.narrow(dim, 0, size) + two.narrow(dim, 2, size)
            x += padded.narrow(dim, 4, size)
    return x
