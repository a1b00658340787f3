"""Many objects, each a chain of stages: what is missing is run, what fails stops nothing else."""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Protocol

from splatart_ns.batch.claim import Session
from splatart_ns.batch.entry import Entry
from splatart_ns.batch.pool import Death, Engine
from splatart_ns.batch.stage import Marker, Needs, Recipe, Stage, perform, read_marker, write_marker
from splatart_ns.batch.storage import UNANSWERED, Storage, open_storage, patiently

_LOOKED_AHEAD = 16
"""Objects whose files are listed before their turn: a store answers slowly, but many at a time."""
_PAUSE = 1.0
"""Seconds between two looks at objects that another batch works on."""


class Watcher(Protocol):
    """Gets told what happens."""

    def started(self, entry: Entry, stage: str) -> None: ...

    def ended(self, entry: Entry, stage: str, marker: Marker) -> None: ...

    def finished(self, index: int, row: dict[str, Any]) -> None:
        """An object is done or has failed, now or in an earlier run; `index` is its place among the entries.

        The row has name, capture, status ("done" or "failed"), stage and reason of a failure, seconds of all its
        stages, `stages` (seconds of each), `fresh` (whether a stage ran in this run), and what the recipe says.
        """


@dataclass
class _Object:
    index: int
    entry: Entry
    fingerprint: str = ""
    stages: list[Stage] = field(default_factory=list)
    markers: dict[str, Marker] = field(default_factory=dict)
    """Of stages that have ended with their present inputs, well or not."""
    waiting: dict[str, Stage] = field(default_factory=dict)
    """Stages that have not been started."""
    running: set[str] = field(default_factory=set)
    fresh: bool = False

    @property
    def failed(self) -> str | None:
        """The first stage that failed."""
        return next((name for name, marker in self.markers.items() if marker.failed), None)


def run_batch(
    entries: Sequence[Entry],
    out_url: str,
    recipe: Recipe,
    engine: Engine,
    watcher: Watcher,
    retry_failed: bool = False,
) -> None:
    """Run what is missing of all stages of all objects; see `Watcher` for what comes of it.

    The engine is closed at the end. Where another batch works on an object, this one waits until it has ended.
    """
    batch = _Batch(entries, open_storage(out_url), recipe, engine, watcher, retry_failed)
    try:
        batch.run()
    finally:
        engine.close()
        batch.end()


