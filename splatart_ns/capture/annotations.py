"""Part labels as annotation tools export them: COCO, YOLO polygons, folders of mask PNGs."""

from __future__ import annotations

import csv
import os
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatart_ns.capture.capture import UNLABELLED, CaptureError
from splatart_ns.capture.images import MAX_LABEL, image_size, orientation, read_labels
from splatart_ns.capture.rasters import decode_runs, decompress_runs, fill_polygon
from splatart_ns.capture.values import is_inside, parse_number, read_json, read_text, read_yaml, show

BACKGROUND_NAMES = ("background", "bg")
UNLABELLED_NAMES = ("unlabelled", "unlabeled", "ignore", "void")
"""Classes of these names are no parts."""
_CLASS_LISTS = ("classes.txt", "obj.names", "_darknet.labels")
_MASK_CLASS_LISTS = (*_CLASS_LISTS, "_classes.csv", "labelmap.txt")
_CLASS_YAMLS = ("data.yaml", "data.yml", "dataset.yaml")
_NOT_COCO, _AS_COCO = "it is no COCO file", "export the labels as COCO segmentation"
_MARK = re.compile(r"[._-](mask|label|seg)s?\.png$", re.IGNORECASE)
"""How masks' names end where they lie beside the images."""
_IMAGE_FOLDERS = {"images", "image", "imgs", "img", "rgb", "JPEGImages"}
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
_Names = dict[int, str]
"""A list of classes: names by their numbers, lines or pixel values."""


@dataclass(frozen=True)
class AnnotatedImage:
    """What an export says of one image."""

    file: Path
    """The file of the export that says it."""
    name: str
    """The image's path as the export spells it."""
    size: tuple[int, int] | None
    """Width and height, where the export knows them."""
    draw: Callable[[int, int], np.ndarray]
    """The labels of an image of this width and height, uint16 [height, width]: 0 where nothing is drawn, else the place
    of a class in `Annotations.classes` plus 1. Raises `InputError` for a shape that makes no sense."""


@dataclass(frozen=True)
class Annotations:
    """One export."""

    format: str
    classes: tuple[str, ...]
    """Those that something is labelled as."""
    images: tuple[AnnotatedImage, ...]


@dataclass(frozen=True)
class _Split:
    """What one list of classes is for: an export, or its train, valid and test, or one state's."""

    classes: tuple[str, ...]
    """All that the list names."""
    used: frozenset[str]
    images: tuple[AnnotatedImage, ...]
    """Drawn by the classes' places in the list."""


def read_annotations(path: Path) -> Annotations:
    """Read an export: a COCO file, or a folder that holds COCO files, YOLO texts or mask PNGs, at any depth.

    - COCO: `.json` files with `images`, `annotations` and `categories`; polygons, runs, compressed runs.
    - YOLO: `.txt` files of "class x y x y ..." lines, coordinates from 0 to 1, beside a `data.yaml` or `classes.txt`.
    - Masks: PNGs of class ids in one channel, beside Roboflow's `_classes.csv` ("Pixel Value, Class"), or a
      `classes.txt` whose line numbers are the ids, from 0 if the first is "background", else from 1. `x.png` beside
      `x_mask.png`, and what lies in a folder of images beside one of masks, is none.

    An image without a shape, or whose mask holds the background alone, is not labelled; later shapes cover earlier
    ones. A class that nothing is labelled as is left out. Where train, valid and test, or states, have lists of classes
    of their own, one of these must name all classes that are used. Nothing outside the folder is opened. Hidden files,
    and other JSON beside COCO files, are passed over.

    Raises `InputError` for anything else.
    """
    annotations = _read(path)
    if not annotations.images:
        raise CaptureError(path, "it labels no image", "export labelled images")
    return annotations


