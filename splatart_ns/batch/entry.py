"""Which captures a batch is of: all below a folder, or those of a manifest."""

from __future__ import annotations

import csv
import io
import json
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import Any, get_args

from splatart_ns.batch.storage import Folder, Storage, join, open_storage, require_folder
from splatart_ns.choices import Quality, require_downscale, require_seed
from splatart_ns.errors import InputError
from splatart_ns.shape import with_keys_once

_TRANSFORMS = "transforms.json"
_MARKS = (
    {"transforms_train_start.json", "transforms_train_end.json"},  # ArtGS
    {"init_keyframes.yml", "cam_K.txt"},  # DTA
)
"""Files of captures in other layouts, see `capture.peer_layouts`."""
_SETTINGS = ("quality", "root", "seed", "downscale", "joints")
_LONGEST_NAME, _DEEPEST = 150, 100


@dataclass(frozen=True)
class Entry:
    """One object of a batch."""

    name: str
    """Its bundle's folder below the output folder; may have `/` in it."""
    capture: str
    """Folder or URL of the capture."""
    settings: dict[str, Any] = field(default_factory=dict)
    """quality, root, seed, downscale, joints, as in `splatart fit`."""


def read_entries(source: str, settings: dict[str, Any]) -> list[Entry]:
    """The captures below a folder or URL, or, of a .csv or .jsonl, its rows; in order.

    A manifest has the columns or keys `path` (relative to the manifest's folder) and, if wanted, `name`, `quality`,
    `root`, `seed`, `downscale` and `joints` (in a CSV with `;` between them); what a row does not say is as in
    `settings`.

    Raises:
        InputError: no capture, no such folder, or a manifest that cannot be used; it names the line.
    """
    manifest = source.lower().endswith((".csv", ".jsonl"))
    mend = "give a folder above captures, or a .csv or .jsonl that names them"
    if not manifest:
        require_folder(source, mend)
    entries = _read_manifest(source, settings) if manifest else _find(open_storage(source), settings)
    if not entries:
        found = "there is no capture in it (links to folders are not followed)"
        raise InputError(f"{source}: {found}; {mend}.")
    _check_names(source, entries)
    return entries


def check_apart(entries: Iterable[Entry], out: Storage) -> None:
    """Raises InputError where a bundle would be, hold or lie in a capture of this machine."""
    if not isinstance(out, Folder):
        return
    local = {entry.capture: open_storage(entry.capture) for entry in entries}
    captures = {PurePath(os.path.realpath(at.url)) for at in local.values() if isinstance(at, Folder)}
    bundles = {PurePath(os.path.realpath(os.path.join(out.url, entry.name))) for entry in entries}
    for paths, others in ((bundles, captures), (captures, bundles)):
        for path in paths:
            if not others.isdisjoint((path, *path.parents)):
                raise InputError(
                    f"{path}: a bundle would lie among a capture's files, or around them; choose another --output-dir, "
                    "beside the captures."
                )


def _find(storage: Storage, settings: dict[str, Any]) -> list[Entry]:
    found = _captures(storage, "")
    if found is None:  # the files of a single state: what is wrong with it shall be said
        found = [""]
    return [
        Entry(path or storage.url.rsplit("/", 1)[-1], f"{storage.url}/{path}".rstrip("/"), settings) for path in found
    ]


def _captures(storage: Storage, path: str) -> list[str] | None:
    """The folders at or below a path that look like a capture of one of the layouts; None for a state's folder."""
    if path.count("/") > _DEEPEST:
        raise InputError(f"{storage.url}/{path}: lies too deep; give a folder that is nearer to the captures.")
    folders, files = (set(names) for names in storage.children(path))
    if _TRANSFORMS in files:
        return [path] if _holds_states(storage.read(join(path, _TRANSFORMS))) else None
    if {"start", "end"} <= folders and "camera_train.json" in storage.children(join(path, "start"))[1]:
        return [path]
    if any(files.issuperset(mark) for mark in _MARKS):
        return [path]
    inner = {
        below: _captures(storage, below)
        for below in (join(path, name) for name in sorted(folders) if name != "eval" and not name.startswith("."))
    }
    captures = [capture for found in inner.values() for capture in found or ()]
    states = [below for below, found in inner.items() if found is None]
    if states and not captures:
        return [path]
    return sorted(captures + states)  # a state among captures: one of them, and its file is broken


def _holds_states(data: bytes | None) -> bool:
    # Not parsed: of a thousand captures this is read before anything else happens.
    return bool(data) and re.search(rb'"state"\s*:', data) is not None


def _read_manifest(source: str, settings: dict[str, Any]) -> list[Entry]:
    folder, _, name = source.rpartition("/")
    storage = open_storage(folder or ("/" if source.startswith("/") else "."))
    data = storage.read(name)
    if data is None:
        raise InputError(f"{source}: cannot be read; give a .csv or .jsonl file.")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{source}: is not UTF-8; save it again as UTF-8.") from None
    rows = _csv_rows(source, text) if source.lower().endswith(".csv") else _json_rows(source, text)
    return [_entry(f"{source}, line {line}", row, storage.url, settings) for line, row in rows]


