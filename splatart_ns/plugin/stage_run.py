"""A stage's run of nerfstudio's trainer: in this process, or several side by side."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from queue import SimpleQueue

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer, TrainerConfig

from splatart_ns.choices import Rasterizer
from splatart_ns.machine import num_cores
from splatart_ns.plugin.companion import Companion, Companions, Outcome
from splatart_ns.plugin.compat import seed_everything, stop_event_writers
from splatart_ns.rasterize.rasterization import default_device
from splatart_ns.threads import kernel_threads

try:
    import resource
except ImportError:  # not on Windows
    resource = None


def run_stage(config: TrainerConfig, on_step: Callable[[int], None]) -> Outcome:
    """Train a stage; `on_step` gets the number of finished steps."""
    seed_everything(config.machine.seed)
    start = time.perf_counter()
    if default_device() == "cuda":
        torch.cuda.reset_peak_memory_stats()
    config.save_config()
    trainer: Trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    stop_event_writers()
    after = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
    trainer.callbacks.append(TrainingCallback(after, lambda step: on_step(step + 1)))
    trainer.train()
    on_step(config.max_num_iterations)
    return {
        "seconds": round(time.perf_counter() - start, 2),
        "iterations": config.max_num_iterations,
        "gaussians": trainer.pipeline.model.num_points,
        "peak_memory_mb": _peak_memory_mb(),
        "notes": getattr(trainer.pipeline, "notes", []),
        **getattr(trainer.pipeline, "findings", {}),
    }


ON_ONE_GPU = 2
"""Runs that train on a GPU side by side: to start its kernels takes a core longer than they take."""


def num_processes(runs: int) -> int:
    """How many runs to train side by side: one thread a run is faster than many threads a run, one after the other."""
    most = ON_ONE_GPU if default_device() == "cuda" else runs
    return max(1, min(runs, num_cores(), most))


def run_side_by_side(
    configs: Sequence[TrainerConfig],
    processes: int,
    backend: Rasterizer,
    on_step: Callable[[int, int], None],
    companions: Companions,
) -> Iterator[Outcome]:
    """Train stages that do not need each other; yields their outcomes in order, each when it and all before it ended.

    Args:
        configs: One per run.
        processes: How many at a time, this one among them, see `num_processes`; they share the cores evenly.
        backend: The rasterizer, which this process has chosen.
        on_step: Gets the run's number and its finished steps, on several threads.
        companions: The other processes; they have ended afterwards.

    Raises:
        InputError: raised by a run.
        RuntimeError: a run in another process ended otherwise; its last words are in the message.
    """
    waiting = deque(range(len(configs)))
    ended: SimpleQueue[tuple[int, Outcome | Exception]] = SimpleQueue()
    failed: list[Exception] = []
    threads = max(1, num_cores() // processes)

    def take() -> int | None:
        with suppress(IndexError):
            return waiting.popleft()

    def train_beside(companion: Companion) -> None:
        while (index := take()) is not None:
            try:
                ended.put((index, companion.train(configs[index], backend, threads, partial(on_step, index))))
            except Exception as error:
                failed.append(error)
                ended.put((index, error))
                return

    def on_own_step(index: int, steps: int) -> None:
        if failed:
            raise failed[0]
        on_step(index, steps)

    with companions, kernel_threads(threads):
        for companion in companions.first(min(processes, len(configs)) - 1):
            threading.Thread(target=train_beside, args=(companion,), daemon=True).start()
        outcomes: dict[int, Outcome] = {}
        following = 0
        while following < len(configs):
            if (index := take()) is not None:
                ended.put((index, run_stage(configs[index], partial(on_own_step, index))))
            while following < len(configs) and (index is None or not ended.empty()):
                number, outcome = ended.get()
                if isinstance(outcome, Exception):
                    raise outcome
                outcomes[number] = outcome
                while following in outcomes:
                    yield outcomes.pop(following)
                    following += 1


def _peak_memory_mb() -> int | None:
    """Of the GPU in this stage where there is one, else of this process so far; unknown on Windows."""
    if default_device() == "cuda":
        return torch.cuda.max_memory_allocated() // 2**20
    if resource is None:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak // (2**20 if sys.platform == "darwin" else 2**10)
