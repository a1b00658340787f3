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
        ids = rows[y, x + np.arange(8)[:, None]]  # three pixels before a change, five after it
        ids = ids[:, (ids[0] == ids[2]) & (ids[1] == ids[2])]
        for width in range(3):
            between, after = ids[3 : 3 + width], ids[3 + width : 6 + width]
            low, high = np.minimum(ids[2], after[0]), np.maximum(ids[2], after[0])
            apart = (high - low > 1) & (high != UNLABELLED)
            inside = ((low < between) & (between < high)).all(axis=0)
            goes_on = (after[1:] == after[0]).all(axis=0)
            counts[min(width, 1)] += (apart & inside & goes_on).sum()
    return counts