class _Batch:
    def __init__(
        self,
        entries: Sequence[Entry],
        out: Storage,
        recipe: Recipe,
        engine: Engine,
        watcher: Watcher,
        retry_failed: bool,
    ):
        self._out, self._recipe, self._engine, self._watcher = out, recipe, engine, watcher
        self._retry_failed = retry_failed
        self._session = Session(out)
        self._active: dict[int, _Object] = {}
        self._ready: list[tuple[int, int, str]] = []
        """(object, place of the stage, stage): early objects come first, so that whole ones come out soon."""
        self._postponed: list[tuple[int, Entry]] = []
        self._objects = self._open_all(entries)

    def run(self) -> None:
        while True:
            self._start_what_fits()
            if self._active:
                for (index, stage), result in self._engine.wait(_PAUSE):
                    self._take(self._active[index], stage, result)
            elif self._postponed:
                time.sleep(_PAUSE)
            else:
                return

    def end(self) -> None:
        self._objects.close()
        for thing in self._active.values():
            self._session.release(thing.entry.name)
        self._session.end()

    def _start_what_fits(self) -> None:
        while True:
            item = self._startable()
            if item is None:
                idle = any(self._engine.fits(Needs(memory_mb=0, gpu=gpu)) for gpu in (False, True))
                if self._ready or not idle or not self._admit():
                    return
                continue
            self._ready.remove(item)
            index, _, name = item
            thing = self._active[index]
            stage = thing.waiting.pop(name)
            thing.running.add(name)
            self._watcher.started(thing.entry, name)
            arguments = (self._recipe, thing.entry, stage, self._out.url)
            self._engine.start((index, name), stage.needs, perform, *arguments)

    def _startable(self) -> tuple[int, int, str] | None:
        """The first stage in order that fits. Of those for a GPU, and of the others, none overtakes another."""
        waiting = set()
        for item in sorted(self._ready):
            needs = self._active[item[0]].waiting[item[2]].needs
            if needs.gpu not in waiting:
                if self._engine.fits(needs):
                    return item
                waiting.add(needs.gpu)
        return None

    def _admit(self) -> bool:
        """Take up another object; False when there is none now."""
        thing = next(self._objects, None)
        if thing is None:
            return False
        name, claimed = thing.entry.name, False
        if thing.failed is None and not self._is_done(thing):
            try:
                claimed = patiently(lambda: self._session.claim(name))
            except UNANSWERED as error:
                thing.markers[""] = _unanswered(error)
        if thing.failed is not None or self._is_done(thing):
            self._tell(thing)
        elif not claimed:
            self._postponed.append((thing.index, thing.entry))
        else:
            thing = self._open(thing.index, thing.entry)  # again: another batch may just have left it
            if thing.failed is not None or self._is_done(thing):
                self._session.release(name)
                self._tell(thing)
            else:
                self._active[thing.index] = thing
                self._make_ready(thing)
        return True

    def _open_all(self, entries: Sequence[Entry]) -> Iterator[_Object | None]:
        """All objects, then those that another batch had claimed; None for a pause."""
        yield from self._open_ahead(enumerate(entries))
        while self._postponed:
            pause = time.monotonic() + _PAUSE
            while time.monotonic() < pause:
                yield None
            postponed, self._postponed = self._postponed, []
            for item in postponed:
                yield self._open(*item)

    def _open_ahead(self, entries: Iterator[tuple[int, Entry]]) -> Iterator[_Object]:
        with ThreadPoolExecutor(_LOOKED_AHEAD) as threads:
            futures: deque[Future[_Object]] = deque()
            for item in itertools.chain(entries, itertools.repeat(None)):
                if item is not None:
                    futures.append(threads.submit(self._open, *item))
                    if len(futures) < _LOOKED_AHEAD:
                        continue
                if not futures:
                    return
                yield futures.popleft().result()

    def _open(self, index: int, entry: Entry) -> _Object:
        """An object, and what earlier runs have left of it."""
        thing = _Object(index, entry)
        try:
            thing.fingerprint = self._recipe.fingerprint(entry)
            files = self._out.files(entry.name)
            self._plan(thing)
            self._read(thing, files)
            if len(thing.stages) == 1 and thing.stages[0].name in thing.markers:
                self._plan(thing)
                self._read(thing, files)
        except Exception as error:  # libraries of stores raise many types
            thing.markers[""] = _unanswered(error)
        return thing

    def _plan(self, thing: _Object) -> None:
        """Find the stages, as far as the first one has told what they are."""
        (first, *_) = self._recipe.stages(thing.entry, thing.fingerprint, None)
        told = thing.markers.get(first.name)
        known = None if told is None or told.failed else told.outcome
        thing.stages = self._recipe.stages(thing.entry, thing.fingerprint, known)
        thing.waiting = {
            stage.name: stage
            for stage in thing.stages
            if stage.name not in thing.markers and stage.name not in thing.running
        }

    def _read(self, thing: _Object, files: dict[str, Any]) -> None:
        """Find out which stages have ended."""
        for name, stage in list(thing.waiting.items()):
            marker = read_marker(self._out, thing.entry.name, name, self._recipe.outcome_shape(name))
            if marker is None:
                continue
            # A result counts when what it was made of does: a damaged one is made again, and what follows kept.
            if marker.is_whole(stage.key, files) or (
                marker.failed and marker.key == stage.key and not self._retry_failed
            ):
                thing.markers[name] = marker
                del thing.waiting[name]

    def _is_done(self, thing: _Object) -> bool:
        return all(stage.name in thing.markers for stage in thing.stages) and len(thing.stages) > 1

    def _make_ready(self, thing: _Object) -> None:
        for place, stage in enumerate(thing.stages):
            queued = (thing.index, place, stage.name)
            if (
                stage.name in thing.waiting
                and queued not in self._ready
                and all(name in thing.markers for name in stage.after)
            ):
                self._ready.append(queued)

    def _take(self, thing: _Object, stage: str, result: Marker | Death) -> None:
        """A stage has ended."""
        if isinstance(result, Death):
            key = next(s.key for s in thing.stages if s.name == stage)
            result = Marker(key, 0.0, failed=result.how, kind="died")
            with suppress(*UNANSWERED):  # it has failed anyway
                patiently(lambda: write_marker(self._out, thing.entry.name, stage, result))
        thing.running.discard(stage)
        thing.markers[stage] = result
        thing.fresh = True
        self._watcher.ended(thing.entry, stage, result)
        if not result.failed and len(thing.stages) == 1:
            self._plan(thing)
            try:
                patiently(lambda: self._read(thing, self._out.files(thing.entry.name)))
            except UNANSWERED as error:
                thing.markers[""] = _unanswered(error)
        if thing.failed is None and not self._is_done(thing):
            self._make_ready(thing)
            return
        self._ready = [item for item in self._ready if item[0] != thing.index]  # of one that has failed
        if not thing.running:
            del self._active[thing.index]
            self._session.release(thing.entry.name)
            self._tell(thing)

    def _tell(self, thing: _Object) -> None:
        failed = thing.failed
        row = {
            "name": thing.entry.name,
            "capture": thing.entry.capture,
            "status": "done" if failed is None else "failed",
            "stage": failed or "",
            "reason": "" if failed is None else thing.markers[failed].failed,
            "seconds": round(sum(marker.seconds for marker in thing.markers.values()), 2),
            "stages": {name: marker.seconds for name, marker in thing.markers.items() if name},
            "fresh": thing.fresh,
        }
        if failed is None:
            row |= self._recipe.row(thing.entry, {name: marker.outcome for name, marker in thing.markers.items()})
        self._watcher.finished(thing.index, row)


def _unanswered(error: Exception) -> Marker:
    """Of an object of which this could not be found out."""
    return Marker("", 0.0, failed=str(error) or type(error).__name__, kind="input")
