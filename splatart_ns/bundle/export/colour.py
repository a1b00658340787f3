"""Colours of images and of light."""

from __future__ import annotations

import numpy as np


def linear_from_srgb(colours: np.ndarray) -> np.ndarray:
    """Linear light from sRGB colours in 0..1 (IEC 61966-2-1)."""
    return np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
