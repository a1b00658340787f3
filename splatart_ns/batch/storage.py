"""Files below a folder or an fsspec URL, written whole or not at all."""

from __future__ import annotations

import os
import shutil
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, TypeVar
from urllib.parse import urlsplit

from splatart_ns.errors import InputError
from splatart_ns.files import replacing

UNANSWERED = (OSError, InputError)
"""What a storage raises that does not answer, or cannot do what it is asked."""
_PAUSES = (0.2, 1.0, 3.0)
"""Seconds before it is asked again."""
T = TypeVar("T")


@dataclass(frozen=True)
class FileInfo:
    """What a listing says of a file."""

    size: int
    stamp: str
    """Another one when the file was written again: its time of change in ns, or the store's tag of its contents."""


class Storage(Protocol):
    """Paths are relative, with `/`. A file appears under its name when it is whole."""

    url: str

    def files(self, path: str) -> dict[str, FileInfo]:
        """All files below a path, which they are relative to; {} where there is nothing."""

    def children(self, path: str) -> tuple[list[str], list[str]]:
        """Names of the folders and of the files in a folder; none where there is nothing."""

    def read(self, path: str) -> bytes | None:
        """A file's contents; None where there is no file."""

    def write(self, path: str, data: bytes) -> None: ...

    def create(self, path: str, data: bytes) -> bool:
        """Write a file unless it is there; of several that try at once, one gets True."""

    def remove(self, path: str) -> None:
        """Remove a file if it is there."""

    def get(self, path: str, folder: Path) -> None:
        """Copy all files below a path into a folder. Raises InputError for a name or link that leads out."""

    def put(self, file: Path, path: str) -> None:
        """Copy a file of this machine here."""


def open_storage(url: str) -> Storage:
    """A folder of this machine, or whatever fsspec opens (s3://bucket/folder, gs://...).

    Raises:
        InputError: for a URL that fsspec does not know, or whose library is not installed.
    """
    scheme = urlsplit(url).scheme if "://" in url else ""
    if scheme in ("", "file"):
        return Folder(os.path.abspath(url.removeprefix("file://")))
    return ObjectStore(url.rstrip("/"))


def patiently(ask: Callable[[], T]) -> T:
    """What `ask` returns, which asks a storage: a store that does not answer may do so a little later."""
    for pause in _PAUSES:
        try:
            return ask()
        except UNANSWERED:
            time.sleep(pause)
    return ask()


def require_folder(source: str, mend: str) -> None:
    """Raise InputError for a folder of this machine that is not there; what is not in an object store only is empty."""
    storage = open_storage(source)
    if isinstance(storage, Folder) and not os.path.isdir(storage.url):
        found = "is no folder" if os.path.lexists(storage.url) else "there is no such folder"
        raise InputError(f"{source}: {found}; {mend}.")


def join(path: str, name: str) -> str:
    """A path below another, which may be "", the storage itself."""
    return f"{path}/{name}" if path else name


@dataclass(frozen=True)
class Folder:
    """A folder of this machine, or one that all machines share."""

    url: str

    def files(self, path: str) -> dict[str, FileInfo]:
        found: dict[str, FileInfo] = {}
        top = os.path.join(self.url, path)
        folders = [top]
        while folders:
            try:
                entries = list(os.scandir(folders.pop()))
            except (FileNotFoundError, NotADirectoryError):
                continue
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    folders.append(entry.path)
                elif not (entry.name.startswith(".") and ".tmp" in entry.name) and _is_file(entry):
                    try:
                        stat = entry.stat()
                    except FileNotFoundError:  # another batch has just removed it
                        continue
                    relative = os.path.relpath(entry.path, top) if os.sep != "/" else entry.path[len(top) :].lstrip("/")
                    found[relative.replace(os.sep, "/")] = FileInfo(stat.st_size, str(stat.st_mtime_ns))
        return found

    def children(self, path: str) -> tuple[list[str], list[str]]:
        try:
            entries = list(os.scandir(os.path.join(self.url, path)))
        except (FileNotFoundError, NotADirectoryError):
            return [], []
        # Links to folders are not followed: they may lead round.
        folders = [entry.name for entry in entries if entry.is_dir(follow_symlinks=False)]
        return folders, [entry.name for entry in entries if _is_file(entry)]

    def read(self, path: str) -> bytes | None:
        if not os.path.isfile(file := os.path.join(self.url, path)):  # a pipe would never end
            return None
        try:
            return Path(file).read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return None

    def write(self, path: str, data: bytes) -> None:
        with replacing(Path(self.url, path)) as temporary:
            temporary.write_bytes(data)

    def create(self, path: str, data: bytes) -> bool:
        # Linked when it is whole: nobody reads an empty claim.
        target = Path(self.url, path)
        target.parent.mkdir(parents=True, exist_ok=True)
        whole = target.with_name(f".{uuid.uuid4().hex}.tmp")
        whole.write_bytes(data)
        try:
            os.link(whole, target)
        except FileExistsError:
            return False
        finally:
            whole.unlink()
        return True

    def remove(self, path: str) -> None:
        Path(self.url, path).unlink(missing_ok=True)

    def get(self, path: str, folder: Path) -> None:
        for name in self.files(path):
            file, target = Path(self.url, path, name), folder / name
            # A bundle from a stranger may have links to anything.
            if not os.path.realpath(file).startswith(os.path.join(os.path.realpath(self.url), "")):
                raise InputError(f"{file}: leads out of {self.url}; put a copy in its place.")
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, target)

    def put(self, file: Path, path: str) -> None:
        with replacing(Path(self.url, path)) as temporary:
            shutil.copyfile(file, temporary)


