"""Lists of the classes that an export of labels has."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from splatart_ns.capture.capture import CaptureError
from splatart_ns.capture.images import MAX_LABEL
from splatart_ns.capture.values import read_text, show

BACKGROUND_NAMES = ("background", "bg")
UNLABELLED_NAMES = ("unlabelled", "unlabeled", "ignore", "void")
"""Classes of these names are no parts."""
CLASS_LISTS = ("classes.txt", "class_names.txt", "obj.names", "_darknet.labels")
"""Files with a name a line."""
COLOUR_LIST = "labelmap.txt"
"""CVAT's file with a name and a colour a line."""
Colour = tuple[int, int, int]
"""Red, green and blue, 0..255."""
Names = dict[int, str] | dict[Colour, str]
"""A list of classes: names by their numbers, lines, pixel values or colours."""


def is_background(name: str) -> bool:
    """Whether a class is what surrounds the object; Labelme calls it `_background_`."""
    return name.lower().strip("_") in BACKGROUND_NAMES


def is_unlabelled(name: str) -> bool:
    """Whether a class is what nobody labelled; Labelme calls it `__ignore__`."""
    return name.lower().strip("_") in UNLABELLED_NAMES


def listed_classes(path: Path, files: Sequence[Path], wanted: str) -> list[tuple[Path, list[str]]]:
    """The lists of classes, each with the names by their lines, "" where one is empty."""
    lists = [f for f in files if f.name in CLASS_LISTS]
    if not lists:
        raise CaptureError(path, "the names of the classes are missing", f"put the export's {wanted} beside the labels")
    return [(f, [line.strip() for line in read_text(f).rstrip().splitlines()]) for f in lists]


def by_list(lists: Sequence[tuple[Path, Names]], files: Sequence[Path]) -> list[tuple[Names, list[Path]]]:
    """The lists of classes, each with the files that it is for: those in its folder or below. Lists that say the same
    are one, for all files."""
    first, named = lists[0]
    if all(other == named for _, other in lists):
        return [(named, list(files))]
    folders: dict[Path, tuple[Names, list[Path]]] = {}
    for file, named in lists:
        if folders.setdefault(file.parent, (named, []))[0] != named:
            raise CaptureError(file, f"its classes differ from those of {first}", "keep one of the two")
    for file in files:
        folder = next((folder for folder in file.parents if folder in folders), None)
        if folder is None:
            found = f"its classes may be those of {first} or of {lists[-1][0]}"
            raise CaptureError(file, found, "put the list beside the labels, or import one export at a time")
        folders[folder][1].append(file)
    return [(named, some) for named, some in folders.values() if some]


def check_classes(file: Path, names: Sequence[str]) -> None:
    """Raise `InputError` for names that cannot be those of the parts."""
    if not names or len(names) > MAX_LABEL or len({n.lower() for n in names}) < len(names) or not all(names):
        found = f"the classes are {show(names)}"
        raise CaptureError(file, found, f"give 1 to {MAX_LABEL} names, each another")
