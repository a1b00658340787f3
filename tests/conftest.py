"""A tiny capture and one fit of it, made once by the real commands and shared by all tests."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import IO

import pytest

from splatart_ns.machine import CALM_THREADS

os.environ.update({**CALM_THREADS, **os.environ})  # as the commands do

from splatart_ns.capture.procedural import synthesize_object
from splatart_ns.capture.synthesis_options import SynthesisOptions

COMMAND = [sys.executable, "-c", "from splatart_ns.cli import main; main()"]


@pytest.fixture(scope="session")
def start_splatart() -> Callable[..., subprocess.Popen]:
    """Starts `splatart` with these arguments as a process of its own."""

    def start(*arguments: object, stdout: int | IO = subprocess.PIPE) -> subprocess.Popen:
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "100"}
        return subprocess.Popen(
            [*COMMAND, *map(str, arguments)],
            stdout=stdout,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # shells let background jobs ignore it
        )

    return start


@pytest.fixture
def small_files() -> Callable[[], AbstractContextManager]:
    """While a block lasts, files of this process grow to 1000 bytes only, as if the disk were full: not until the test
    ends, for pytest's own output may go to a file."""

    @contextmanager
    def limit() -> Iterator[None]:
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return limit


@pytest.fixture
def run_main(monkeypatch, capsys) -> Callable[..., tuple[int, str, str]]:
    """Runs `splatart` with these arguments in this process; returns the exit code, stdout and stderr."""
    from splatart_ns.cli import main

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["splatart", *map(str, arguments)])
        capsys.readouterr()
        try:
            main()
            code = 0
        except SystemExit as end:
            code = end.code
        return code, *capsys.readouterr()

    return run


@pytest.fixture(scope="session")
def hinge_capture(tmp_path_factory) -> Path:
    """A capture of the built-in hinge, with ground truth. Not to be changed."""
    folder = tmp_path_factory.mktemp("hinge") / "capture"
    return synthesize_object("hinge", folder, SynthesisOptions(train_views=12, test_views=2, resolution=64))


@pytest.fixture(scope="session")
def hinge_fit(hinge_capture, start_splatart, tmp_path_factory) -> Path:
    """The bundle of a draft fit of `hinge_capture`. Not to be changed."""
    folder = tmp_path_factory.mktemp("fit") / "bundle"
    process = start_splatart("fit", hinge_capture, "--output-dir", folder, "--quality", "draft")
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    return folder
