"""Where the seconds of a process go, by what its main thread is doing when an alarm rings."""

from __future__ import annotations

import signal
import time
from collections import Counter
from types import FrameType

INTERVAL = 0.005
"""Seconds between alarms."""
# The innermost frame whose file contains one of these says what is being done. Compiled code counts for its caller,
# backward passes of ours for their files, those of torch for `backward`.
ACTIVITIES = (
    ("rasterize/ssim", "image losses"),
    ("rasterize/numba_ssim", "image losses"),
    ("splatart_ns/rasterize", "rasterization"),
    ("torch/optim", "optimizer steps"),
    ("gsplat/strategy", "densification"),
    ("nerfstudio/utils/writer", "logging"),
    ("nerfstudio/utils/profiler", "logging"),
    ("torch/serialization", "checkpoints"),
    ("splatart_ns/capture", "reading the capture"),
    ("nerfstudio/data", "reading the capture"),
    ("splatart_ns/plugin/data", "reading the capture"),
    ("stages/registration", "registration"),
    ("stages/render_choice", "registration"),
    ("stages/refinement", "pose refinement"),
    ("stages/pose", "pose refinement"),
    ("stages/hull", "hulls, votes, merging"),
    ("stages/merge", "hulls, votes, merging"),
    ("stages/semantic", "image losses"),
    ("stages/joint", "joints and tree"),
    ("stages/tree", "joints and tree"),
    ("splatart_ns/bundle", "writing the bundle"),
    ("importlib", "imports"),
    ("numba/", "loading compiled code"),
    ("torch/autograd", "torch's own backward"),
    ("splatart_ns/plugin", "models and pipelines"),
    ("nerfstudio/models", "models and pipelines"),
    ("nerfstudio", "nerfstudio's trainer"),
)


class SamplingProfiler:
    """Counts seconds by activity while it runs; main thread only (signals)."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()

    def __enter__(self) -> SamplingProfiler:
        self._last = time.perf_counter()
        self._former = signal.signal(signal.SIGALRM, self._ring)
        signal.setitimer(signal.ITIMER_REAL, INTERVAL, INTERVAL)
        return self

    def __exit__(self, *exception: object) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, self._former)

    def _ring(self, number: int, frame: FrameType | None) -> None:
        # An alarm waits until compiled code returns: what has passed since the last one is this frame's.
        now = time.perf_counter()
        self.seconds[activity(frame)] += now - self._last
        self._last = now


def activity(frame: FrameType | None) -> str:
    """Of the innermost frame that is known."""
    while frame is not None:
        file = frame.f_code.co_filename
        for part, name in ACTIVITIES:
            if part in file:
                return name
        frame = frame.f_back
    return "other"
