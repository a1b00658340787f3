"""Speed against error: which points nothing beats, how cost grows, and ratios of paired runs."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points (cost, error), the less the better, that no other point beats in one without losing in the
    other; cheapest first. Of equal points all are kept; a point that is not finite is none.
    """
    finite = [i for i, point in enumerate(points) if all(map(math.isfinite, point))]
    front, best, last = [], math.inf, None
    for i in sorted(finite, key=lambda i: points[i]):
        if points[i][1] < best or points[i] == last:
            front.append(i)
            best, last = points[i][1], points[i]
    return front


@dataclass(frozen=True)
class Growth:
    """cost ~ size^slope."""

    slope: float
    """Least squares over all points, in logarithms; what is constant in the cost flattens it."""
    last: float
    """Between the medians of the two largest sizes."""


def growth(sizes: Sequence[float], costs: Sequence[float]) -> Growth | None:
    """None for fewer than two different sizes. Sizes and costs are positive."""
    different = sorted(set(sizes))
    if len(different) < 2:
        return None
    x, y = [math.log(s) for s in sizes], [math.log(c) for c in costs]
    mx, my = math.fsum(x) / len(x), math.fsum(y) / len(y)
    slope = math.fsum((a - mx) * (b - my) for a, b in zip(x, y, strict=True)) / math.fsum((a - mx) ** 2 for a in x)
    low, high = (
        statistics.median(c for s, c in zip(sizes, costs, strict=True) if s == size) for size in different[-2:]
    )
    return Growth(slope, math.log(high / low) / math.log(different[-1] / different[-2]))


def paired_ratio(values: Mapping[str, float], base: Mapping[str, float]) -> tuple[float, int]:
    """The geometric mean of value / base over the runs that both have, and their number; NaN for none.

    Runs without a positive finite value on both sides do not count.
    """
    logs = [
        math.log(values[run] / base[run])
        for run in values.keys() & base.keys()
        if 0 < values[run] < math.inf and 0 < base[run] < math.inf
    ]
    return (math.exp(math.fsum(logs) / len(logs)) if logs else math.nan), len(logs)
