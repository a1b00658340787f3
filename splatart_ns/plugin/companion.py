"""Processes that train stages beside this one. They import what a stage needs while this one does so itself."""

from __future__ import annotations

import io
import json
import os
import pickle
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any, BinaryIO

from splatart_ns.choices import Rasterizer
from splatart_ns.machine import CALM_THREADS, num_cores

os.environ.update({**CALM_THREADS, **os.environ})  # of both ends

from splatart_ns.errors import InputError
from splatart_ns.plugin.imports import few_imports

# Imported by the process that trains: who starts it need not wait for them.
if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig


Outcome = dict[str, Any]
"""What a run took: seconds, iterations, gaussians, peak_memory_mb; its notes for the user; and what else it found."""


class Companion:
    """A process that trains one stage after the other."""

    def __init__(self) -> None:
        self._words = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__],
            stdin=subprocess.PIPE,  # its end tells the process that this one has died
            stdout=subprocess.PIPE,
            stderr=self._words,
            start_new_session=True,  # Ctrl-C is for this process, which ends the others
        )

    def train(
        self, config: TrainerConfig, backend: Rasterizer, threads: int, on_step: Callable[[int], None]
    ) -> Outcome:
        """`run_stage` over there.

        Raises:
            InputError: raised by the run.
            RuntimeError: the process ended; its last words are in the message.
        """
        try:
            pickle.dump((config, backend, threads), self._process.stdin)
            self._process.stdin.flush()
        except OSError:  # it died meanwhile, and left no answer
            pass
        for line in self._process.stdout:
            event = json.loads(line)
            if event["kind"] == "outcome":
                return event["value"]
            if event["kind"] == "input error":
                raise InputError(event["value"])
            on_step(event["value"])
        self._words.seek(0)
        words = self._words.read().decode(errors="replace")[-2000:]
        raise RuntimeError(f"{config.get_base_dir()} ended without a result: {words}")

    def end(self) -> None:
        self._process.kill()  # whatever it still does: its files are whole, or its run is repeated
        self._process.wait()
        with suppress(OSError):  # it died before it was told all
            self._process.stdin.close()
        self._process.stdout.close()
        self._words.close()


class Companions:
    """Companions of this process; all end with the block, or before."""

    def __init__(self) -> None:
        self._started: list[Companion] = []
        self._running = ExitStack()

    def __enter__(self) -> Companions:
        return self

    def __exit__(self, *exception: object) -> None:
        self.end()

    def start_early(self) -> None:
        """One, where states will be trained side by side: a capture has at least two."""
        if num_cores() > 1:
            self.first(1)

    def first(self, count: int) -> list[Companion]:
        """So many of them, started where there are fewer."""
        while len(self._started) < count:
            companion = Companion()
            self._running.callback(companion.end)
            self._started.append(companion)
        return self._started[:count]

    def end(self) -> None:
        self._running.close()
        self._started.clear()


def _serve(source: BinaryIO, tell: Callable[[str, Any], None]) -> None:
    """The process: train what `Companion.train` sends, until the other end closes the pipe or dies."""
    with few_imports():
        from nerfstudio.utils.rich_utils import CONSOLE

        from splatart_ns.plugin.semantic import SemanticModel  # noqa: F401  (the stage that has several runs)
        from splatart_ns.plugin.stage_run import run_stage
        from splatart_ns.rasterize.rasterization import set_backend
        from splatart_ns.threads import kernel_threads

    runs: queue.SimpleQueue[tuple[TrainerConfig, Rasterizer, int]] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(source, runs), daemon=True).start()
    CONSOLE.quiet = True
    told = 0.0

    def on_step(steps: int) -> None:
        nonlocal told
        if time.monotonic() - told > 0.2 or steps == config.max_num_iterations:
            told = time.monotonic()
            tell("step", steps)

    while True:
        config, backend, threads = runs.get()
        set_backend(backend)
        try:
            with kernel_threads(threads):
                tell("outcome", run_stage(config, on_step))
        except InputError as error:
            tell("input error", str(error))


def _receive(source: BinaryIO, runs: queue.SimpleQueue) -> None:
    try:
        while True:
            runs.put(pickle.load(source))  # of the process that started this one, by a pipe that no other has
    except EOFError:
        os._exit(1)


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print is no answer

    def tell(kind: str, value: Any) -> None:
        print(json.dumps({"kind": kind, "value": value}), file=answers, flush=True)

    _serve(io.BufferedReader(sys.stdin.buffer.raw), tell)
