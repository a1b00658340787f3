"""Numbers as users give them, in lists, arrays and tensors."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def as_float64(value: object) -> Tensor:
    """A float64 tensor on the CPU of numbers, nested lists, arrays or tensors, also of lists of these; keeps gradients.

    Raises TypeError, ValueError or OverflowError where they are no real numbers of one shape, all of them there.
    """
    if isinstance(value, list | tuple):
        if any(isinstance(item, list | tuple | Tensor | np.ndarray) for item in value):
            items = [as_float64(item) for item in value]
            if len({item.shape for item in items}) > 1:
                raise ValueError("of different shapes")
            return torch.stack(items)
        complex_ = any(isinstance(item, np.complexfloating) for item in value)
    elif isinstance(value, Tensor):
        complex_ = value.is_complex()
        if value.layout != torch.strided:
            raise TypeError("a sparse tensor")
    else:
        complex_ = np.iscomplexobj(value)
    if complex_:
        raise TypeError("complex")  # torch would take the real parts
    if isinstance(value, np.ndarray):
        if np.ma.is_masked(value):
            raise TypeError("masked")  # torch would take what is under the mask
        if value.dtype.kind in "biuf":
            value = value.astype(np.float64, order="C")  # torch knows no negative strides and no foreign byte order
    return torch.as_tensor(value, dtype=torch.float64).cpu()
