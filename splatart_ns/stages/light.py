"""Brightness of renderings and images, compared as if both were lit alike.

Light stays in the world while parts turn, so a moved part is rendered brighter here and darker there than it is. Where
surfaces are smooth, light changes slowly over the image, and edges, prints and creases stay sharp whatever the light:
what is left of the brightness once its mean over a few pixels agrees says where the part is, also of a grey one.
"""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import avg_pool2d

REACH = 2
"""Pixels to each side over which a mean goes, twice."""
DARK = 0.02
"""Added to means of brightness before they are divided: that of black says nothing."""
MOST = 3.0
"""A light is at most so many times brighter or darker than the other."""


def difference_in_even_light(rgba: Tensor, wanted: Tensor, weight: Tensor) -> Tensor:
    """How much brighter pictures [K, H, W, 4] are than the `wanted` one [H, W, 4], once lit as that is [K, H, W, 1].

    Both are colours over black with their silhouettes, 0..1. Pixels of `weight` [H, W] 0 count in no mean. Towards the
    silhouettes, where means have little to go by, the difference fades.
    """
    weight = weight[..., None]
    (bright, shown), (bright_wanted, shown_wanted) = (
        (x[..., :3].mean(-1, keepdim=True), _mean(x[..., 3:] * weight)) for x in (rgba, wanted[None])
    )
    light = _mean(bright * weight) / (shown + DARK) + DARK
    light_wanted = _mean(bright_wanted * weight) / (shown_wanted + DARK) + DARK
    gain = (light_wanted / light).clamp(1 / MOST, MOST)
    return (gain * bright - bright_wanted) * (shown * shown_wanted)


def _mean(x: Tensor) -> Tensor:
    """Means [K, H, W, 1] over squares, twice; outside is 0."""
    x = x.movedim(-1, 1)
    for _ in range(2):
        x = avg_pool2d(x, 2 * REACH + 1, 1, REACH)
    return x.movedim(1, -1)