def _csv_rows(source: str, text: str) -> Iterable[tuple[int, dict[str, Any]]]:
    reader = csv.DictReader(io.StringIO(text), strict=True)
    try:
        columns = [name.strip() for name in reader.fieldnames or ()]
        if twice := sorted(name for name in set(columns) if name and columns.count(name) > 1):
            raise InputError(f"{source}, line {reader.line_num}: has the column {twice[0]!r} twice; leave one out.")
        for row in reader:
            if None in row or None in row.values():
                raise InputError(f"{source}, line {reader.line_num}: has not as many fields as the header; mend it.")
            row = {key.strip(): value.strip() for key, value in row.items() if value.strip()}
            if "joints" in row:
                row["joints"] = [joint.strip() for joint in row["joints"].split(";") if joint.strip()]
            for key in ("seed", "downscale"):
                if re.fullmatch("[0-9]{1,10}", row.get(key, "")):
                    row[key] = int(row[key])
            yield reader.line_num, row
    except csv.Error as error:
        raise InputError(f"{source}, line {reader.line_num}: is no CSV ({error}); mend it.") from None


def _json_rows(source: str, text: str) -> Iterable[tuple[int, dict[str, Any]]]:
    for number, line in enumerate(text.split("\n"), 1):  # texts of JSON may hold other ends of lines
        if not line.strip():
            continue

        def refuse(key: str, number: int = number) -> InputError:
            return InputError(f"{source}, line {number}: has the key {key!r} twice; keep one of them.")

        try:
            row = json.loads(line, object_pairs_hook=with_keys_once(refuse))
        except (ValueError, RecursionError) as error:
            raise InputError(f"{source}, line {number}: is not JSON ({error}); mend it.") from None
        if not isinstance(row, dict):
            raise InputError(f'{source}, line {number}: is no object; write {{"path": ...}}.')
        yield number, row


def _can_be_a_path(text: str) -> bool:
    try:
        return b"\0" not in os.fsencode(text)
    except UnicodeEncodeError:
        return False


def _entry(where: str, row: dict[str, Any], folder: str, settings: dict[str, Any]) -> Entry:
    if unknown := set(row) - {"path", "name", *_SETTINGS}:
        known = ", ".join(("path", "name", *_SETTINGS))
        raise InputError(f"{where}: {sorted(unknown)[0]!r} is unknown; known are {known}.")
    for key in ("path", "name", "root"):
        if key in row and not (isinstance(row[key], str) and row[key]):
            raise InputError(f"{where}: '{key}' is {row[key]!r}; give a text.")
    if not _can_be_a_path(row.get("path", "")):
        raise InputError(f"{where}: 'path' is {row['path']!r}; no path has such a character.")
    if "path" not in row:
        raise InputError(f"{where}: 'path' is missing; give the folder of a capture.")
    if row.get("quality", "draft") not in get_args(Quality):
        raise InputError(f"{where}: 'quality' is {row['quality']!r}; give one of {', '.join(get_args(Quality))}.")
    require_seed(row.get("seed", 0), f"{where}: 'seed'")
    require_downscale(row.get("downscale"), f"{where}: 'downscale'")
    joints = row.get("joints", [])
    if not isinstance(joints, list) or not all(isinstance(joint, str) for joint in joints):
        raise InputError(f"{where}: 'joints' is {joints!r}; give a list of texts.")
    path = row["path"].rstrip("/")
    absolute = path.startswith("/") or "://" in path
    return Entry(
        row.get("name", path.rsplit("/", 1)[-1]),
        path if absolute else f"{folder}/{path}",
        settings | {key: row[key] for key in _SETTINGS if key in row},
    )


def _check_names(source: str, entries: list[Entry]) -> None:
    """Every name is a folder of its own below the output folder, on any file system."""
    seen: dict[str, str] = {}
    for entry in entries:
        parts = entry.name.split("/")
        if (
            len(entry.name.encode("utf-8", "replace")) > _LONGEST_NAME
            or any(part in ("", "stages", "runs", "parts", "export") or part.startswith(".") for part in parts)
            or re.search(r'[\x00-\x1f\x7f\\:*?"<>|\ud800-\udfff]', entry.name)
        ):
            raise InputError(
                f"{source}: the name {entry.name!r} makes no folder of its own; give it another 'name' in a manifest."
            )
        if (folded := entry.name.casefold()) in seen:
            raise InputError(
                f"{source}: both {seen[folded]!r} and {entry.name!r} are there; give one another 'name' in a manifest."
            )
        seen[folded] = entry.name
    for folded, name in seen.items():
        pieces = folded.split("/")
        for end in range(1, len(pieces)):
            if (above := "/".join(pieces[:end])) in seen:
                raise InputError(f"{source}: {name!r} would lie in the bundle {seen[above]!r}; give it another 'name'.")
