"""The layouts of a capture on disk: state folders, one transforms.json with states, PARIS."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from splatart_ns.capture.capture import (
    Capture,
    CaptureError,
    Frame,
    Normalization,
    Problem,
    Report,
    State,
)
from splatart_ns.capture.images import image_size
from splatart_ns.capture.part_names import read_part_names
from splatart_ns.capture.peer_layouts import peer_reader
from splatart_ns.capture.values import (
    inner_path,
    own_before,
    parse_camera,
    parse_matrix,
    parse_pose,
    parse_positive,
    read_inner_json,
    relative_path,
    show,
)
from splatart_ns.choices import Worlds

TRANSFORMS = "transforms.json"
SPLITS = ("train", "val", "test")
_NERF = "transforms_train.json"
_PARIS_STATES = ("start", "end")
_Meta = tuple[Path, dict[str, Any]]


def load_capture(path: Path | str) -> Capture:
    """Read a capture's structure: states, frames, cameras, splits, part names. No image is decoded but label files
    where `semantic_classes` does not name the parts.

    `path` is a folder in one of these layouts, recognised by its files:

    - subfolders with a `transforms.json` each, one a state, in natural order of their names (`eval` is none);
    - one `transforms.json` whose frames carry `"state": k`;
    - PARIS: `start/` and `end/` with `{train,val,test}/NNNN.png`, `camera_{train,val,test}.json` and optionally
      `{train,val,test}_semantics/NNNN.png`;
    - ArtGS's or DTA's (see `peer_layouts`); labels come by `import_labels`.

    `train_filenames`, `val_filenames` and `test_filenames` are honoured: a frame that none of them lists is left out,
    one in several counts as train before test before val. Without any of the lists every 8th frame of a state, in
    order of the names, is a test frame. A frame's own intrinsics come before those of the file. A frame without
    `w` and `h` has the size of its image.

    Part names are made fit for file names. Without `semantic_classes` they are `part_1`, `part_2`, ... up to the
    largest id in the label files.

    Raises `InputError` at the first thing that cannot be read.
    """
    return read_capture(path, _raise)


def load_novel(path: Path | str) -> tuple[State, ...]:
    """The held-out configurations `eval/novel_NN` of a capture, for evaluation only; () where there are none.

    Raises `InputError` as `load_capture` does.
    """
    folders = _subfolders(Path(path) / "eval")
    return tuple(_read_state(f, Path(path), _raise)[0] for f in folders if f.name.startswith("novel"))


def load_states(folders: Sequence[Path]) -> tuple[State, ...]:
    """Folders with a transforms.json each, as the states of one capture. Raises `InputError` as `load_capture` does."""
    read = [_read_state(Path(folder), Path(folder), _raise) for folder in folders]
    read_part_names([meta for _, meta in read], [frame for state, _ in read for frame in state.frames], _raise)
    return tuple(state for state, _ in read)


def read_capture(path: Path | str, report: Report) -> Capture:
    """`load_capture`, telling `report` of every problem and leaving out what it concerns.

    Raises `InputError` where nothing useful is left.
    """
    path = Path(path)
    if not path.is_dir():
        raise CaptureError(path, "the capture is not a folder", "give the folder that holds the states")
    folders = _subfolders(path)
    single = os.path.isfile(path / TRANSFORMS)
    if folders and single:
        raise CaptureError(
            path,
            f"there is a transforms.json both here and in {folders[0].name}",
            'keep either the state folders, or one file whose frames carry "state"',
        )
    if folders:
        states, metas = _read_folders(folders, path, report)
    elif single:
        states, metas = _read_single(path / TRANSFORMS, report)
    elif all(os.path.isfile(path / state / "camera_train.json") for state in _PARIS_STATES):
        states, metas = [_read_paris(path / state, path, report) for state in _PARIS_STATES], []
    elif (read := peer_reader(path)) is not None:
        states, metas = read(path, report), []
    else:
        if nerf := [*path.glob(_NERF), *sorted(path.glob(f"*/{_NERF}"))]:
            found = "a NeRF's synthetic scene has no place for states"
            mend = f"put the frames of each state into a {TRANSFORMS} in a folder of its own, file_path with its suffix"
            raise CaptureError(nerf[0], found, mend)
        raise CaptureError(
            path,
            "there is no capture here",
            "expected are subfolders with a transforms.json each, one transforms.json, PARIS's start/ and end/ with "
            "their camera_train.json, or a folder of ArtGS or DTA",
        )
    for state in states:
        if not state.frames:
            mend = "mend its frames' entries, or list them in train_filenames"
            report(Problem("error", path / state.name, "the state has no frame that can be used", mend))
    states = [state for state in states if state.frames]
    if not states:
        raise CaptureError(path, "no frame of the capture can be used", "mend the frames' entries")
    frames = [frame for state in states for frame in state.frames]
    return Capture(
        path=path,
        states=tuple(states),
        parts=read_part_names(metas, frames, report),
        worlds=_worlds(metas, report),
        length_unit=_length_unit(metas, report),
        normalization=Normalization.from_frames(frames),
    )


def _length_unit(metas: Sequence[_Meta], report: Report) -> str:
    """What the states' transforms.json give as "length_unit"."""
    given = [(file, meta["length_unit"]) for file, meta in metas if meta.get("length_unit") is not None]
    for file, unit in given:
        if not isinstance(unit, str):
            report(Problem("error", file, f'"length_unit" is {show(unit)}', 'write a name, as "metre"'))
    return _of_all(
        "length_unit", [(file, u) for file, u in given if isinstance(u, str) and u.strip()], report, "unknown"
    )