def _read(path: Path) -> Annotations:
    if os.path.isfile(path):
        if zipfile.is_zipfile(path):
            raise CaptureError(path, "it is a zip", "unpack it first and give the folder")
        if path.suffix.lower() in (".txt", ".yaml", ".yml"):
            raise CaptureError(path, "it is one file of many", "give the folder that holds data.yaml or classes.txt")
        if _is_json_list(path):
            raise CaptureError(path, _NOT_COCO, _AS_COCO)
        return _merged("COCO", [_read_coco(path.parent, path, read_json(path))])
    if not path.is_dir():
        raise CaptureError(path, "there are no labels here", "give the file or the folder that the tool exported")
    files = sorted(
        f for f in path.rglob("*") if not _is_hidden(f.relative_to(path)) and os.path.isfile(f) and is_inside(path, f)
    )
    jsons = [f for f in files if f.suffix == ".json"]
    objects = [(f, read_json(f)) for f in jsons if not _is_json_list(f)]
    if coco := [(f, content) for f, content in objects if "annotations" in content and "images" in content]:
        return _merged("COCO", [_read_coco(path, f, content) for f, content in coco])
    if texts := _yolo_texts(path, files):
        lists = _yolo_classes(path, files)
        return _merged("YOLO", [_read_yolo(path, files, named, some) for named, some in _by_list(lists, texts)])
    pngs = [f for f in files if f.suffix.lower() == ".png"]
    if pngs and (not jsons or any(f.name in _MASK_CLASS_LISTS for f in files)):
        lists = _mask_classes(path, files)
        masks = _by_list(lists, _masks_among(path, pngs))
        return _merged("masks", [_read_masks(path, named, some) for named, some in masks])
    if jsons:
        raise CaptureError(jsons[0], _NOT_COCO, _AS_COCO)
    raise CaptureError(
        path,
        "there are no labels here",
        "export them as COCO segmentation, as YOLO polygons with data.yaml, or as mask PNGs with _classes.csv",
    )


def _is_hidden(path: Path) -> bool:
    """Whether systems, and not tools, made a file: `.DS_Store`, macOS's `._x.json` and `__MACOSX/x.json`."""
    return any(part.startswith(".") or part == "__MACOSX" for part in path.parts)


def _is_json_list(file: Path) -> bool:
    """Whether a file holds a JSON list, as Label Studio's own tasks do, which is no export that is read here."""
    return read_text(file).lstrip().startswith("[")


def _by_list(lists: Sequence[tuple[Path, _Names]], files: Sequence[Path]) -> list[tuple[_Names, list[Path]]]:
    """The lists of classes, each with the files that it is for: those in its folder or below. Lists that say the same
    are one, for all files."""
    first, named = lists[0]
    if all(other == named for _, other in lists):
        return [(named, list(files))]
    folders: dict[Path, tuple[_Names, list[Path]]] = {}
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


def _merged(format: str, splits: Sequence[_Split]) -> Annotations:
    """One export of its splits, which must agree on the classes that they use; the others are left out."""
    splits = [split for split in splits if split.images]
    used = frozenset().union(*(split.used for split in splits))
    whole = next((split.classes for split in splits if used <= {*split.classes}), None)
    if splits and whole is None:
        first = splits[0]
        other = next(split for split in splits if not split.used <= {*first.classes})
        found = f"its class {show(min(other.used - {*first.classes}))} is none of those of {first.images[0].file}"
        raise CaptureError(other.images[0].file, found, "name the classes alike, or import one export at a time")
    classes = tuple(name for name in whole or () if name in used)
    images = []
    for split in splits:
        place = np.array([0, *(classes.index(name) + 1 if name in used else 0 for name in split.classes)], np.uint16)
        images += [replace(image, draw=_renumbered(image.draw, place)) for image in split.images]
    return Annotations(format, classes, tuple(images))


def _renumbered(draw: Callable[[int, int], np.ndarray], place: np.ndarray) -> Callable[[int, int], np.ndarray]:
    return lambda width, height: place[draw(width, height)]


# ---------------------------------------------------------------------------------------------- COCO


def _read_coco(root: Path, file: Path, content: dict[str, Any]) -> _Split:
    def objects(key: str) -> Iterator[dict[str, Any]]:
        values = content.get(key)
        if not isinstance(values, list):
            raise CaptureError(file, f"{key} is {show(values)}", _AS_COCO)
        for i, value in enumerate(values):
            if not isinstance(value, dict):
                raise CaptureError(file, f"{key}[{i}] is {show(value)}", "write it as an object")
            yield value

    def field(value: dict[str, Any], key: str, kind: type, of: str) -> Any:
        found = value.get(key)
        if not isinstance(found, kind) or isinstance(found, bool):
            raise CaptureError(file, f"{key} of {of} is {show(found)}", "export the labels again")
        return found

    categories = sorted(objects("categories"), key=lambda c: field(c, "id", int, "a category"))
    drawn: dict[int, list[tuple[int, Any]]] = {}
    used = set()
    for annotation in objects("annotations"):
        used.add(category := field(annotation, "category_id", int, "an annotation"))
        image = field(annotation, "image_id", int, "an annotation")
        drawn.setdefault(image, []).append((category, annotation.get("segmentation")))
    named = {c["id"]: field(c, "name", str, f"category {c['id']}") for c in categories}
    place = {i: k for k, i in enumerate(named, start=1)}
    if unknown := used - set(place):
        raise CaptureError(file, f"category_id {min(unknown)} is in no category", "export the labels again")
    if drawn:
        _check_classes(file, [name for i, name in named.items() if i in used])

    images = []
    for image in objects("images"):
        number = field(image, "id", int, "an image")
        name = field(image, "file_name", str, f"image {number}")
        width, height = (field(image, key, int, f"image {name!r}") for key in ("width", "height"))
        shapes = [(place[category], shape) for category, shape in drawn.pop(number, [])]
        if shapes:
            path = (file.parent.relative_to(root) / name).as_posix()
            images.append(AnnotatedImage(file, path, (width, height), _CocoShapes(file, path, shapes)))
    if drawn:
        raise CaptureError(file, f"image_id {min(drawn)} of an annotation is no image's", "export the labels again")
    return _Split(tuple(named.values()), frozenset(named[i] for i in used), tuple(images))


