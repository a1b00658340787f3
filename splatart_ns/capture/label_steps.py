"""How labels lead from one id to another: at once, or over ids in between, as interpolation leaves them."""

from __future__ import annotations

from collections import Counter
from itertools import repeat

import numpy as np

from splatart_ns.capture.capture import UNLABELLED


def count_steps(labels: np.ndarray) -> Counter[tuple[int, int, bool]]:
    """How often two ids that differ by two or more follow each other along rows and columns of labels [H, W]: by the
    lower one, the higher one, and whether over one or two pixels of ids between them.

    Each must go on for three pixels: it is no rim of ids in between then.
    """
    counts: Counter[tuple[int, int, bool]] = Counter()
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
            found = apart & inside & goes_on
            counts.update(zip(low[found].tolist(), high[found].tolist(), repeat(width > 0)))
    return counts


def blurred_share(steps: Counter[tuple[int, int, bool]]) -> float:
    """How many of the steps lead over ids in between: of all, or of those between the ids of the middle step, which is
    less. A part that is a rim between two others is so between these alone; interpolation leaves rims everywhere.
    """
    numbers = Counter[tuple[int, int]]()
    for (low, high, _), number in steps.items():
        numbers[low, high] += number
    if not numbers:
        return 0.0
    shares = np.repeat([steps[*pair, True] / n for pair, n in numbers.items()], list(numbers.values()))
    return float(min(shares.mean(), np.median(shares)))
