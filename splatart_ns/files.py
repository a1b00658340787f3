"""Writing files so that a killed run leaves the last good one."""

from __future__ import annotations

import json
import math
import os
import tempfile
import uuid
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from splatart_ns.errors import DISK_ERRORS, InputError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`, of the same suffix; rename it to `path` when the block ends well."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:12]}.tmp{path.suffix}")
    with errors_about(path, temporary):
        try:
            yield temporary
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def replacing_all(paths: Sequence[Path]) -> Iterator[list[Path]]:
    """`replacing` for files that belong together: all are renamed, in their order, when the block ends well. Otherwise
    nothing is left of it, nor of folders that were made for it."""
    new = {folder for parent in {path.parent for path in paths} for folder in (parent, *parent.parents)}
    with ExitStack() as stack:
        for folder in sorted(folder for folder in new if not folder.exists()):
            stack.callback(_remove_empty, folder)
        yield [stack.enter_context(replacing(path)) for path in reversed(paths)][::-1]


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder beside `path`, which takes its place when the block ends well.

    Raises `InputError` if `path` is in use or cannot be written.
    """
    path, given = path.resolve(), path
    if path.exists() and path.samefile(Path.cwd()):
        raise InputError(f"{given}: is the folder that you are in; give another output folder.")
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(f"{given}: is there already and not empty; give another output folder, or remove it.")
    try:
        scratch = scratch_folder(path)
        fresh = Path(scratch.name) / "new"
        fresh.mkdir()
    except OSError as error:
        raise InputError(f"{given}: cannot be written ({error.strerror}); give another output folder.") from error
    with scratch, errors_about(given, fresh):
        yield fresh
        if path.exists() and not path.is_mount():
            path.rmdir()  # which fails where somebody has put something there since
        put_in_place(fresh, path)


def scratch_folder(path: Path) -> tempfile.TemporaryDirectory:
    """A folder on the file system of a folder `path`, which need not be there: beside it, or in it if it is a mount."""
    parent = path if path.is_mount() else path.parent
    parent.mkdir(parents=True, exist_ok=True)
    return tempfile.TemporaryDirectory(prefix=f".{path.name}.", suffix=".tmp", dir=parent)


def put_in_place(fresh: Path, path: Path) -> None:
    """Let a folder in the `scratch_folder` of `path` take its place; what was there goes with the scratch folder.

    A mount, which no other folder can replace, gets what is in that one.
    """
    old = fresh.with_name("old")
    if path.is_mount():
        old.mkdir()
        for folder, target in ((path, old), (fresh, path)):
            for inner in folder.iterdir():
                if inner != fresh.parent:
                    os.replace(inner, target / inner.name)
        return
    if path.exists():
        os.replace(path, old)
    os.replace(fresh, path)


@contextmanager
def errors_about(path: Path, temporary: Path) -> Iterator[None]:
    """Let errors about `temporary`, or what lies in it, name `path`; so do those of a full disk that name nothing."""
    try:
        yield
    except OSError as error:
        nameless = error.filename is None and error.errno in DISK_ERRORS
        named = temporary if nameless else Path(str(error.filename))
        if not named.is_relative_to(temporary):
            raise
        raise OSError(error.errno, error.strerror, str(path / named.relative_to(temporary))) from error


def require_writable(folder: Path, mend: str) -> None:
    """Raise `InputError` where no file can be made in a folder, before the work whose result is to go there."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror}); {mend}.") from None


def write_json(path: Path, value: Any) -> None:
    """Write `value` as JSON. Numbers that are not finite, which JSON does not have, become null."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(_finite(value), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
