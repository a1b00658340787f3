"""A stage's run of nerfstudio's trainer: in this process, or several side by side in processes of their own."""

from __future__ import annotations

import io
import json
import os
import pickle
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from queue import SimpleQueue
from typing import Any, BinaryIO

# Of both ends of `run_side_by_side`; it is read when torch is imported. See splatart_ns/cli.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE

from splatart_ns.errors import InputError
from splatart_ns.machine import num_cores
from splatart_ns.plugin.compat import seed_everything, stop_event_writers
from splatart_ns.rasterize.rasterization import Backend, set_backend

Outcome = dict[str, Any]
"""What a run took: seconds, iterations, gaussians, peak_memory_mb; its notes for the user; and what else it found."""


def run_stage(config: TrainerConfig, on_step: Callable[[int], None]) -> Outcome:
    """Train a stage; `on_step` gets the number of finished steps."""
    seed_everything(config.machine.seed)
    start = time.perf_counter()
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


def num_processes(runs: int) -> int:
    """How many runs to train side by side: one thread a run is faster than many threads a run, one after the other."""
    return 1 if torch.cuda.is_available() else max(1, min(runs, num_cores()))


def run_side_by_side(
    configs: Sequence[TrainerConfig], processes: int, backend: Backend, on_step: Callable[[int, int], None]
) -> Iterator[Outcome]:
    """Train stages that do not need each other; yields their outcomes in order, each when it and all before it ended.

    Args:
        configs: One per run.
        processes: How many at a time, see `num_processes`; they share the cores evenly.
        backend: The rasterizer.
        on_step: Gets the run's number and its finished steps.

    Raises:
        InputError: raised by a run.
        RuntimeError: a run ended otherwise; its last words are in the message.
    """
    threads = max(1, num_cores() // processes)
    events: SimpleQueue[tuple[int, str, Any]] = SimpleQueue()
    waiting, outcomes, following = list(range(len(configs))), {}, 0
    with ExitStack() as running:
        for _ in range(min(processes, len(configs))):
            _start(waiting.pop(0), configs, backend, threads, events, running)
        while following < len(configs):
            index, kind, value = events.get()
            if kind == "step":
                on_step(index, value)
            elif kind == "input error":
                raise InputError(value)
            elif kind == "end":
                value.seek(0)
                words = value.read().decode(errors="replace")[-2000:]
                raise RuntimeError(f"{configs[index].get_base_dir()} ended without a result: {words}")
            else:
                outcomes[index] = value
                if waiting:
                    _start(waiting.pop(0), configs, backend, threads, events, running)
            while following in outcomes:
                yield outcomes.pop(following)
                following += 1


def _start(
    index: int,
    configs: Sequence[TrainerConfig],
    backend: Backend,
    threads: int,
    events: SimpleQueue[tuple[int, str, Any]],
    running: ExitStack,
) -> None:
    """Start a run in a process of its own, and a thread that hands on what it tells."""
    words = running.enter_context(tempfile.TemporaryFile())
    process = subprocess.Popen(
        [sys.executable, "-m", __name__],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=words,
        env=os.environ | {"OMP_NUM_THREADS": str(threads)},
        start_new_session=True,  # Ctrl-C is for this process, which ends the others
    )
    running.callback(_end, process)
    pickle.dump((configs[index], backend), process.stdin)
    process.stdin.flush()  # and stays open: its end tells the process that this one has died

    def listen() -> None:
        for line in process.stdout:
            event = json.loads(line)
            events.put((index, event["kind"], event["value"]))
            if event["kind"] == "outcome":
                return
        events.put((index, "end", words))

    threading.Thread(target=listen, daemon=True).start()


def _end(process: subprocess.Popen) -> None:
    process.kill()  # whatever it still does: its files are whole, or its run is repeated
    process.wait()


def _serve(source: BinaryIO, tell: Callable[[str, Any], None]) -> None:
    """The process of one run: reads (config, backend) that `_start` pickled, trains and tells."""
    config, backend = pickle.load(source)
    threading.Thread(target=lambda: (source.read(), os._exit(1)), daemon=True).start()
    CONSOLE.quiet = True
    set_backend(backend)
    told = 0.0

    def on_step(steps: int) -> None:
        nonlocal told
        if time.monotonic() - told > 0.2 or steps == config.max_num_iterations:
            told = time.monotonic()
            tell("step", steps)

    try:
        tell("outcome", run_stage(config, on_step))
    except InputError as error:
        tell("input error", str(error))


def _peak_memory_mb() -> int:
    """Of the GPU where there is one, else of this process so far."""
    if torch.cuda.is_available():
        return torch.cuda.max_memory_allocated() // 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak // (2**20 if sys.platform == "darwin" else 2**10)


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print is no answer

    def tell(kind: str, value: Any) -> None:
        print(json.dumps({"kind": kind, "value": value}), file=answers, flush=True)

    _serve(io.BufferedReader(sys.stdin.buffer.raw), tell)
