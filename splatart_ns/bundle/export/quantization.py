"""Numbers packed into 8 or 16 bits each, for pages that carry their data with them."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any

import numpy as np


def quantized(values: np.ndarray, bits: int) -> dict[str, Any]:
    """A table [N, K] as JSON has it: bits, low [K], high [K], base64.

    Whole numbers of `bits` (8 or 16, little-endian), row by row, spread evenly over the range of each column. The error
    is half a step at most, (high - low) / (2^bits - 1) / 2.
    """
    values = np.asarray(values, float)
    low, high = (values.min(0), values.max(0)) if len(values) else (np.zeros(values.shape[1]),) * 2
    steps = 2**bits - 1
    numbers = np.rint((values - low) / np.where(high > low, high - low, 1.0) * steps).astype(f"<u{bits // 8}")
    text = base64.b64encode(numbers.tobytes()).decode("ascii")
    return {"bits": bits, "low": low.tolist(), "high": high.tolist(), "base64": text}


def restored(column: Mapping[str, Any]) -> np.ndarray:
    """The table [N, K] that `quantized` packed, to half a step."""
    bits, low, high = column["bits"], np.array(column["low"]), np.array(column["high"])
    numbers = np.frombuffer(base64.b64decode(column["base64"], validate=True), f"<u{bits // 8}")
    return low + (high - low) * numbers.reshape(-1, len(low)) / (2**bits - 1)
