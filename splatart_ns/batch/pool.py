"""Processes of this machine that run stages."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import IO, Any, Protocol

from splatart_ns.batch.stage import Needs
from splatart_ns.machine import CALM_THREADS, gpu_memory_mb, memory_mb, num_cores

THREADS = {"OMP_NUM_THREADS": "1", **CALM_THREADS}
"""Environment of every stage, on whatever machine: sums depend on the number of threads."""
_TASKS_PER_PROCESS = 200
"""Then a fresh process takes over, whatever libraries have piled up in the old one."""
_PROCESSES_PER_GPU = 4
"""A training step of a few thousand Gaussians is Python that starts kernels: one process keeps an H100 busy for a sixth
of the time, four nearly always, and fit 2.7 times as many objects (docs/gpu.md)."""
_LAST_SECONDS = 5.0
"""For a process to end by itself."""
_ENVIRONMENT = threading.Lock()
"""Held while `os.environ` is that of a process to start: pools in several threads share it."""


@dataclass(frozen=True)
class Death:
    """A task's process ended before the task."""

    how: str


class Engine(Protocol):
    """Runs functions somewhere else."""

    def fits(self, needs: Needs) -> bool:
        """Whether another task can be started now."""

    def start(self, ticket: Any, needs: Needs, function: Callable, *arguments: Any) -> None:
        """Start a task; `ticket` comes back with its result."""

    def wait(self, seconds: float) -> list[tuple[Any, Any]]:
        """Tickets and results, or a `Death`, of tasks that have ended; [] when none does in so many seconds."""

    def close(self) -> None:
        """End all processes and what they are at."""


class ProcessPool:
    """As many processes as cores; a task starts when the memory that it needs is free.

    Each GPU has up to four of the processes, as many as have room in its memory: a task takes less of that than of the
    machine's. A process that dies takes only its own task with it.
    """

    def __init__(self, cores: int | None = None, memory: int | None = None, gpus: Mapping[str, int] | None = None):
        cores = num_cores() if cores is None else cores
        self._memory = int(0.9 * memory_mb()) if memory is None else memory
        self._gpus = gpu_memory_mb() if gpus is None else gpus
        """Names of the devices, and MiB of each."""
        shared = min(max(cores, len(self._gpus)), _PROCESSES_PER_GPU * len(self._gpus))
        self._workers = [_Worker(name) for name in [*self._gpus] * _PROCESSES_PER_GPU][:shared]
        self._workers += [_Worker("") for _ in range(max(cores - shared, 0 if shared else 1))]

    def fits(self, needs: Needs) -> bool:
        busy = [worker.task.needs.memory_mb for worker in self._workers if worker.task is not None]
        return self._free_worker(needs) is not None and (not busy or needs.memory_mb <= self._memory - sum(busy))

    def start(self, ticket: Any, needs: Needs, function: Callable, *arguments: Any) -> None:
        worker = self._free_worker(needs)
        assert worker is not None
        worker.start(_Task(ticket, needs), function, arguments)

    def wait(self, seconds: float) -> list[tuple[Any, Any]]:
        busy = {worker.pipe: worker for worker in self._workers if worker.task is not None}
        return [busy[pipe].result() for pipe in wait(list(busy), seconds)]

    def close(self) -> None:
        for worker in self._workers:
            worker.end()

    def _free_worker(self, needs: Needs) -> _Worker | None:
        with_gpu = needs.gpu and bool(self._gpus)
        free = [worker for worker in self._workers if worker.task is None]
        fitting = [worker for worker in free if bool(worker.gpu) == with_gpu]
        if not with_gpu:
            if not fitting and all(worker.gpu for worker in self._workers):
                fitting = free  # no more cores than processes with a GPU
            return min(fitting, key=lambda worker: worker.process is None, default=None)
        taken: dict[str, list[int]] = {name: [] for name in self._gpus}
        for worker in self._workers:
            if worker.task is not None and worker.task.needs.gpu:
                taken[worker.gpu].append(worker.task.needs.memory_mb)
        fitting = [
            worker
            for worker in fitting
            if not taken[worker.gpu] or sum(taken[worker.gpu]) + needs.memory_mb <= 0.9 * self._gpus[worker.gpu]
        ]
        return min(fitting, key=lambda worker: (len(taken[worker.gpu]), worker.process is None), default=None)


