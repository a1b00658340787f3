"""The colours that parts are shown in."""

from __future__ import annotations

import colorsys

import torch
from torch import Tensor

_GOLDEN = 0.6180339887498949


def part_colours(count: int) -> Tensor:
    """Colours [count + 1, 3] in 0..1 of background (black) and parts 1..count.

    A part's colour depends on its id alone, and neighbouring ids differ most.
    """
    hues = [colorsys.hsv_to_rgb((part * _GOLDEN) % 1, 0.65, 0.9) for part in range(1, count + 1)]
    return torch.tensor([(0.0, 0.0, 0.0), *hues])
