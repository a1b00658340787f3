"""Captures made of what other tools leave: labels of annotation tools, and state folders of ns-process-data."""

from __future__ import annotations

import os
import re
import shutil
import stat
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np

from splatart_ns.capture.annotated_image import IMAGE_SUFFIXES, AnnotatedImage
from splatart_ns.capture.annotations import Annotations, read_annotations
from splatart_ns.capture.capture import UNLABELLED, Capture, CaptureError, Frame, State
from splatart_ns.capture.class_list import is_background, is_unlabelled
from splatart_ns.capture.formats import SPLITS, TRANSFORMS, load_capture, load_states
from splatart_ns.capture.images import MAX_LABEL, as_stored, orientation, write_png
from splatart_ns.capture.part_names import safe_names
from splatart_ns.capture.values import DISTORTION, is_inside, read_json, relative_path, show
from splatart_ns.errors import InputError, printable
from splatart_ns.files import new_folder, replacing_all, write_json
from splatart_ns.machine import num_cores

FRAME_FILES = ("file_path", "semantics_path", "mask_path", "object_mask_path", "depth_file_path")
"""Where a frame in a transforms.json names its files."""
_TRUTH = ("ground_truth.json", "ground_truth_points")
"""What evaluation reads beside the states."""
_QUERY = re.compile(rf"(?<=\.)({'|'.join(suffix[1:] for suffix in IMAGE_SUFFIXES)})[?#].*", re.IGNORECASE | re.DOTALL)
"""What follows an image's name in an address."""


@dataclass(frozen=True)
class LabelImport:
    """What an import of labels did."""

    format: str
    """"COCO", "Labelme", "YOLO" or "masks"."""
    labelled: int
    """Frames that got labels."""
    frames: int
    parts: tuple[str, ...]
    """Names of the parts 1, 2, ..."""
    unmatched: tuple[str, ...]
    """Labelled images that no frame belongs to."""


def import_capture(sources: Sequence[Path], output_dir: Path, labels: Path | None = None) -> LabelImport | None:
    """Copy a capture, or the folders of its states in their order, and give the copy an annotation tool's labels.

    Args:
        sources: one capture, or two or more folders with a transforms.json each, as ns-process-data leaves them.
        output_dir: a folder that does not exist yet, or is empty.
        labels: as `import_labels` takes them.

    Of a source with transforms.json files these, the files that they name and the ground truth are copied; of other
    layouts all. Links to folders, and links that leave a source, are not copied; absolute paths in a transforms.json
    become relative ones.

    Raises:
        InputError: anything that cannot be read or written; labels that fit no frame, or not the frames' sizes.
    """
    if len(sources) == 1:
        load_capture(sources[0])
    else:
        load_states(sources)
    with new_folder(output_dir) as folder:
        targets = [folder] if len(sources) == 1 else [folder / f"state_{k:02d}" for k in range(len(sources))]
        for source, target in zip(sources, targets, strict=True):
            _copy(source, target, output_dir)
        with _errors_about({folder: output_dir, **dict(zip(targets, sources, strict=True))}):
            return None if labels is None else import_labels(folder, labels)


def import_labels(path: Path, labels: Path) -> LabelImport:
    """Write the labels of an export (see `read_annotations`) into a capture: PNGs of part ids, `semantics_path` of the
    frames, `semantic_classes`. PARIS folders get a transforms.json, which has a place for them.

    An image of the export belongs to the frame of the same stem, or of the same path joined in any way (Roboflow's
    `state_00_0001_jpg.rf.<hash>.jpg`, Label Studio's `<hash>-state_00_0001.jpg` to `state_00/images/0001.jpg`); where
    states have frames of one stem, a folder of the export named after the state tells them apart, and in one state the
    suffix does. Labels of an image that EXIF data turn on its side are turned back; where their size does not tell
    whether they are turned, they are refused. The classes that the capture declares keep their ids, others follow in
    the export's order. Frames that the export does not label stay as they are; where their labels' parts have no names,
    new classes are refused.

    Raises:
        InputError: anything that cannot be read or written; labels that fit no frame, or not the frames' sizes.
    """
    capture = load_capture(path)
    annotations = read_annotations(labels)
    matches, unmatched = _match(capture, labels, annotations)
    metas = _metas(capture)
    declared = next((meta["semantic_classes"][1:] for meta in metas.values() if meta.get("semantic_classes")), [])
    labelled = {match.frame.image for match in matches}
    frames = [frame for state in capture.states for frame in state.frames]
    kept = next((f.labels for f in frames if f.labels is not None and f.image not in labelled), None)
    parts = declared or ([] if kept is None else list(capture.parts.values()))
    ids = _part_ids(labels, parts, annotations.classes)
    if kept is not None and not declared and capture.parts and len(parts) > len(capture.parts):
        found = f"its parts have no names, so {show(parts[len(capture.parts)])} of the export may be one of them"
        mend = 'list "background" and the parts in semantic_classes, or export the labels of all frames'
        raise CaptureError(kept, found, mend)

    def draw(match: _Match) -> np.ndarray:
        size = match.frame.camera.width, match.frame.camera.height
        if match.turn is None:
            return ids[match.image.draw(*size)]
        return as_stored(ids[match.image.draw(*size[::-1])], match.turn)

    taken = _files_that_stay(path, metas, labelled)
    for match in matches:
        match.file = _label_file(match.root, match.frame, taken)
        if not is_inside(path, match.file):
            raise CaptureError(match.file.parent, "the folder is a link out of the capture", "remove the link")
    files = {match.frame.image: match.file for match in matches}
    for file, meta in metas.items():
        for entry in meta["frames"]:
            image = file.parent / relative_path(file, "file_path", entry.get("file_path"))
            if image in files:
                entry["semantics_path"] = files[image].relative_to(file.parent).as_posix()
        meta["semantic_classes"] = ["background", *parts]
    written = [*(match.file for match in matches), *metas]
    with replacing_all(written) as temporary, ThreadPoolExecutor(num_cores()) as pool:
        for _ in pool.map(lambda match, file: write_png(file, draw(match)), matches, temporary[: len(matches)]):
            pass
        for file, meta in zip(temporary[len(matches) :], metas.values(), strict=True):
            write_json(file, meta)
    return LabelImport(
        format=annotations.format,
        labelled=len(matches),
        frames=len(frames),
        parts=tuple(parts),
        unmatched=tuple(unmatched),
    )


