"""Part labels as PNGs of class ids or colours have them."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from splatart_ns.capture.annotated_image import AnnotatedImage, Split
from splatart_ns.capture.capture import UNLABELLED, CaptureError, State
from splatart_ns.capture.class_list import (
    BACKGROUND_NAMES,
    CLASS_LISTS,
    COLOUR_LIST,
    UNLABELLED_NAMES,
    Colour,
    Names,
    check_classes,
    is_background,
    listed_classes,
)
from splatart_ns.capture.images import image_size, read_image, read_labels
from splatart_ns.capture.values import read_text, show
from splatart_ns.machine import num_cores

MASK_CLASS_LISTS = (*CLASS_LISTS, "_classes.csv", COLOUR_LIST)
"""Files of classes beside masks."""
_MARK = re.compile(r"[._-](mask|label|seg)s?\.png$", re.IGNORECASE)
"""How masks' names end where they lie beside the images."""
_OTHER_FOLDERS = {"images", "image", "imgs", "img", "rgb", "JPEGImages", "SegmentationObject", "SegmentationObjectPNG"}
"""Of images, and of CVAT's and Labelme's masks that give every object a colour."""
_BLACK = (0, 0, 0)
_PLACES = np.array([1 << 16, 1 << 8, 1], np.uint32)
"""Of red, green and blue in a colour's code."""
_VALUES_MEND, _COLOURS_MEND = "write a pixel value and a class name", "write a class name and its red, green and blue"


def masks_among(path: Path, pngs: Sequence[Path]) -> Sequence[Path]:
    """The PNGs that are no pictures: those that are marked, as Roboflow's x_mask.png beside x.png; else those outside
    folders of images; else all."""
    marked = [f for f in pngs if _MARK.search(f.name)]
    return marked or [f for f in pngs if not _OTHER_FOLDERS & {*f.relative_to(path).parts[:-1]}] or pngs


def mask_classes(path: Path, files: Sequence[Path]) -> list[tuple[Path, Names]]:
    """The lists of classes, each with the names by the pixel values or colours; where 0 and 255 have none, they are the
    background and what is unlabelled, and black is the background where nothing is called so."""
    lists = [(file, _csv_classes(file)) for file in files if file.name == "_classes.csv"]
    lists = lists or [(file, _colour_classes(file, _labelmap_rows(file))) for file in files if file.name == COLOUR_LIST]
    for file, names in [] if lists else listed_classes(path, files, "_classes.csv or classes.txt"):
        start = 0 if names and is_background(names[0]) else 1
        lists.append((file, {value: name for value, name in enumerate(names, start=start) if name}))
    for file, named in lists:
        check_classes(file, list(named.values()))
    return [(file, {**_usual(named), **named}) for file, named in lists]


def _usual(named: Names) -> Names:
    if not _coloured(named):
        return {0: BACKGROUND_NAMES[0], UNLABELLED: UNLABELLED_NAMES[0]}
    return {} if any(map(is_background, named.values())) else {_BLACK: BACKGROUND_NAMES[0]}


def _coloured(named: Names) -> bool:
    return isinstance(next(iter(named)), tuple)


def _csv_classes(file: Path) -> Names:
    """The names of the pixel values; the first line is a heading unless it begins with a number. Or those of colours,
    where lines have a name and three numbers; the first is a heading if it has no number."""
    rows = _csv_rows(file)
    if any(_colour(words) and not name.isdigit() for _, (name, *words) in rows):
        return _colour_classes(file, rows if any(word.isdigit() for word in rows[0][1]) else rows[1:])
    named: dict[int, str] = {}
    for i, (value, *words) in rows[1:] if rows and not re.match("[-+.]?[0-9]", rows[0][1][0]) else rows:
        name = ", ".join(word for word in words if word)
        if not re.fullmatch("[0-9]{1,3}", value) or int(value) > UNLABELLED or not name:
            raise CaptureError(file, f"line {i} is {show([value, *words])}", _VALUES_MEND)
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
        raise CaptureError(file, found, _VALUES_MEND) from None
    return [(i, row) for i, row in rows if any(row)]


def _labelmap_rows(file: Path) -> list[tuple[int, list[str]]]:
    """The lines "name:r,g,b:parts:actions", each with its number, the name and the colour."""
    lines = [(i, line.strip()) for i, line in enumerate(read_text(file).splitlines(), start=1)]
    named = [(i, line.partition(":")) for i, line in lines if line and not line.startswith("#")]
    return [(i, [name.strip(), *rest.partition(":")[0].split(",")]) for i, (name, _, rest) in named]