@dataclass(frozen=True)
class _CocoShapes:
    file: Path
    name: str
    shapes: Sequence[tuple[int, Any]]

    def __call__(self, width: int, height: int) -> np.ndarray:
        labels = np.zeros((height, width), np.uint16)
        for value, shape in self.shapes:
            what = f"a segmentation of {self.name!r}"
            if isinstance(shape, list) and shape:
                for polygon in shape:
                    fill_polygon(labels, _corners(self.file, what, polygon), value)
            elif isinstance(shape, dict) and shape.get("size") == [height, width]:
                labels[self._mask(what, shape.get("counts"), width, height)] = value
            else:
                mend = "export polygons or masks of the image's size, not boxes"
                raise CaptureError(self.file, f"{what} is {show(shape)}", mend)
        return labels

    def _mask(self, what: str, counts: Any, width: int, height: int) -> np.ndarray:
        try:
            if isinstance(counts, str):
                return decode_runs(decompress_runs(counts), width, height)
            if isinstance(counts, list) and all(type(count) is int for count in counts):
                return decode_runs(counts, width, height)
        except ValueError as error:
            raise CaptureError(self.file, f"in {what}, {error}", "export the labels again") from None
        raise CaptureError(self.file, f"counts of {what} is {show(counts)}", "export the labels again")


def _corners(file: Path, what: str, values: Any) -> np.ndarray:
    """A polygon [N, 2] from x, y, x, y, ..."""
    if not isinstance(values, list) or len(values) < 6 or len(values) % 2:
        mend = "give the x and y of three corners or more; a box is no polygon"
        raise CaptureError(file, f"{what} is {show(values)}", mend)
    return np.array([parse_number(file, f"a coordinate of {what}", value) for value in values]).reshape(-1, 2)


# ---------------------------------------------------------------------------------------------- YOLO


def _yolo_texts(path: Path, files: Sequence[Path]) -> list[Path]:
    """Texts in folders called `labels`; without any, all but lists of images, as darknet's train.txt, where there is a
    data.yaml or one of them looks like YOLO."""
    texts = [f for f in files if f.suffix == ".txt" and f.name not in _CLASS_LISTS]
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


def _read_yolo(path: Path, files: Sequence[Path], named: _Names, texts: Sequence[Path]) -> _Split:
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
            images.append(AnnotatedImage(file, name.as_posix(), picture and _shown_size(picture), _YoloShapes(shapes)))
            used.update(value for value, _ in shapes)
    classes = tuple(named.values())
    return _Split(classes, frozenset(classes[value - 1] for value in used), tuple(images))


def _shown_size(picture: Path) -> tuple[int, int]:
    """Width and height as annotation tools show a picture."""
    width, height = image_size(picture)
    return (width, height) if orientation(picture) < 5 else (height, width)


def _yolo_classes(path: Path, files: Sequence[Path]) -> list[tuple[Path, _Names]]:
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
    lists = found or _listed_classes(path, files, "data.yaml or classes.txt")
    named = [(file, {number: name for number, name in enumerate(names) if name}) for file, names in lists]
    for file, names in named:
        _check_classes(file, list(names.values()))
    return named