@contextmanager
def _errors_about(sources: dict[Path, Path]) -> Iterator[None]:
    """Let errors about copies name what they are copies of."""
    try:
        yield
    except InputError as error:
        message = str(error)
        for copy, source in sorted(sources.items(), reverse=True):  # what lies in a folder before the folder
            message = message.replace(printable(str(copy)), printable(str(source)))
        raise InputError(message) from None


def _copy(source: Path, target: Path, output_dir: Path) -> None:
    if is_inside(source, output_dir):
        raise InputError(f"{output_dir}: lies inside {source}; give an output folder beside it.")

    needed = _needed(source)

    def left_out(folder: str, names: list[str]) -> list[str]:
        paths = [Path(folder, name) for name in names]
        kept = [p.is_file() and is_inside(source, p) or p.is_dir() and not p.is_symlink() for p in paths]
        if needed is not None:
            inner = [p.relative_to(source) for p in paths]
            kept = [k and (p in needed or p.parts[0] in _TRUTH) for k, p in zip(kept, inner, strict=True)]
        return [p.name for p, keep in zip(paths, kept, strict=True) if not keep]

    try:
        shutil.copytree(source, target, ignore=left_out, dirs_exist_ok=True)
    except shutil.Error as error:
        raise InputError(f"{error.args[0][0][0]}: cannot be copied; make it readable, and room on the disk.") from None
    for folder in (target, *(path for path in target.rglob("*") if path.is_dir())):
        folder.chmod(folder.stat().st_mode | stat.S_IRWXU)  # which is a copy of the source's
    for file in sorted(target.rglob("transforms*.json")):
        _name_own_files(file, source, target)


def _needed(source: Path) -> set[Path] | None:
    """What a source's transforms.json files name, these, and the folders of both, as paths from the source; None where
    there is none."""
    needed = {file.relative_to(source) for file in source.rglob(TRANSFORMS)}
    for file in list(needed):
        try:
            named = [values.get(key) for values, key in _file_names(read_json(source / file))]
        except CaptureError:  # it belongs to no state: those have been read
            continue
        places = (_place(source, source / file.parent / value) for value in named if isinstance(value, str))
        needed.update(place for place in places if place is not None)
    return needed.union(*(place.parents for place in needed)) or None


def _file_names(meta: dict[str, Any]) -> Iterator[tuple[dict[str, Any], str]]:
    """Where a transforms.json may name files: objects in it and their keys."""
    entries = meta.get("frames")
    for entry in entries if isinstance(entries, list) else ():
        if isinstance(entry, dict):
            yield from ((entry, key) for key in FRAME_FILES)
    yield meta, "ply_file_path"


def _place(source: Path, path: Path) -> Path | None:
    """Where a path, its folders' links followed, leads below a source; None where it leaves it."""
    if not is_inside(source, path):
        return None
    root = os.path.realpath(source)
    places = [Path(os.path.realpath(path.parent), path.name), Path(os.path.realpath(path))]
    return next(place.relative_to(root) for place in places if place.is_relative_to(root))


