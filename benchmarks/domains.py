"""Where in their domains the operations are tried, and what all of them use."""

from __future__ import annotations

import math

import torch
from torch import Tensor

ANGLES = (0.0, 1e-12, 1e-9, 1e-6, 1e-4, 1e-2, 0.1, 0.5, 1.0, 2.0, 3.0, *(math.pi - d for d in (1e-3, 1e-6, 1e-9, 0.0)))
SCALES = tuple(10.0**k for k in range(-8, 9, 2))
AXES = ((0.36, -0.48, 0.8), (1.0, 0.0, 0.0), (1 / math.sqrt(2), 1 / math.sqrt(2), 0.0))


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def numbers(count: int, seed: int) -> Tensor:
    """Standard normal."""
    return torch.randn(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def intrinsics(like: Tensor) -> Tensor:
    return torch.tensor([[50.0, 0, 22], [0, 48, 18], [0, 0, 1]]).to(like)
