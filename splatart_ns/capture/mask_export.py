"""Part labels as PNGs of class ids have them."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from splatart_ns.capture.annotated_image import AnnotatedImage, Split
from splatart_ns.capture.capture import UNLABELLED, CaptureError, Frame, State
from splatart_ns.capture.class_list import (
    BACKGROUND_NAMES,
    CLASS_LISTS,
    UNLABELLED_NAMES,
    Names,
    check_classes,
    listed_classes,
)
from splatart_ns.capture.images import image_size, read_labels
from splatart_ns.capture.values import read_text, show
from splatart_ns.machine import num_cores

MASK_CLASS_LISTS = (*CLASS_LISTS, "_classes.csv", "labelmap.txt")
"""Files of classes beside masks."""
_MARK = re.compile(r"[._-](mask|label|seg)s?\.png$", re.IGNORECASE)
"""How masks' names end where they lie beside the images."""
_IMAGE_FOLDERS = {"images", "image", "imgs", "img", "rgb", "JPEGImages"}


def masks_among(path: Path, pngs: Sequence[Path]) -> Sequence[Path]:
    """The PNGs that are no pictures: those that are marked, as Roboflow's x_mask.png beside x.png; else those outside
    folders of images; else all."""
    marked = [f for f in pngs if _MARK.search(f.name)]
    return marked or [f for f in pngs if not _IMAGE_FOLDERS & {*f.relative_to(path).parts[:-1]}] or pngs


def mask_classes(path: Path, files: Sequence[Path]) -> list[tuple[Path, Names]]:
    """The lists of classes, each with the names by the pixel values; where 0 and 255 have none, they are the background
    and what is unlabelled."""
    lists = [(file, _csv_classes(file)) for file in files if file.name == "_classes.csv"]
    if not lists and (colours := [file for file in files if file.name == "labelmap.txt"]):
        found = "its masks hold colours, as CVAT's Segmentation mask has them"
        raise CaptureError(colours[0], found, "export the labels as COCO 1.0")
    for file, names in [] if lists else listed_classes(path, files, "_classes.csv or classes.txt"):
        start = 0 if names and names[0].lower() in BACKGROUND_NAMES else 1
        lists.append((file, {value: name for value, name in enumerate(names, start=start) if name}))
    for file, named in lists:
        check_classes(file, list(named.values()))
    return [(file, {0: BACKGROUND_NAMES[0], UNLABELLED: UNLABELLED_NAMES[0], **named}) for file, named in lists]


def _csv_classes(file: Path) -> dict[int, str]:
    """The names of the pixel values; the first line is a heading unless it begins with a number."""
    named: dict[int, str] = {}
    rows = _csv_rows(file)
    for i, (value, *words) in rows[1:] if rows and not re.match("[-+.]?[0-9]", rows[0][1][0]) else rows:
        name = ", ".join(word for word in words if word)
        if not re.fullmatch("[0-9]{1,3}", value) or int(value) > UNLABELLED or not name:
            raise CaptureError(file, f"line {i} is {show([value, *words])}", "write a pixel value and a class name")
        if (other := named.setdefault(int(value), name)) != name:
            found = f"the pixel value {int(value)} is {show(other)} and, in line {i}, {show(name)}"
            raise CaptureError(file, found, "give every class a value of its own")
    return named


def _csv_rows(file: Path) -> list[tuple[int, list[str]]]:
    """The lines that are not empty, each with its number."""
    reader = csv.reader(read_text(file).splitlines(), skipinitialspace=True, strict=True)
    try:
        rows = [(reader.line_num, [word.strip() for word in row]) for row in reader]
    except csv.Error as error:
        found = f"line {reader.line_num} cannot be read ({error})"
        raise CaptureError(file, found, "write a pixel value and a class name") from None
    return [(i, row) for i, row in rows if any(row)]


def read_masks(path: Path, named: Names, pngs: Sequence[Path]) -> Split:
    """The masks of one list of classes, below `path`. Pixels are checked when they are drawn."""
    place = np.zeros(max(named) + 1, np.uint16)
    for k, value in enumerate(named, start=1):
        place[value] = k
    background = {value for value, name in named.items() if name.lower() in BACKGROUND_NAMES}
    with ThreadPoolExecutor(num_cores()) as pool:
        found = list(pool.map(_mask_values, pngs))
    images = []
    for file in (file for file, values in zip(pngs, found, strict=True) if values is None or values - background):
        name = file.relative_to(path).with_name(_MARK.sub(".png", file.name)).with_suffix("").as_posix()
        images.append(AnnotatedImage(file, name, image_size(file), _Mask(file, place, tuple(named))))
    used = set().union(*(values for values in found if values is not None))
    return Split(tuple(named.values()), frozenset(named[value] for value in used & {*named}), tuple(images))


def _mask_values(file: Path) -> set[int] | None:
    """The values of a mask's pixels. One that cannot be read has None: drawing it says why."""
    try:
        return {*np.unique(read_labels(file)).tolist()}
    except CaptureError:
        return None


@dataclass(frozen=True)
class _Mask:
    file: Path
    place: np.ndarray
    values: tuple[int, ...]

    def __call__(self, width: int, height: int) -> np.ndarray:
        labels = read_labels(self.file)
        if unknown := set(np.unique(labels).tolist()) - set(self.values):
            raise CaptureError(self.file, f"no class has the value {min(unknown)}", "add it to the list of classes")
        return self.place[labels]


def write_mask_classes(file: Path, names: Mapping[int, str]) -> None:
    """Write the names of masks' pixel values as a `_classes.csv`."""
    with file.open("w", encoding="utf-8", newline="") as opened:
        csv.writer(opened, lineterminator="\n").writerows([("Pixel Value", "Class"), *names.items()])


def mask_path(state: State, frame: Frame) -> PurePosixPath:
    """Where an export has the mask of a frame, so that it finds the frame again: `STATE/images/0001.png`, or
    `STATE/images/0001.jpg.png` where the suffix alone tells two images of the state apart."""
    path = PurePosixPath(frame.name)
    bare = path.with_suffix("")
    alike = sum(PurePosixPath(other.name).with_suffix("") == bare for other in state.frames)
    inner = [part for part in (path if alike > 1 else bare).parts if part not in ("..", "/")]
    return PurePosixPath(state.name, *inner[:-1], f"{inner[-1]}.png")