def _name_own_files(file: Path, source: Path, target: Path) -> None:
    """Let a transforms.json of a copy name the copy's files where it leads to the source's: by absolute paths, or by
    relative ones that leave the source and come back."""
    folder = file.parent.relative_to(target)

    def own(value: Any) -> Any:
        if not isinstance(value, str) or not os.path.normpath(folder / value).startswith(("/", "..")):
            return value
        place = _place(source, source / folder / value)
        return value if place is None else Path(os.path.relpath(place, folder)).as_posix()

    try:
        meta = read_json(file)
    except CaptureError:  # it belongs to no state: those have been read
        return
    changed = False
    for values, key in chain(_file_names(meta), ((meta, f"{split}_filenames") for split in SPLITS)):
        value = values.get(key)
        new = [own(each) for each in value] if isinstance(value, list) else own(value)
        if new != value:
            values[key], changed = new, True
    if changed:
        write_json(file, meta)


# ---------------------------------------------------------------------------------------------- frames and classes


@dataclass
class _Match:
    image: AnnotatedImage
    frame: Frame
    root: Path
    """The folder that the frame's paths start from."""
    turn: int | None = None
    """The frame's `orientation`, if the labels are those of the turned image."""
    file: Path = Path()
    """Where its labels go."""


def _match(capture: Capture, labels: Path, annotations: Annotations) -> tuple[list[_Match], list[str]]:
    """The frame of every image of an export, and the names of the images that have none."""
    named: dict[str, list[tuple[State, Frame]]] = {}
    for state in capture.states:
        for frame in state.frames:
            path = PurePosixPath(frame.name).with_suffix("")
            for key in {
                _key(f"{state.name}/{path}"),
                _key(str(path)),
                _key(f"{state.name}/{path.name}"),
                _key(path.name),
            }:
                named.setdefault(key, []).append((state, frame))
    matches: dict[int, _Match] = {}
    unmatched = []
    for image in annotations.images:
        path, suffix = _exported_path(image.name)
        keys = [_key(text) for p in (path, _without_prefix(path)) for text in (str(p), p.name)]
        found = next((named[key] for key in keys if key in named), [])
        if len(found) > 1:
            found = [(s, f) for s, f in found if s.name in path.parts] or found
        if len({s.name for s, _ in found}) == 1:
            found = [(s, f) for s, f in found if f.image.suffix.lower() == suffix] or found
        if len(found) > 1:
            (a, first), (b, second) = found[:2]
            one, other = (os.path.relpath(f.image, capture.path) for f in (first, second))
            found = f"{image.name!r} may be {one} or {other}"
            mend = f"put the labels of each state into a folder named after it, {a.name} for instance"
            if a is b:
                mend = f"give it its image's path, {one} for instance, or the two images names of their own"
            raise CaptureError(image.file, found, mend)
        if not found:
            unmatched.append(image.name)
            continue
        ((state, frame),) = found
        folder = capture.path / state.name
        match = _Match(image, frame, folder if (folder / TRANSFORMS).is_file() else capture.path)
        _check_match(match, matches.get(id(frame)))
        matches[id(frame)] = match
    if not matches:
        found = f"no frame of the capture has the name of {unmatched[0]!r} or of another labelled image"
        raise CaptureError(labels, found, "keep the images' names when they are annotated")
    return list(matches.values()), unmatched


def _check_match(match: _Match, other: _Match | None) -> None:
    image, frame = match.image, match.frame
    if other is not None:
        found = f"{other.image.name!r} and {image.name!r} both label the frame {frame.name}"
        raise CaptureError(image.file, found, "export every image once, without augmentation")
    stored = frame.camera.width, frame.camera.height
    turn = orientation(frame.image)
    shown = stored[::-1] if turn >= 5 else stored
    if turn > 1 and (image.size is None or shown == stored):
        found = f"EXIF data turn it (orientation {turn}), and {image.name!r} may be labelled so or as it is stored"
        raise CaptureError(frame.image, found, "take the orientation out of the file, and label what it then shows")
    if image.size not in (None, stored, shown):
        found = "{!r} is {}x{} pixels".format(image.name, *image.size)
        size = f"{frame.camera.width}x{frame.camera.height}"
        mend = f"export it at the size of the frame {frame.name}, {size}, without resizing"
        raise CaptureError(image.file, found, mend)
    if image.size == shown != stored:
        match.turn = turn


def _key(name: str) -> str:
    """A name as tools may have changed it: other cases, other signs between letters and digits."""
    return re.sub(r"[\W_]+", "_", name.lower()).strip("_")


