"""Colours that do not depend on how brightly a surface is lit.

Light stays in the world while parts turn, so that the dark side of a part becomes the bright one, and a flat part that
is turned over fits the better for it. White light of any strength leaves the ratios of a colour's channels alone.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from splatart_ns.geometry.spherical_harmonics import SH_C0
from splatart_ns.stages.part_pair import PartPair, PartView

FLOOR = 0.05
"""Added to all channels: the ratios of dark colours are noise."""
GAIN = 2.0
"""A channel's share of the three differs less than the channel itself."""


def hue(rgb: Tensor) -> Tensor:
    """`GAIN` times each channel's share [..., 3] of colours in 0..1; grey is `GAIN` / 3 whatever its brightness."""
    rgb = rgb.clamp(0, 1) + FLOOR
    return GAIN * rgb / rgb.sum(-1, keepdim=True)


def without_shading(pair: PartPair) -> PartPair:
    """The pair with `hue` in the place of colours, in the views and of the Gaussians."""
    splats = tuple(replace(s, sh=((hue(s.base_colours) - 0.5) / SH_C0)[:, None]) for s in pair.splats)
    views = tuple(tuple(_without_shading(view) for view in of_state) for of_state in pair.views)
    return replace(pair, splats=splats, views=views)


def _without_shading(view: PartView) -> PartView:
    alpha = view.rgba[..., 3:]
    return replace(view, rgba=torch.cat([alpha * hue(view.rgba[..., :3] / alpha.clamp_min(1e-3)), alpha], dim=-1))
