"""A batch as a person sees it run."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from splatart_ns.batch.entry import Entry
from splatart_ns.batch.report import Report
from splatart_ns.batch.stage import Marker
from splatart_ns.batch.storage import UNANSWERED, Storage, patiently

_REPORT_EVERY = 60.0
"""Seconds between two reports while a batch runs; more where writing one takes long."""
_SHOWN = 3
"""Running stages that are named."""


class LiveProgress:
    """A bar of objects, counts of stages and failures, what is running; and now and then the report so far."""

    def __init__(self, entries: Sequence[Entry], out: Storage, console: Console):
        self.report = Report(entries)
        self._out, self._console = out, console
        self._running: Counter[str] = Counter()
        self._stages = self._earlier = 0
        self._next_report, self._last_shown = time.monotonic() + _REPORT_EVERY, 0.0
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn("{task.completed:.0f}/{task.total:.0f} objects"),
            BarColumn(),
            TextColumn("{task.description}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=console,
            speed_estimate_period=3600,
        )
        self._task = self._bar.add_task("", total=len(entries))

    def __enter__(self) -> LiveProgress:
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._show(now=True)
        self._bar.stop()
        if kind is None:
            patiently(lambda: self.report.write(self._out))
        else:
            with suppress(*UNANSWERED):  # why the batch ended is told, not that of its report
                self.report.write(self._out)

    def started(self, entry: Entry, stage: str) -> None:
        self._running[f"{entry.name}: {stage}"] += 1
        self._show()

    def ended(self, entry: Entry, stage: str, marker: Marker) -> None:
        del self._running[f"{entry.name}: {stage}"]
        self._stages += 1
        self._show()

    def finished(self, index: int, row: dict[str, Any]) -> None:
        self.report.add(index, row)
        self._earlier += not row["fresh"]
        if row["status"] == "failed":
            where = f" ({row['stage']})" if row["stage"] else ""
            self._console.print(f"failed: {row['name']}{where}: {row['reason']}", markup=False, soft_wrap=True)
        self._bar.advance(self._task)
        self._show()
        if time.monotonic() > self._next_report:
            start = time.monotonic()
            with suppress(*UNANSWERED):  # the next one may be written
                self.report.write(self._out)
            took = time.monotonic() - start
            self._next_report = start + max(_REPORT_EVERY, 50 * took)

    def _show(self, now: bool = False) -> None:
        if not now and time.monotonic() - self._last_shown < 0.1:
            return
        self._last_shown = time.monotonic()
        elapsed = self._bar.tasks[0].elapsed or 0.0
        fresh = self._bar.tasks[0].completed - self._earlier
        told = [f"{self._stages} stages"]
        if fresh and elapsed:
            told.append(f"{3600 * fresh / elapsed:.0f} objects/h")
        if self._earlier:
            told.append(f"{self._earlier} as they were")
        if failed := self.report.counts["failed"]:
            told.append(f"[red]{failed} failed[/red]")
        running = list(self._running)
        told += [escape(text) for text in running[:_SHOWN]]
        if len(running) > _SHOWN:
            told.append(f"{len(running) - _SHOWN} more")
        self._bar.update(self._task, description=", ".join(told))