@dataclass(frozen=True)
class ObjectStore:
    """A URL of fsspec. Object stores show a file when all of it has arrived.

    Raises InputError where the store does not answer: no bucket, no credentials, no network.
    """

    url: str

    @cached_property
    def _fs(self) -> Any:
        import fsspec

        try:
            return fsspec.core.url_to_fs(self.url, use_listings_cache=False)[0]
        except (ImportError, ValueError) as error:
            raise InputError(f"{self.url}: cannot be opened ({error}); give a folder or install it.") from None

    def _at(self, path: str) -> str:
        return f"{self.url}/{path}" if path else self.url

    @contextmanager
    def _answer(self) -> Iterator[None]:
        """Turn what the stores' libraries raise, of many types, into an `InputError`."""
        try:
            yield
        except InputError:
            raise
        except Exception as error:
            found = " ".join(str(error).split()) or type(error).__name__
            mend = "correct the URL, or give this machine the credentials and the network that it needs"
            raise InputError(f"{self.url}: cannot be read or written ({found}); {mend}.") from error

    def files(self, path: str) -> dict[str, FileInfo]:
        with self._answer():
            top = self._fs._strip_protocol(self._at(path))
            self._fs.invalidate_cache()
            try:
                found = self._fs.find(top, detail=True)
            except FileNotFoundError:
                return {}
        return {
            name[len(top) :].lstrip("/"): FileInfo(info["size"], _stamp(info))
            for name, info in found.items()
            if name != top
        }

    def children(self, path: str) -> tuple[list[str], list[str]]:
        with self._answer():
            try:
                entries = self._fs.ls(self._at(path), detail=True)
            except FileNotFoundError:
                return [], []
        names: dict[str, list[str]] = {"directory": [], "file": []}
        for entry in entries:
            names[entry["type"]].append(entry["name"].rstrip("/").rsplit("/", 1)[-1])
        return names["directory"], names["file"]

    def read(self, path: str) -> bytes | None:
        with self._answer():
            try:
                return self._fs.cat_file(self._at(path))
            except FileNotFoundError:
                return None

    def write(self, path: str, data: bytes) -> None:
        with self._answer():
            self._fs.pipe_file(self._at(path), data)

    def create(self, path: str, data: bytes) -> bool:
        with self._answer():
            try:
                self._fs.pipe_file(self._at(path), data, mode="create")
            except FileExistsError:
                return False
        return True

    def remove(self, path: str) -> None:
        with self._answer():
            try:
                self._fs.rm_file(self._at(path))
            except FileNotFoundError:
                return

    def get(self, path: str, folder: Path) -> None:
        for name in self.files(path):
            target = folder / name
            # A name in a bucket may say anything.
            if not os.path.realpath(target).startswith(os.path.realpath(folder) + os.sep):
                raise InputError(f"{self._at(path)}/{name}: leads out of its folder; rename it.")
            target.parent.mkdir(parents=True, exist_ok=True)
            with self._answer():
                self._fs.get_file(f"{self._at(path)}/{name}", str(target))

    def put(self, file: Path, path: str) -> None:
        with self._answer():
            self._fs.put_file(str(file), self._at(path))


def _is_file(entry: os.DirEntry) -> bool:
    """Whether it is a file or leads to one; links that lead nowhere, or round, are none."""
    return os.path.isfile(entry.path) if entry.is_symlink() else entry.is_file()


def _stamp(info: dict[str, Any]) -> str:
    """Of an object: its ETag, or else its time of change."""
    for key in ("ETag", "etag", "md5Hash", "LastModified", "updated", "mtime", "created"):
        if info.get(key):
            return str(info[key])
    return ""


def publish(storage: Storage, folder: Path, prefixes: Iterable[str], target: str) -> dict[str, int]:
    """Copy what lies below `prefixes` (files or folders) of a local folder to `target`, the last prefix last.

    What an earlier run left there below the same prefixes is removed. Returns the sizes of the files, by their names
    relative to `target`.
    """
    before, sizes = storage.files(target), {}
    for prefix in prefixes:
        root = folder / prefix
        for file in sorted(f for f in root.rglob("*") if f.is_file()) if root.is_dir() else [root]:
            name = file.relative_to(folder).as_posix()
            storage.put(file, f"{target}/{name}")
            sizes[name] = file.stat().st_size
        for stale in before:
            if (stale == prefix or stale.startswith(prefix + "/")) and stale not in sizes:
                storage.remove(f"{target}/{stale}")
    return sizes
