"""Directions that are spread evenly."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def golden_spiral(z: Tensor) -> Tensor:
    """Unit vectors [N, 3] at heights z [N], each a golden angle further about z: at even heights a Fibonacci
    lattice."""
    azimuth = torch.arange(len(z), dtype=z.dtype) * math.pi * (3 - math.sqrt(5))
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), z], -1)
