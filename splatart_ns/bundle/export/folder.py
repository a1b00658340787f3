"""The folder of an export: whole or not there, and replaced only if nothing but ours is in it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from splatart_ns.errors import InputError
from splatart_ns.files import errors_about, put_in_place, scratch_folder, write_json
from splatart_ns.records import read_record

MANIFEST = "export.json"
FORMAT = "splatart-export-1"


@contextmanager
def export_folder(path: Path, about: dict) -> Iterator[Path]:
    """Yield an empty temporary folder that takes the place of `path`, with a manifest, when the block ends well.

    The manifest lists the files and holds `about`.

    Raises:
        InputError: `path` is a file, holds what no earlier export wrote, or the current folder.
    """
    path = Path(path).resolve()
    check_folder(path)
    with scratch_folder(path) as scratch:
        fresh = Path(scratch) / "new"
        fresh.mkdir()
        with errors_about(path, fresh):
            yield fresh
        write_json(fresh / MANIFEST, {"format": FORMAT, **about, "files": sorted(_files(fresh))})
        put_in_place(fresh, path)


def check_folder(path: Path) -> None:
    """Raise InputError if `path` is a file, holds what no earlier export wrote, or the folder that we are in."""
    if path.exists() and Path.cwd().is_relative_to(path.resolve()):
        raise InputError(f"{path}: is, or holds, the folder that you are in; go elsewhere, or give another --output")
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; give a folder for the export with --output")
    if not (present := _files(path) if path.is_dir() else set()):
        return
    if foreign := sorted(present - _written(path)):
        inner = Path(foreign[0]).parts[0]
        is_export = (path / inner / MANIFEST).is_file()
        what = f"an export in its folder '{inner}'" if is_export else f"'{foreign[0]}', which no export wrote"
        raise InputError(f"{path}: holds {what}; give another folder with --output")


def remove_exports(path: Path) -> None:
    """Remove the exports in folders of `path`; files of others stay, and so do exports whose manifest is damaged."""
    for folder in {manifest.parent for manifest in path.glob(f"*/{MANIFEST}")}:
        with suppress(InputError):
            for name in _written(folder) & _files(folder):
                (folder / name).unlink()
    for folder, _, _ in os.walk(path, topdown=False):
        with suppress(OSError):  # something is in it
            os.rmdir(folder)


def _written(folder: Path) -> set[str]:
    """Names of the files that an export into `folder` wrote, by its manifest."""
    if not (folder / MANIFEST).is_file():
        return set()
    record = read_record(folder / MANIFEST, "give another folder with --output")
    if record.text("format") != FORMAT:
        return set()
    return {MANIFEST, *(name for name in record.items("files") if isinstance(name, str))}


def _files(folder: Path) -> set[str]:
    return {file.relative_to(folder).as_posix() for file in folder.rglob("*") if not file.is_dir()}
