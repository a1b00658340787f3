"""Part labels as Labelme writes them, and tools of its kind (AnyLabeling): a JSON file for each image."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from splatart_ns.capture.annotated_image import AnnotatedImage, Polygons, Split, corners_of
from splatart_ns.capture.capture import CaptureError
from splatart_ns.capture.class_list import check_classes
from splatart_ns.capture.values import show


def is_labelme(content: dict[str, Any]) -> bool:
    """Whether a JSON object is what Labelme says of an image."""
    return "shapes" in content and "imagePath" in content


def read_labelme(root: Path, contents: Sequence[tuple[Path, dict[str, Any]]]) -> Split:
    """The files of an export and what they hold; their classes in the order in which they are met. Images are named
    from `root` on. Raises `InputError` for a shape that is no polygon."""
    drawn = [(file, content, list(_shapes(file, content))) for file, content in contents]
    classes = tuple(dict.fromkeys(label for _, _, shapes in drawn for label, _ in shapes))
    if classes:
        check_classes(contents[0][0].parent, classes)
    images = []
    for file, content, shapes in drawn:
        if shapes:
            size = content.get("imageWidth"), content.get("imageHeight")
            known = size if all(type(side) is int for side in size) else None
            numbered = [(classes.index(label) + 1, corners) for label, corners in shapes]
            images.append(AnnotatedImage(file, _image_name(root, file, content), known, Polygons(numbered)))
    return Split(classes, frozenset(classes), tuple(images))


def _image_name(root: Path, file: Path, content: dict[str, Any]) -> str:
    """The image's own name in the folder of the JSON file: paths lead there from wherever it was when it was saved."""
    path = content["imagePath"]
    if not isinstance(path, str) or not path.strip():
        raise CaptureError(file, f"imagePath is {show(path)}", "save the labels again")
    return (file.parent.relative_to(root) / path.replace("\\", "/").rpartition("/")[2]).as_posix()


def _shapes(file: Path, content: dict[str, Any]) -> Iterator[tuple[str, np.ndarray]]:
    shapes = content["shapes"]
    if not isinstance(shapes, list) or not all(isinstance(shape, dict) for shape in shapes):
        raise CaptureError(file, f"shapes is {show(shapes)}", "save the labels again")
    for i, shape in enumerate(shapes):
        label, kind, points = shape.get("label"), shape.get("shape_type") or "polygon", shape.get("points")
        if not isinstance(label, str) or not label:
            raise CaptureError(file, f"the label of shape {i} is {show(label)}", "name the part")
        if kind != "polygon":
            raise CaptureError(file, f"shape {i} ({label}) is a {kind}", "draw it as a polygon")
        pairs = isinstance(points, list) and all(isinstance(point, list) and len(point) == 2 for point in points)
        corners = [x for point in points for x in point] if pairs else points
        yield label, corners_of(file, f"shape {i} ({label})", corners)