def _worlds(metas: Sequence[_Meta], report: Report) -> Worlds:
    """What the states' transforms.json give as "worlds"."""
    given = [(file, meta["worlds"]) for file, meta in metas if "worlds" in meta]
    for file, worlds in given:
        if worlds not in get_args(Worlds):
            mend = f"write one of {', '.join(get_args(Worlds))}"
            report(Problem("error", file, f'"worlds" is {show(worlds)}', mend))
    return _of_all("worlds", [(file, w) for file, w in given if w in get_args(Worlds)], report, "shared")


def _of_all(key: str, given: Sequence[tuple[Path, str]], report: Report, otherwise: str) -> str:
    """The value that files give for all states; the first one's, where another has another, which is an error."""
    if not given:
        return otherwise
    first, value = given[0]
    for file, other in given[1:]:
        if other != value:
            found = f'"{key}" is {show(other)}, but {show(value)} in {first}'
            report(Problem("error", file, found, "write the same in all states"))
    return value


# ---------------------------------------------------------------------------------------------- layouts


def _subfolders(path: Path) -> list[Path]:
    """The folders in `path` but `eval` that hold a transforms.json, in natural order: state_2 before state_10."""
    if not path.is_dir():
        return []
    found = [f for f in path.iterdir() if f.name != "eval" and not f.name.startswith(".") and _is_state(f)]

    def key(folder: Path) -> tuple[list[str | int], str]:
        pieces = re.split(r"(\d+)", folder.name)  # digits, and only they, at the odd places
        return [int(s) if i % 2 else s for i, s in enumerate(pieces)], folder.name

    return sorted(found, key=key)


def _is_state(folder: Path) -> bool:
    try:
        return stat.S_ISREG(os.stat(folder / TRANSFORMS).st_mode)
    except PermissionError:
        raise CaptureError(folder, "the folder cannot be read", "make it readable, or move it elsewhere") from None
    except OSError:
        return False


def _read_folders(folders: Sequence[Path], root: Path, report: Report) -> tuple[list[State], list[_Meta]]:
    states, metas = [], []
    for folder in folders:
        try:
            state, meta = _read_state(folder, root, report)
        except CaptureError as error:
            report(error.problem)
            continue
        states.append(state)
        metas.append(meta)
    return states, metas


def _read_state(folder: Path, root: Path, report: Report) -> tuple[State, _Meta]:
    file = folder / TRANSFORMS
    meta = read_inner_json(file, root)
    (frames,) = _read_frames(file, root, meta, {0: _entries(file, meta)}, report).values()
    return State(folder.name, frames, _points(file, root, meta)), (file, meta)


def _read_single(file: Path, report: Report) -> tuple[list[State], list[_Meta]]:
    meta = read_inner_json(file, file.parent)
    entries = _entries(file, meta)
    if not any(isinstance(entry, dict) and "state" in entry for entry in entries):
        mend = 'give every frame "state": 0, 1, ..., or name the folder that holds the state folders'
        raise CaptureError(file, 'no frame carries "state"', mend)
    groups: dict[int, list[Any]] = {}
    for i, entry in enumerate(entries):
        k = entry.get("state") if isinstance(entry, dict) else None
        if isinstance(k, bool) or not isinstance(k, int) or not 0 <= k < 10_000:
            found = f"has the state {show(k)}" if k is not None else 'carries no "state"'
            report(Problem("error", file, f"frame {i} {found}", 'give every frame "state": 0, 1, ... as a number'))
            continue
        groups.setdefault(k, []).append(entry)
    points = _points(file, file.parent, meta)
    frames = _read_frames(file, file.parent, meta, dict(sorted(groups.items())), report)
    return [State(f"state_{k:02d}", f, points) for k, f in frames.items()], [(file, meta)]


def _read_paris(folder: Path, root: Path, report: Report) -> State:
    frames: list[Frame] = []
    for split in SPLITS:
        file = folder / f"camera_{split}.json"
        if not os.path.isfile(file):
            continue
        try:
            cameras = read_inner_json(file, root)
            K = parse_matrix(file, "K", cameras.get("K"), ((3, 3), (4, 4)))
        except CaptureError as error:
            report(error.problem)
            continue
        for name, pose in sorted(cameras.items()):
            if name == "K":
                continue
            try:
                frames.append(_paris_frame(file, root, split, name, pose, K))
            except CaptureError as error:
                report(error.problem)
    return State(folder.name, tuple(frames))


