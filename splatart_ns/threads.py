"""How many threads work: kernels on pieces of an image, or views side by side."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")

_of_thread = threading.local()


def num_threads() -> int:
    """Threads that kernels and views may use: the calling thread's `kernel_threads`, else torch's number."""
    return getattr(_of_thread, "count", None) or torch.get_num_threads()


@contextmanager
def kernel_threads(count: int) -> Iterator[None]:
    """Within, kernels and views that this thread starts have `count` threads, and torch's own operations have one.

    Those are so many and so small here that waking a second thread takes longer than it saves.
    """
    before = torch.get_num_threads(), getattr(_of_thread, "count", None)
    torch.set_num_threads(1)
    _of_thread.count = count
    try:
        yield
    finally:
        _of_thread.count = before[1]
        torch.set_num_threads(before[0])


def side_by_side(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """`function` of every item, in the items' order, on `num_threads` threads at a time.

    Within `function` torch and the rasterizer have one thread each, and gradients are recorded. The results do not
    depend on the number of threads. With CUDA the items follow each other in the calling thread, and torch and the
    rasterizer have the threads they had.
    """
    threads, of_torch = num_threads(), torch.get_num_threads()
    if threads == 1 or torch.cuda.is_available():
        with torch.enable_grad():
            return [function(item) for item in items]
    try:
        with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            return list(pool.map(function, items))
    finally:
        torch.set_num_threads(of_torch)  # of threads that start later