def _exported_path(name: str) -> tuple[PurePosixPath, str]:
    """The path of an exported image without what tools append, and the suffix that it had, "" where none is told:
    `a/x_jpg.rf.<hash>.png`, `a\\x.jpg` and `http://a/x.jpg?token=...` are `a/x` and `.jpg`."""
    name = _QUERY.sub(r"\1", name)
    if re.search("[a-z]{2,}:/", name):
        name = unquote(name)
    path, suffix = PurePosixPath(name.replace("\\", "/")), ""
    if path.suffix.lower() in IMAGE_SUFFIXES:
        path, suffix = path.with_suffix(""), path.suffix.lower()
    if found := re.fullmatch(r"(.+?)(?:_(png|jpe?g|webp|bmp|tiff?))?\.rf\.\w+", path.name, flags=re.IGNORECASE):
        path, suffix = path.parent / found[1], f".{found[2].lower()}" if found[2] else ""
    return path, suffix


def _without_prefix(path: PurePosixPath) -> PurePosixPath:
    """The path before Label Studio put 8 hex digits before its name: `a/1a2b3c4d-x` is `a/x`."""
    return path.parent / re.sub("^[0-9a-f]{8}-", "", path.name)


def _part_ids(labels: Path, parts: list[str], classes: Sequence[str]) -> np.ndarray:
    """The part id of every class, by its place from 1 on, uint8; new names are appended to `parts`.

    A class may have a part's name as the capture's reader and our own labels have it, where that is made fit for files.
    """
    known = [part.lower() for part in parts]
    own = {name.lower(): part for name, part in zip(safe_names(parts), parts, strict=True)}
    ids = [0]
    for name in (name if name.lower() in known else own.get(name.lower(), name) for name in classes):
        if (is_background(name) or is_unlabelled(name)) and name.lower() not in known:
            ids.append(0 if is_background(name) else UNLABELLED)
            continue
        if name.lower() not in known:
            parts.append(name)
            known.append(name.lower())
        ids.append(known.index(name.lower()) + 1)
    if len(parts) > MAX_LABEL:
        raise CaptureError(labels, f"there are {len(parts)} parts", f"label at most {MAX_LABEL}")
    return np.array(ids, np.uint8)


# ---------------------------------------------------------------------------------------------- transforms.json


def _metas(capture: Capture) -> dict[Path, dict[str, Any]]:
    """The content of the capture's transforms.json files; of folders without any, what one in them would hold."""
    files = [path / TRANSFORMS for path in (capture.path, *(capture.path / state.name for state in capture.states))]
    found = {file: read_json(file) for file in files if file.is_file()}
    return found or {files[0]: _transforms(capture)}


def _transforms(capture: Capture) -> dict[str, Any]:
    """A transforms.json for all states that says what the files of PARIS, ArtGS or DTA say."""
    frames = []
    lists: dict[str, list[str]] = {"train_filenames": [], "val_filenames": [], "test_filenames": []}
    for k, state in enumerate(capture.states):
        for frame in state.frames:
            camera, image = frame.camera, frame.image.relative_to(capture.path).as_posix()
            entry = {
                **{"file_path": image, "state": k, "transform_matrix": frame.T_world_camera.tolist()},
                **{"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy},
                **{"w": camera.width, "h": camera.height},
                **dict(zip(DISTORTION, camera.distortion, strict=True)),
            }
            own = {
                "semantics_path": frame.labels,
                "mask_path": frame.mask,
                "object_mask_path": frame.object_mask,
                "depth_file_path": frame.depth,
            }
            for key, file in own.items():
                if file is not None:
                    entry[key] = file.relative_to(capture.path).as_posix()
            if frame.depth is not None:
                entry["depth_unit_scale_factor"] = frame.depth_unit
            frames.append(entry)
            lists[f"{frame.split}_filenames"].append(image)
    return {"camera_model": "OPENCV", **lists, "frames": frames}


def _files_that_stay(root: Path, metas: dict[Path, dict[str, Any]], labelled: set[Path]) -> set[str]:
    """The files of all frames, all links followed, but the labels of the images that get new ones."""
    used = []
    for file, meta in metas.items():
        for entry in meta["frames"]:
            new = file.parent / relative_path(file, "file_path", entry.get("file_path")) in labelled
            values = [entry.get(key) for key in FRAME_FILES if not (new and key == "semantics_path")]
            used += [file.parent / value for value in values if isinstance(value, str)]
    return {os.path.realpath(file) for file in used if is_inside(root, file)}


def _label_file(root: Path, frame: Frame, taken: set[str]) -> Path:
    """semantics/0001.png for images/0001.jpg, or another name where this is `taken`, which it joins."""
    parts = [part for part in Path(os.path.relpath(frame.image, root)).parts if part != ".."]
    name = PurePosixPath(*(parts[1:] if len(parts) > 1 and parts[0] == "images" else parts))
    names = chain([name.with_suffix(".png"), f"{name}.png"], (f"{name}.{n}.png" for n in count(2)))
    file = next(f for f in (root / "semantics" / n for n in names) if os.path.realpath(f) not in taken)
    taken.add(os.path.realpath(file))
    return file
