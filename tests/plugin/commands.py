"""Starts nerfstudio's commands."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from importlib.metadata import entry_points
from multiprocessing.process import BaseProcess
from pathlib import Path

import torch

SECONDS = 300

# Nerfstudio's modules start CUDA as they are imported, and no fork of theirs can use it.
_forks = multiprocessing.get_context("spawn" if torch.cuda.is_available() else "forkserver")
_forks.set_forkserver_preload(["nerfstudio.scripts.train", "nerfstudio.scripts.eval", "nerfstudio.scripts.render"])


class Commands:
    """Runs console scripts in one folder."""

    def __init__(self, folder: Path):
        self.folder = folder

    def run(self, *argv: object, code: int = 0) -> str:
        """Start a command as a shell does, from nothing. Returns what it printed."""
        script, *arguments = map(str, argv)
        done = subprocess.run(
            [Path(sys.executable).with_name(script), *arguments],
            cwd=self.folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=SECONDS,
        )
        assert done.returncode == code, done.stdout[-4000:]
        return done.stdout

    def start(self, *argv: object) -> BaseProcess:
        """Start a command; without CUDA in a fork of a process that has imported nerfstudio, which takes long."""
        process = _forks.Process(target=_enter, args=(list(map(str, argv)), self.folder), daemon=True)
        process.start()
        return process

    def fork(self, *argv: object, code: int = 0) -> str:
        """As `run`, by `start`."""
        process = self.start(*argv)
        process.join(SECONDS)
        printed = self.printed(process)
        assert process.exitcode == code, printed[-4000:]
        return printed

    def printed(self, process: BaseProcess) -> str:
        return (self.folder / f"{process.pid}.log").read_text()


def _enter(argv: list[str], folder: Path) -> None:
    """What a console script does."""
    os.chdir(folder)
    log = os.open(f"{os.getpid()}.log", os.O_WRONLY | os.O_CREAT)
    os.dup2(log, 1)
    os.dup2(log, 2)
    sys.argv = argv
    (script,) = entry_points(group="console_scripts", name=argv[0])
    try:
        script.load()()
    except Exception:
        sys.excepthook(*sys.exc_info())
        raise SystemExit(1) from None