def _colour_classes(file: Path, rows: Sequence[tuple[int, list[str]]]) -> dict[Colour, str]:
    """The names of the colours; a row has a name and three numbers."""
    named: dict[Colour, str] = {}
    for i, (name, *words) in rows:
        colour = _colour(words)
        if colour is None or not name:
            raise CaptureError(file, f"line {i} is {show([name, *words])}", f"{_COLOURS_MEND}, 0 to 255")
        if (other := named.setdefault(colour, name)) != name:
            found = f"the colour {_told(colour)} is {show(other)} and, in line {i}, {show(name)}"
            raise CaptureError(file, found, "give every class a colour of its own")
    return named


def _colour(words: Sequence[str]) -> Colour | None:
    """Three words as red, green and blue, if they are numbers of 0 to 255."""
    numbers = [int(word) for word in words if re.fullmatch("[0-9]{1,3}", word.strip())]
    return tuple(numbers) if len(numbers) == len(words) == 3 and max(numbers) <= 255 else None


def _told(colour: Sequence[int]) -> str:
    return ",".join(map(str, colour))


def read_masks(path: Path, named: Names, pngs: Sequence[Path]) -> Split:
    """The masks of one list of classes, below `path`. Pixels are checked when they are drawn."""
    coloured, named = _coloured(named), {_code(key): name for key, name in named.items()}
    background = {code for code, name in named.items() if is_background(name)}
    masks = [_Mask(file, coloured, tuple(named)) for file in pngs]
    with ThreadPoolExecutor(num_cores()) as pool:
        found = list(pool.map(_Mask.used, masks))
    images = []
    for mask in (mask for mask, codes in zip(masks, found, strict=True) if codes is None or codes - background):
        file = mask.file
        name = file.relative_to(path).with_name(_MARK.sub(".png", file.name)).with_suffix("").as_posix()
        images.append(AnnotatedImage(file, name, image_size(file), mask))
    used = set().union(*(codes for codes in found if codes is not None))
    return Split(tuple(named.values()), frozenset(named[code] for code in used & {*named}), tuple(images))


def _code(key: int | Colour) -> int:
    """A pixel value, or a colour's three in one number."""
    return key if isinstance(key, int) else int(np.dot(key, _PLACES))


@dataclass(frozen=True)
class _Mask:
    file: Path
    coloured: bool
    known: tuple[int, ...]
    """The codes of the classes."""

    def codes(self) -> np.ndarray:
        """Those of the pixels [H, W]."""
        return read_image(self.file)[..., :3] @ _PLACES if self.coloured else read_labels(self.file)

    def used(self) -> set[int] | None:
        """The codes of the pixels. A file that cannot be read has None: drawing it says why."""
        try:
            return {*np.unique(self.codes()).tolist()}
        except CaptureError:
            return None

    def __call__(self, width: int, height: int) -> np.ndarray:
        codes, order = self.codes(), np.argsort(self.known)
        known = np.array(self.known)[order]
        at = np.searchsorted(known, codes).clip(max=len(known) - 1)
        unknown, pixels = np.unique(codes[known[at] != codes], return_counts=True)
        if len(unknown) and not self.coloured:
            raise CaptureError(self.file, f"no class has the value {unknown[0]}", "add it to the list of classes")
        if len(unknown):
            most = pixels.argmax()
            found = f"no class has the colour {_told(unknown[most] // _PLACES % 256)} of {pixels[most]} pixels"
            raise CaptureError(self.file, found, "add it to the list of classes, or export without smooth edges")
        return (order[at] + 1).astype(np.uint16)


def write_mask_classes(file: Path, names: Mapping[int, str]) -> None:
    """Write the names of masks' pixel values as a `_classes.csv`."""
    with file.open("w", encoding="utf-8", newline="") as opened:
        csv.writer(opened, lineterminator="\n").writerows([("Pixel Value", "Class"), *names.items()])


def mask_paths(state: State) -> dict[str, PurePosixPath]:
    """Where an export has the masks of a state's frames, by their names, so that it finds the frames again:
    `STATE/images/0001.png`, or `STATE/images/0001.jpg.png` where the suffix alone tells two images apart."""
    paths = {frame.name: PurePosixPath(frame.name) for frame in state.frames}
    alike = Counter(path.with_suffix("") for path in paths.values())
    for name, path in paths.items():
        bare = path.with_suffix("")
        inner = [part for part in (path if alike[bare] > 1 else bare).parts if part not in ("..", "/")]
        paths[name] = PurePosixPath(state.name, *inner[:-1], f"{inner[-1]}.png")
    return paths
