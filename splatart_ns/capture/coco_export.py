"""Part labels as COCO files have them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatart_ns.capture.annotated_image import AnnotatedImage, Split, corners_of
from splatart_ns.capture.capture import CaptureError
from splatart_ns.capture.class_list import check_classes
from splatart_ns.capture.rasters import decode_runs, decompress_runs, fill_polygon
from splatart_ns.capture.values import show

AS_COCO = "export the labels as COCO segmentation"


def read_coco(root: Path, file: Path, content: dict[str, Any]) -> Split:
    """One COCO file's `content`. Images are named from `root` on. Raises `InputError` for what is none."""

    def objects(key: str) -> Iterator[dict[str, Any]]:
        values = content.get(key)
        if not isinstance(values, list):
            raise CaptureError(file, f"{key} is {show(values)}", AS_COCO)
        for i, value in enumerate(values):
            if not isinstance(value, dict):
                raise CaptureError(file, f"{key}[{i}] is {show(value)}", "write it as an object")
            yield value

    def field(value: dict[str, Any], key: str, kind: type, of: str) -> Any:
        found = value.get(key)
        if not isinstance(found, kind) or isinstance(found, bool):
            raise CaptureError(file, f"{key} of {of} is {show(found)}", "export the labels again")
        return found

    def once(values: Iterable[dict[str, Any]], of: str) -> Iterator[dict[str, Any]]:
        seen = set()
        for value in values:
            if (number := field(value, "id", int, of)) in seen:
                raise CaptureError(file, f"the id {number} of {of} is there twice", "export the labels in one piece")
            seen.add(number)
            yield value

    categories = sorted(once(objects("categories"), "a category"), key=lambda c: c["id"])
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
        check_classes(file, [name for i, name in named.items() if i in used])

    images = []
    for image in once(objects("images"), "an image"):
        number = image["id"]
        name = field(image, "file_name", str, f"image {number}")
        width, height = (field(image, key, int, f"image {name!r}") for key in ("width", "height"))
        shapes = [(place[category], shape) for category, shape in drawn.pop(number, [])]
        if shapes:
            path = (file.parent.relative_to(root) / name).as_posix()
            images.append(AnnotatedImage(file, path, (width, height), _CocoShapes(file, path, shapes)))
    if drawn:
        raise CaptureError(file, f"image_id {min(drawn)} of an annotation is no image's", "export the labels again")
    return Split(tuple(named.values()), frozenset(named[i] for i in used), tuple(images))


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
                    fill_polygon(labels, corners_of(self.file, what, polygon), value)
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