def _paris_frame(file: Path, root: Path, split: str, name: str, pose: Any, K: np.ndarray) -> Frame:
    image = inner_path(file, root, "an image name", f"{split}/{name}.png")
    labels = inner_path(file, root, "an image name", f"{split}_semantics/{name}.png")
    width, height = image_size(image)
    values = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": width, "h": height}
    return Frame(
        name=f"{split}/{name}.png",
        image=image,
        camera=parse_camera(file, f"image {name!r}", {k: float(v) for k, v in values.items()}, image),
        T_world_camera=parse_pose(file, f"image {name!r}", pose),
        split=split,
        labels=labels if os.path.isfile(labels) else None,
    )


# ---------------------------------------------------------------------------------------------- transforms.json


def _entries(file: Path, meta: dict[str, Any]) -> list[Any]:
    entries = meta.get("frames")
    if not isinstance(entries, list) or not entries:
        found = "is empty" if entries == [] else f"is {show(entries)}" if "frames" in meta else "is missing"
        raise CaptureError(file, f'"frames" {found}', "list at least one frame with file_path and transform_matrix")
    return entries


def _read_frames(
    file: Path, root: Path, meta: dict[str, Any], groups: dict[int, list[Any]], report: Report
) -> dict[int, tuple[Frame, ...]]:
    """The frames of each group of entries, sorted by name; entries that cannot be read are reported and left out."""
    named: dict[int, list[tuple[str, dict[str, Any]]]] = {}
    for k, entries in groups.items():
        named[k] = []
        for i, entry in enumerate(entries):
            try:
                if not isinstance(entry, dict):
                    raise CaptureError(file, f"frame {i} is {show(entry)}", "write it as an object with file_path")
                named[k].append((relative_path(file, f"file_path of frame {i}", entry.get("file_path")), entry))
            except CaptureError as error:
                report(error.problem)
        named[k].sort(key=lambda pair: pair[0])
    splits = _splits(file, meta, [[name for name, _ in pairs] for pairs in named.values()], report)
    frames: dict[int, tuple[Frame, ...]] = {}
    for k, pairs in named.items():
        read = []
        for name, entry in pairs:
            try:
                if name in splits:
                    read.append(_frame(file, root, name, meta, entry, splits[name]))
            except CaptureError as error:
                report(error.problem)
        frames[k] = tuple(read)
    return frames


def _frame(file: Path, root: Path, name: str, meta: dict[str, Any], entry: dict[str, Any], split: str) -> Frame:
    owner = f"frame {name!r}"

    def optional(key: str) -> Path | None:
        value = entry.get(key)
        return None if value is None else inner_path(file, root, f"{key} of {owner}", value)

    image = inner_path(file, root, f"file_path of {owner}", name)
    own = own_before(entry, meta)
    unit = own.get("depth_unit_scale_factor", Frame.depth_unit)
    return Frame(
        name=name,
        image=image,
        camera=parse_camera(file, owner, own, image),
        T_world_camera=parse_pose(file, owner, entry.get("transform_matrix")),
        split=split,
        labels=optional("semantics_path"),
        object_mask=optional("object_mask_path"),
        mask=optional("mask_path"),
        depth=optional("depth_file_path"),
        depth_unit=parse_positive(file, f"depth_unit_scale_factor of {owner}", unit),
    )


def _splits(file: Path, meta: dict[str, Any], groups: Sequence[Sequence[str]], report: Report) -> dict[str, str]:
    """The split of every frame that is used, by name; `groups` are the states' frame names, sorted."""
    if all(meta.get(f"{split}_filenames") is None for split in SPLITS):
        return {name: "test" if i % 8 == 7 else "train" for names in groups for i, name in enumerate(names)}
    names = {name for group in groups for name in group}
    by_path = {os.path.abspath(file.parent / name): name for name in names}
    listed: dict[str, set[str]] = {}
    for split in SPLITS:
        key = f"{split}_filenames"
        values = meta.get(key)
        if values is not None and not isinstance(values, list):
            raise CaptureError(file, f"{key} is {show(values)}", "write it as a list of file paths")
        paths = {relative_path(file, f"an entry of {key}", value) for value in values or []}
        listed[split] = (paths & names) | {by_path.get(os.path.abspath(file.parent / p), p) for p in paths - names}
        if unknown := sorted(listed[split] - names):
            message = f"{key} lists {unknown[0]!r}, which no frame has as its file_path"
            report(Problem("error", file, message, "correct the name or add the frame"))
    if both := sorted(listed["train"] & (listed["val"] | listed["test"])):
        message = f"{both[0]!r} is a training frame and a test frame at once"
        report(Problem("warning", file, message, "take it out of test_filenames; it counts as a training frame"))
    return {name: split for split in ("val", "test", "train") for name in listed[split] & names}


def _points(file: Path, root: Path, meta: dict[str, Any]) -> Path | None:
    value = meta.get("ply_file_path")
    return None if value is None else inner_path(file, root, "ply_file_path", value)


def _raise(problem: Problem) -> None:
    if problem.severity == "error":
        raise CaptureError(problem.file, problem.message, problem.mend)
