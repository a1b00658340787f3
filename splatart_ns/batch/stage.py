"""One step of one object: what it needs, and how its result is kept under the hash of its inputs and settings."""

from __future__ import annotations

import atexit
import hashlib
import json
import os
import shutil
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal, Protocol
from urllib.parse import quote

from splatart_ns.batch.entry import Entry
from splatart_ns.batch.storage import FileInfo, Folder, Storage, open_storage, publish
from splatart_ns.errors import InputError
from splatart_ns.machine import process_lives
from splatart_ns.shape import NUMBER, has_shape, parse

_SCRATCH = "splatart-batch-"
MARKERS = "stages"
"""Folder in a bundle of a file per stage that says how it ended."""


@dataclass(frozen=True)
class Needs:
    """What a stage takes of a machine, besides a core."""

    memory_mb: int = 1000
    gpu: bool = False
    """Whether it computes on a GPU where there are GPUs."""


@dataclass(frozen=True)
class Stage:
    """One step of one object."""

    name: str
    key: str
    """Hash of all that decides the result; see `stage_key`."""
    after: tuple[str, ...] = ()
    """Stages that it waits for."""
    needs: Needs = field(default_factory=Needs)


@dataclass(frozen=True)
class Marker:
    """How a stage ended."""

    key: str
    seconds: float
    outcome: dict[str, Any] = field(default_factory=dict)
    files: dict[str, int] = field(default_factory=dict)
    """Size of every file it left, by its name in the bundle."""
    failed: str = ""
    """Why it left nothing: one sentence."""
    kind: Literal["", "input", "crash", "died"] = ""
    """Of the failure: what the user can mend, what broke in the program, a process that was killed."""
    trace: str = ""

    def is_whole(self, key: str, files: dict[str, FileInfo]) -> bool:
        """Whether the result is there and of these inputs; `files` are those of the bundle."""
        return (
            self.key == key
            and not self.failed
            and all(name in files and files[name].size == size for name, size in self.files.items())
        )


class Recipe(Protocol):
    """What is done with every object. It is pickled: workers get a copy."""

    def fingerprint(self, entry: Entry) -> str:
        """Changes with any input file; found without reading them. Raises InputError where there is none."""

    def stages(self, entry: Entry, fingerprint: str, told: dict[str, Any] | None) -> list[Stage]:
        """All stages, two or more, in order; only the first while what it tells (its outcome) is not known."""

    def run(self, stage: str, work: Work) -> tuple[dict[str, Any], Sequence[str]]:
        """Do a stage in `work.folder`; returns its outcome, and the files or folders in it to keep, the last one last.

        Raises:
            InputError: what the user can mend.
        """

    def outcome_shape(self, stage: str) -> Any:
        """Of what `run` returns of a stage, see `has_shape`."""

    def row(self, entry: Entry, outcomes: dict[str, dict[str, Any]]) -> dict[str, Any]:
        """What the report says of an object whose stages all ended well."""


@dataclass
class Work:
    """What a stage gets: a scratch folder, and what earlier stages left."""

    entry: Entry
    out: Storage
    folder: Path
    """Becomes part of the bundle; empty at first."""

    @property
    def home(self) -> Path:
        """Where the bundle will be; a relative path when that is no folder of this machine."""
        return Path(self.out.url, self.entry.name) if isinstance(self.out, Folder) else Path(self.entry.name)

    def fetch(self, *paths: str) -> None:
        """Get folders or files that earlier stages left into `folder`."""
        for path in paths:
            data = self.out.read(f"{self.entry.name}/{path}") if Path(path).suffix else None
            if data is not None:
                (self.folder / path).write_bytes(data)
            else:
                self.out.get(f"{self.entry.name}/{path}", self.folder / path)

    def discard(self, *paths: str) -> None:
        """Remove folders or files that earlier stages left where the bundle will be."""
        for path in paths:
            inside = [""] if Path(path).suffix else [f"/{name}" for name in self.out.files(f"{self.entry.name}/{path}")]
            for name in inside:
                self.out.remove(f"{self.entry.name}/{path}{name}")

    def outcome(self, stage: str) -> dict[str, Any]:
        """Of an earlier stage."""
        marker = read_marker(self.out, self.entry.name, stage)
        if marker is None:
            raise InputError(f"{self.entry.name}: the stage {stage} is not there any more; run the batch again.")
        return marker.outcome

    @contextmanager
    def capture(self) -> Iterator[Path]:
        """The folder of the capture; a copy for the time being, if it is not on this machine."""
        storage = open_storage(self.entry.capture)
        if isinstance(storage, Folder):
            yield Path(storage.url)
            return
        with tempfile.TemporaryDirectory(dir=self.folder.parent) as copy:
            folder = Path(copy, "capture")
            folder.mkdir()
            storage.get("", folder)
            try:
                yield folder
            except InputError as error:
                raise InputError(str(error).replace(str(folder), self.entry.capture)) from None


