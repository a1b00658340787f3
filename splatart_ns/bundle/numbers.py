"""Numbers as users give them, in lists, arrays and tensors."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def as_float64(value: object) -> Tensor:
    """A float64 tensor on the CPU of numbers, nested lists, arrays or tensors, also of lists of these; keeps gradients.

    Raises TypeError, ValueError or OverflowError where they are no numbers of one shape.
    """
    if isinstance(value, list | tuple) and any(isinstance(item, list | tuple | Tensor | np.ndarray) for item in value):
        items = [as_float64(item) for item in value]
        if len({item.shape for item in items}) > 1:
            raise ValueError("of different shapes")
        return torch.stack(items)
    if isinstance(value, np.ndarray):
        value = np.ascontiguousarray(value)  # torch knows no negative strides
    return torch.as_tensor(value, dtype=torch.float64).cpu()
