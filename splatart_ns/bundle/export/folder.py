"""The folder of an export: whole or not there, and replaced only if nothing but ours is in it."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from splatart_ns.errors import InputError
from splatart_ns.files import errors_about, write_json
from splatart_ns.records import read_record

MANIFEST = "export.json"
FORMAT = "splatart-export-1"


@contextmanager
def export_folder(path: Path, about: dict) -> Iterator[Path]:
    """Yield an empty temporary folder that takes the place of `path`, with a manifest, when the block ends well.

    The manifest lists the files and holds `about`.

    Raises:
        InputError: `path` is a file, or holds what no earlier export wrote.
    """
    path = Path(path).resolve()
    check_folder(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent) as scratch:
        fresh = Path(scratch) / "new"
        fresh.mkdir()
        with errors_about(path, fresh):
            yield fresh
        write_json(fresh / MANIFEST, {"format": FORMAT, **about, "files": sorted(_files(fresh))})
        if path.exists():
            os.replace(path, Path(scratch) / "old")
        os.replace(fresh, path)


def check_folder(path: Path) -> None:
    """Raise InputError if `path` is a file, or holds what no earlier export wrote."""
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; give a folder for the export with --output")
    present = _files(path) if path.is_dir() else set()
    if not present:
        return
    ours = set()
    if (path / MANIFEST).is_file():
        record = read_record(path / MANIFEST, "give another folder with --output")
        if record.text("format") == FORMAT:
            ours = {MANIFEST, *(name for name in record.items("files") if isinstance(name, str))}
    if foreign := sorted(present - ours):
        raise InputError(f"{path}: holds '{foreign[0]}', which no export wrote; give another folder with --output")


def _files(folder: Path) -> set[str]:
    return {file.relative_to(folder).as_posix() for file in folder.rglob("*") if not file.is_dir()}