def stage_key(*inputs: Any) -> str:
    """Hash of JSON values: the stage, the version of the package, settings, and hashes of inputs."""
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()


_MARKER = {
    **{"key": str, "seconds": NUMBER, "outcome": dict, "files": dict},
    **{"failed": str, "kind": str, "trace": str},
}
"""Shape of a marker's file."""


def fingerprint(capture: str) -> str:
    """Hash of the names, sizes and stamps of a capture's files; they are not read.

    Raises:
        InputError: no file is there.
    """
    files = open_storage(capture).files("")
    if not files:
        raise InputError(f"{capture}: there is nothing; correct the path.")
    return stage_key(sorted((name, info.size, info.stamp) for name, info in files.items()))


def read_marker(out: Storage, name: str, stage: str, outcome: Any = dict) -> Marker | None:
    """How a stage ended, if it did. One that is damaged, or whose outcome has not this shape, counts as none."""
    told = asdict(Marker("", 0.0)) | (parse(out.read(_marker_path(name, stage)), {"key": str}) or {})
    told.pop("cpu_seconds", None)  # versions before wrote it
    if told.keys() != _MARKER.keys() or not has_shape(told, _MARKER) or not told["key"]:
        return None
    return Marker(**told) if told["failed"] or has_shape(told["outcome"], outcome) else None


def write_marker(out: Storage, name: str, stage: str, marker: Marker) -> None:
    """Say how a stage ended."""
    told = {key: value for key, value in marker.__dict__.items() if value or key in ("key", "seconds")}
    out.write(_marker_path(name, stage), json.dumps(told).encode())


def _marker_path(name: str, stage: str) -> str:
    return f"{name}/{MARKERS}/{quote(stage, safe=' ', errors='surrogateescape')}.json"


def perform(recipe: Recipe, entry: Entry, stage: Stage, out_url: str) -> Marker:
    """Run a stage, keep its result, then its marker. Whatever happens is in the marker that is returned.

    A result that is there already, as of a task that an engine starts twice, is not made again.
    """
    start, out = time.perf_counter(), open_storage(out_url)

    def seconds() -> float:
        return round(time.perf_counter() - start, 3)

    try:
        earlier = read_marker(out, entry.name, stage.name, recipe.outcome_shape(stage.name))
        if earlier is not None and earlier.is_whole(stage.key, out.files(entry.name)):
            return earlier
        with _scratch() as scratch:
            work = Work(entry, out, scratch / "bundle")
            outcome, kept = recipe.run(stage.name, work)
            out.remove(_marker_path(entry.name, stage.name))  # its files change now
            files = publish(out, work.folder, kept, entry.name)
        marker = Marker(stage.key, seconds(), outcome=outcome, files=files)
    except InputError as error:
        marker = Marker(stage.key, seconds(), failed=str(error), kind="input")
    except Exception as error:
        words = str(error).strip().splitlines() or [""]
        reason = f"{type(error).__name__}: {words[-1]}"[:500]
        marker = Marker(stage.key, seconds(), failed=reason, kind="crash", trace=traceback.format_exc())
    try:
        write_marker(out, entry.name, stage.name, marker)
    except Exception as error:  # the disk is full, the store is away
        reason = f"{type(error).__name__}: {error}"
        return Marker(stage.key, seconds(), failed=reason, kind="crash", trace=traceback.format_exc())
    return marker


@contextmanager
def _scratch() -> Iterator[Path]:
    """This process's folder, with an empty folder `bundle` in it. Folders stay: to remove one can take long."""
    folder = _scratch_of_process()
    try:
        yield folder
    finally:
        for place in (folder, folder / "bundle"):
            for left in place.iterdir():
                if left.is_dir() and left != folder / "bundle":
                    shutil.rmtree(left, ignore_errors=True)
                elif not left.is_dir():
                    left.unlink()


@cache
def _scratch_of_process() -> Path:
    """A new folder; those that processes which were killed have left are removed."""
    for left in Path(tempfile.gettempdir()).glob(f"{_SCRATCH}*-*"):
        pid = left.name.removeprefix(_SCRATCH).split("-")[0]
        if pid.isdecimal() and not process_lives(int(pid)):
            shutil.rmtree(left, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=f"{_SCRATCH}{os.getpid()}-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    (folder / "bundle").mkdir()
    return folder
