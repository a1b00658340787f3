"""How labels lead from one id to another: at once, or over ids in between, as interpolation leaves them."""

from __future__ import annotations

import numpy as np

from splatart_ns.capture.capture import UNLABELLED


def count_steps(labels: np.ndarray) -> np.ndarray:
    """How often two ids that differ by two or more follow each other along rows and columns of labels [H, W]: int [2],
    at once, and over one or two pixels of ids between them.

    Each must go on for three pixels: it is no rim of ids in between then.
    """
    counts = np.zeros(2, int)
    for rows in (labels, labels.T):
        y, x = np.nonzero(rows[:, 2:-5] != rows[:, 3:-4])
        ids = rows[y[:, None], x[:, None] + np.arange(8)]  # three pixels before a change, five after it
        before, steady = ids[:, 2], (ids[:, :3] == ids[:, 2:3]).all(axis=1)
        for width in range(3):
            after, between = ids[:, 3 + width], ids[:, 3 : 3 + width]
            low, high = np.minimum(before, after), np.maximum(before, after)
            apart = (high - low > 1) & (high != UNLABELLED)
            inside = ((between > low[:, None]) & (between < high[:, None])).all(axis=1)
            goes_on = (ids[:, 3 + width : 6 + width] == after[:, None]).all(axis=1)
            counts[min(width, 1)] += (steady & apart & inside & goes_on).sum()
    return counts
