"""Views looked at side by side: each on a thread of its own, as torch's own threads gain nothing on small tensors."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")


def side_by_side(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """`function` of every item, in the items' order, on as many threads at a time as torch has.

    Within `function` torch and the rasterizer have one thread each, and gradients are recorded. The results do not
    depend on the number of threads.
    """
    threads = torch.get_num_threads()
    if threads == 1 or torch.cuda.is_available():
        with torch.enable_grad():
            return [function(item) for item in items]
    try:
        with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            return list(pool.map(function, items))
    finally:
        torch.set_num_threads(threads)  # of threads that start later
