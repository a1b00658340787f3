"""An image as an export of labels has it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatart_ns.capture.capture import CaptureError
from splatart_ns.capture.rasters import fill_polygon
from splatart_ns.capture.values import parse_number, show

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")


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
    of a class in the export's classes plus 1. Raises `InputError` for a shape that makes no sense."""


@dataclass(frozen=True)
class Polygons:
    """Draws polygons, later ones over earlier ones."""

    shapes: Sequence[tuple[int, np.ndarray]]
    """The value of each, and its corners [N, 2]."""
    relative: bool = False
    """Whether corners are in shares of the width and height, not in pixels."""

    def __call__(self, width: int, height: int) -> np.ndarray:
        labels = np.zeros((height, width), np.uint16)
        for value, corners in self.shapes:
            fill_polygon(labels, corners * ([width, height] if self.relative else 1), value)
        return labels


@dataclass(frozen=True)
class Split:
    """What one list of classes is for: an export, or its train, valid and test, or one state's."""

    classes: tuple[str, ...]
    """All that the list names."""
    used: frozenset[str]
    images: tuple[AnnotatedImage, ...]
    """Drawn by the classes' places in the list."""


def corners_of(file: Path, what: str, values: Any) -> np.ndarray:
    """A polygon [N, 2] from x, y, x, y, ..."""
    if not isinstance(values, list) or len(values) < 6 or len(values) % 2:
        mend = "give the x and y of three corners or more; a box is no polygon"
        raise CaptureError(file, f"{what} is {show(values)}", mend)
    return np.array([parse_number(file, f"a coordinate of {what}", value) for value in values]).reshape(-1, 2)