def _listed_classes(path: Path, files: Sequence[Path], wanted: str) -> list[tuple[Path, list[str]]]:
    """The lists of classes, each with the names by their lines, "" where one is empty."""
    lists = [f for f in files if f.name in _CLASS_LISTS]
    if not lists:
        raise CaptureError(path, "the names of the classes are missing", f"put the export's {wanted} beside the labels")
    return [(f, [line.strip() for line in read_text(f).rstrip().splitlines()]) for f in lists]


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
        corners = _corners(file, f"line {i}", numbers)
        if corners.min() < -0.01 or corners.max() > 1.01:
            raise CaptureError(file, f"line {i} has coordinates beyond 0 to 1", "divide them by width and height")
        yield place[number], corners


@dataclass(frozen=True)
class _YoloShapes:
    shapes: Sequence[tuple[int, np.ndarray]]

    def __call__(self, width: int, height: int) -> np.ndarray:
        labels = np.zeros((height, width), np.uint16)
        for value, corners in self.shapes:
            fill_polygon(labels, corners * [width, height], value)
        return labels


# ---------------------------------------------------------------------------------------------- mask PNGs


def _read_masks(path: Path, named: _Names, pngs: Sequence[Path]) -> _Split:
    place = np.zeros(max(named) + 1, np.uint16)
    for k, value in enumerate(named, start=1):
        place[value] = k
    background = {value for value, name in named.items() if name.lower() in BACKGROUND_NAMES}
    with ThreadPoolExecutor() as pool:
        found = list(pool.map(_mask_values, pngs))
    images = []
    for file in (file for file, values in zip(pngs, found, strict=True) if values is None or values - background):
        name = file.relative_to(path).with_name(_MARK.sub(".png", file.name)).with_suffix("").as_posix()
        images.append(AnnotatedImage(file, name, image_size(file), _Mask(file, place, tuple(named))))
    used = set().union(*(values for values in found if values is not None))
    return _Split(tuple(named.values()), frozenset(named[value] for value in used & {*named}), tuple(images))


def _masks_among(path: Path, pngs: Sequence[Path]) -> Sequence[Path]:
    """The PNGs that are no pictures: those that are marked, as Roboflow's x_mask.png beside x.png; else those outside
    folders of images; else all."""
    marked = [f for f in pngs if _MARK.search(f.name)]
    return marked or [f for f in pngs if not _IMAGE_FOLDERS & {*f.relative_to(path).parts[:-1]}] or pngs


def _mask_values(file: Path) -> set[int] | None:
    """The values of a mask's pixels. One that cannot be read has None: drawing it says why."""
    try:
        return {*np.unique(read_labels(file)).tolist()}
    except CaptureError:
        return None


def _mask_classes(path: Path, files: Sequence[Path]) -> list[tuple[Path, _Names]]:
    """The lists of classes, each with the names by the pixel values; where 0 and 255 have none, they are the background
    and what is unlabelled."""
    lists = [(file, _csv_classes(file)) for file in files if file.name == "_classes.csv"]
    if not lists and (colours := [file for file in files if file.name == "labelmap.txt"]):
        found = "its masks hold colours, as CVAT's Segmentation mask has them"
        raise CaptureError(colours[0], found, "export the labels as COCO 1.0")
    for file, names in [] if lists else _listed_classes(path, files, "_classes.csv or classes.txt"):
        start = 0 if names and names[0].lower() in BACKGROUND_NAMES else 1
        lists.append((file, {value: name for value, name in enumerate(names, start=start) if name}))
    for file, named in lists:
        _check_classes(file, list(named.values()))
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


def write_mask_classes(file: Path, names: Mapping[int, str]) -> None:
    """Write the names of masks' pixel values as a `_classes.csv`."""
    with file.open("w", encoding="utf-8", newline="") as opened:
        csv.writer(opened, lineterminator="\n").writerows([("Pixel Value", "Class"), *names.items()])


def _csv_rows(file: Path) -> list[tuple[int, list[str]]]:
    """The lines that are not empty, each with its number."""
    reader = csv.reader(read_text(file).splitlines(), skipinitialspace=True, strict=True)
    try:
        rows = [(reader.line_num, [word.strip() for word in row]) for row in reader]
    except csv.Error as error:
        found = f"line {reader.line_num} cannot be read ({error})"
        raise CaptureError(file, found, "write a pixel value and a class name") from None
    return [(i, row) for i, row in rows if any(row)]


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


def _check_classes(file: Path, names: list[str]) -> list[str]:
    if not names or len(names) > MAX_LABEL or len({n.lower() for n in names}) < len(names) or not all(names):
        found = f"the classes are {show(names)}"
        raise CaptureError(file, found, f"give 1 to {MAX_LABEL} names, each another")
    return names
