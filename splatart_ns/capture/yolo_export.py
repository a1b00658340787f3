"""Part labels as YOLO's texts have them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from splatart_ns.capture.annotated_image import IMAGE_SUFFIXES, AnnotatedImage, Polygons, Split, corners_of
from splatart_ns.capture.capture import CaptureError
from splatart_ns.capture.class_list import CLASS_LISTS, COLOUR_LIST, Names, check_classes, listed_classes
from splatart_ns.capture.images import image_size, orientation
from splatart_ns.capture.values import read_text, read_yaml, show

_CLASS_YAMLS = ("data.yaml", "data.yml", "dataset.yaml")


def yolo_texts(path: Path, files: Sequence[Path]) -> list[Path]:
    """Texts in folders called `labels`; without any, all but lists of images, as darknet's train.txt, where there is a
    data.yaml or one of them looks like YOLO."""
    texts = [f for f in files if f.suffix == ".txt" and f.name not in (*CLASS_LISTS, COLOUR_LIST)]
    if inner := [f for f in texts if "labels" in f.relative_to(path).parts]:
        return inner
    heads = {f: _first_line(f) for f in texts if not f.name.upper().startswith("README")}
    texts = [f for f, head in heads.items() if not head.lower().endswith(IMAGE_SUFFIXES)]
    return texts if any(f.name in _CLASS_YAMLS for f in files) or any(_is_yolo(heads[f]) for f in texts) else []


def _first_line(file: Path) -> str:
    """The first line that is not empty; of what is no text, none."""
    try:
        return read_text(file).lstrip().partition("\n")[0].rstrip()
    except CaptureError:
        return ""


def _is_yolo(line: str) -> bool:
    """Whether a line holds a class number and the coordinates of a polygon or box."""
    try:
        number, *coordinates = line.split()
        return number.isdecimal() and len([float(x) for x in coordinates]) >= 4
    except ValueError:
        return False


def yolo_classes(path: Path, files: Sequence[Path]) -> list[tuple[Path, Names]]:
    """The lists of classes, each with the names by their numbers."""
    found = []
    for file in (f for f in files if f.name in _CLASS_YAMLS):
        content = read_yaml(file)
        names = content.get("names") if isinstance(content, dict) else None
        if isinstance(names, dict) and list(names) == list(range(len(names))):
            names = list(names.values())
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise CaptureError(file, f"names is {show(names)}", "list the classes' names")
        found.append((file, names))
    lists = found or listed_classes(path, files, "data.yaml or classes.txt")
    named = [(file, {number: name for number, name in enumerate(names) if name}) for file, names in lists]
    for file, names in named:
        check_classes(file, list(names.values()))
    return named


def read_yolo(path: Path, files: Sequence[Path], named: Names, texts: Sequence[Path]) -> Split:
    """The texts of one list of classes, below `path`; pictures among `files` tell sizes. Raises `InputError` for a line
    that is no polygon."""
    place = {number: k for k, number in enumerate(named, start=1)}
    pictures = {f.with_suffix(""): f for f in files if f.suffix.lower() in IMAGE_SUFFIXES}
    images = []
    used = set()
    for file in texts:
        shapes = list(_yolo_shapes(file, place))
        if shapes:
            # .../labels/train/x.txt belongs to .../images/train/x.jpg.
            name = file.relative_to(path).with_suffix("")
            beside = path.joinpath(*["images" if part == "labels" else part for part in name.parts])
            picture = pictures.get(beside) or pictures.get(path / name)
            images.append(
                AnnotatedImage(file, name.as_posix(), picture and _shown_size(picture), Polygons(shapes, relative=True))
            )
            used.update(value for value, _ in shapes)
    classes = tuple(named.values())
    return Split(classes, frozenset(classes[value - 1] for value in used), tuple(images))


def _shown_size(picture: Path) -> tuple[int, int]:
    """Width and height as annotation tools show a picture."""
    width, height = image_size(picture)
    return (width, height) if orientation(picture) < 5 else (height, width)


def _yolo_shapes(file: Path, place: dict[int, int]) -> Iterator[tuple[int, np.ndarray]]:
    for i, line in enumerate(read_text(file).splitlines(), start=1):
        if not (words := line.split()):
            continue
        try:
            numbers = [float(word) for word in words[1:]]
            number = int(words[0])
        except ValueError:
            raise CaptureError(file, f"line {i} is {show(line)}", "write a class number and coordinates") from None
        if number not in place:
            found = f"line {i} has class {number}, which none of the {len(place)} classes is"
            raise CaptureError(file, found, "add its name to the classes")
        corners = corners_of(file, f"line {i}", numbers)
        if corners.min() < -0.01 or corners.max() > 1.01:
            raise CaptureError(file, f"line {i} has coordinates beyond 0 to 1", "divide them by width and height")
        yield place[number], corners
