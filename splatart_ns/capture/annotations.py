"""Part labels as annotation tools export them: COCO, YOLO polygons, Labelme, folders of mask PNGs."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from splatart_ns.capture.annotated_image import AnnotatedImage, Split
from splatart_ns.capture.capture import CaptureError
from splatart_ns.capture.class_list import by_list
from splatart_ns.capture.coco_export import AS_COCO, read_coco
from splatart_ns.capture.labelme_export import is_labelme, read_labelme
from splatart_ns.capture.mask_export import MASK_CLASS_LISTS, mask_classes, masks_among, read_masks
from splatart_ns.capture.values import is_inside, read_json, read_text, show
from splatart_ns.capture.yolo_export import read_yolo, yolo_classes, yolo_texts

_NOT_COCO = "it is no COCO file"
_FORMATS_MEND = "export them as COCO segmentation, as YOLO polygons with data.yaml, or as mask PNGs with _classes.csv"


@dataclass(frozen=True)
class Annotations:
    """One export."""

    format: str
    classes: tuple[str, ...]
    """Those that something is labelled as."""
    images: tuple[AnnotatedImage, ...]


def read_annotations(path: Path) -> Annotations:
    """Read an export: a COCO file, or a folder that holds COCO files, Labelme's, YOLO texts or mask PNGs, at any depth.

    - COCO: `.json` files with `images`, `annotations` and `categories`; polygons, runs, compressed runs.
    - Labelme: a `.json` file with `shapes` and `imagePath` for each image; polygons.
    - YOLO: `.txt` files of "class x y x y ..." lines, coordinates from 0 to 1, beside a `data.yaml` or `classes.txt`.
    - Masks: PNGs of class ids in one channel, beside Roboflow's `_classes.csv` ("Pixel Value, Class"), or a
      `classes.txt` whose line numbers are the ids, from 0 if the first is "background", else from 1. PNGs of colours,
      beside CVAT's `labelmap.txt` ("name:r,g,b:parts:actions"), or a `_classes.csv` of "name,r,g,b". `x.png` beside
      `x_mask.png`, and what lies in a folder of images beside one of masks, is none.

    An image without a shape, or whose mask holds the background alone, is not labelled; later shapes cover earlier
    ones. A class that nothing is labelled as is left out. Where train, valid and test, or states, have lists of classes
    of their own, one of these must name all classes that are used. Nothing outside the folder is opened. Hidden files,
    and other JSON beside COCO or Labelme files, are passed over.

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
        if path.suffix.lower() != ".json":
            raise CaptureError(path, "there are no labels here", _FORMATS_MEND)
        if _is_json_list(path):
            raise CaptureError(path, _NOT_COCO, AS_COCO)
        if is_labelme(content := read_json(path)):
            return _merged("Labelme", [read_labelme(path.parent, [(path, content)])])
        return _merged("COCO", [read_coco(path.parent, path, content)])
    if not path.is_dir():
        raise CaptureError(path, "there are no labels here", "give the file or the folder that the tool exported")
    files = sorted(
        f for f in path.rglob("*") if not _is_hidden(f.relative_to(path)) and os.path.isfile(f) and is_inside(path, f)
    )
    jsons = [f for f in files if f.suffix == ".json"]
    objects = [(f, read_json(f)) for f in jsons if not _is_json_list(f)]
    if coco := [(f, content) for f, content in objects if "annotations" in content and "images" in content]:
        return _merged("COCO", [read_coco(path, f, content) for f, content in coco])
    if labelme := [(f, content) for f, content in objects if is_labelme(content)]:
        return _merged("Labelme", [read_labelme(path, labelme)])
    if texts := yolo_texts(path, files):
        lists = yolo_classes(path, files)
        return _merged("YOLO", [read_yolo(path, files, named, some) for named, some in by_list(lists, texts)])
    pngs = [f for f in files if f.suffix.lower() == ".png"]
    if pngs and (not jsons or any(f.name in MASK_CLASS_LISTS for f in files)):
        lists = mask_classes(path, files)
        masks = by_list(lists, masks_among(path, pngs))
        return _merged("masks", [read_masks(path, named, some) for named, some in masks])
    if jsons:
        raise CaptureError(jsons[0], _NOT_COCO, AS_COCO)
    raise CaptureError(path, "there are no labels here", _FORMATS_MEND)


def _is_hidden(path: Path) -> bool:
    """Whether systems, and not tools, made a file: `.DS_Store`, macOS's `._x.json` and `__MACOSX/x.json`."""
    return any(part.startswith(".") or part == "__MACOSX" for part in path.parts)


def _is_json_list(file: Path) -> bool:
    """Whether a file holds a JSON list, as Label Studio's own tasks do, which is no export that is read here."""
    return read_text(file).lstrip().startswith("[")


def _merged(format: str, splits: Sequence[Split]) -> Annotations:
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