@dataclass
class _Task:
    ticket: Any
    needs: Needs


class _Worker:
    """A process, started when it has something to do, and its task."""

    def __init__(self, gpu: str):
        self.gpu = gpu
        """The CUDA device that it sees, "" for none."""
        self.process: multiprocessing.process.BaseProcess | None = None
        self.pipe: Connection | None = None
        self.task: _Task | None = None
        self._words: IO[bytes] | None = None
        self._tasks_left = 0

    def start(self, task: _Task, function: Callable, arguments: tuple) -> None:
        if self._tasks_left == 0:
            self.end()
        if self.process is None:
            self._spawn()
        self.task = task
        self._tasks_left -= 1
        try:
            self.pipe.send((function, arguments))
        except OSError:  # it died meanwhile: `result` says so
            pass

    def result(self) -> tuple[Any, Any]:
        ticket = self.task.ticket
        self.task = None
        try:
            return ticket, self.pipe.recv()
        except (EOFError, OSError):
            self.process.join()
            code = self.process.exitcode
            self._words.seek(0)
            words = self._words.read().decode(errors="replace").strip().splitlines()
            self.end()
        if code is not None and code < 0:
            name = signal.Signals(-code).name
            why = " (was there too little memory?)" if -code == signal.SIGKILL else ""
            return ticket, Death(f"the process was ended by {name}{why}")
        return ticket, Death(f"the process ended with exit code {code}: {words[-1] if words else 'no word'}"[:500])

    def end(self) -> None:
        if self.process is not None:
            self.pipe.close()
            if self.task is None:  # it ends by itself, and tidies up
                self.process.join(_LAST_SECONDS)
            self.process.kill()  # its files are whole, or its stage is repeated
            self.process.join()
            self._words.close()
            Path(self._words.name).unlink(missing_ok=True)  # of a process that died before it could
        self.process = self.task = None
        self._tasks_left = 0

    def _spawn(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self._words = tempfile.NamedTemporaryFile(prefix="splatart-batch-", suffix=".log", delete=False)
        self.process = context.Process(target=_serve, args=(other, self._words.name), daemon=True)
        told = THREADS | {"CUDA_VISIBLE_DEVICES": self.gpu}
        with _ENVIRONMENT:
            before = {key: os.environ.get(key) for key in told}
            os.environ.update(told)  # libraries read it when the process imports them
            try:
                self.process.start()
            finally:
                for key, value in before.items():
                    os.environ.pop(key) if value is None else os.environ.update({key: value})
        other.close()
        self._tasks_left = _TASKS_PER_PROCESS


def _serve(pipe: Connection, words: str) -> None:
    """The process: run what comes through the pipe, until the other end closes it or dies."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that ends this one
    log = os.open(words, os.O_WRONLY | os.O_APPEND)
    os.unlink(words)  # who started this has it open, and nothing is left, if it is killed
    for stream in (1, 2):
        os.dup2(log, stream)
    parent = multiprocessing.parent_process()
    threading.Thread(target=lambda: (wait([parent.sentinel]), os._exit(1)), daemon=True).start()
    while True:
        try:
            function, arguments = pipe.recv()
        except EOFError:
            return
        os.ftruncate(log, 0)  # the last words are those of the task
        result = function(*arguments)
        torch = sys.modules.get("torch")
        if torch and torch.cuda.is_initialized():  # the next task on this GPU may be another process's
            gc.collect()
            torch.cuda.empty_cache()
        pipe.send(result)
