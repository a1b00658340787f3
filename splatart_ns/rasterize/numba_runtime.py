"""Compiling kernels, and running them on threads.

Kernels let go of the interpreter's lock and run in plain Python threads. Unlike numba's own threading layers these do
not spin while torch's OpenMP threads work, and kernels may be started by several threads at once (viewer and training).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import njit

_pool: ThreadPoolExecutor | None = None


def _forget_pool() -> None:
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):  # a forked child has the pool object but not its threads
    os.register_at_fork(after_in_child=_forget_pool)


def jit(function: Callable) -> Callable:
    """Compiles a kernel, cached on disk where a folder can be written. Sums may be reordered; inf and nan are kept."""
    options = {"nogil": True, "fastmath": {"contract", "reassoc", "nsz", "arcp"}, "error_model": "numpy"}
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # numba finds no folder for its cache
        return njit(**options)(function)


def run(kernel: Callable, bounds: np.ndarray, *args) -> None:
    """Calls `kernel(begin, end, worker, *args)` once per interval of `bounds` [workers + 1], at the same time.

    The calling thread takes the first interval.
    """
    global _pool
    workers = len(bounds) - 1
    if workers > 1 and _pool is None:
        _pool = ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="splatart-raster")
    futures = [_pool.submit(kernel, bounds[i], bounds[i + 1], i, *args) for i in range(1, workers)]
    kernel(bounds[0], bounds[1], 0, *args)
    for future in futures:
        future.result()


def even_bounds(count: int, workers: int) -> np.ndarray:
    """Bounds [workers + 1] of intervals that share `count` items evenly."""
    return np.array([i * count // workers for i in range(workers + 1)])


def balanced_bounds(offsets: np.ndarray, workers: int) -> np.ndarray:
    """Bounds [workers + 1] over items whose costs have the prefix sums `offsets` [items + 1], of even total cost."""
    goals = offsets[-1] * np.arange(1, workers) / workers
    return np.concatenate([[0], np.searchsorted(offsets, goals), [len(offsets) - 1]]).astype(np.int64)
