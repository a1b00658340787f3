"""The pixels of shapes that annotation tools draw: polygons and run-length encoded masks."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

_EDGES_AT_ONCE = 256
_TRACED_CORNERS = 8
"""Fewer may lie on such lines by chance."""


def fill_polygon(image: np.ndarray, corners: np.ndarray, value: int) -> None:
    """Set the pixels of `image` [H, W] whose centre lies inside a polygon [N, 2], by the even-odd rule.

    Corners are x, y in pixels from the image's upper left corner; the centre of the first pixel is (0.5, 0.5). So
    polygons that share an edge share no pixel and leave none between them, and one that runs along pixel borders is
    exact. (OpenCV's fillPoly also takes the pixels that an edge touches.)

    But contours of masks, which tools write down as polygons, count from the first pixel's centre. OpenCV's
    findContours runs through the outermost pixels: what it runs through is its mask's, too. scikit-image's
    find_contours runs midway between them and their neighbours.
    """
    if _is_midway(corners):
        corners = corners + 0.5
    elif _is_traced(corners, *image.shape):
        image[cv2.fillPoly(np.zeros(image.shape, np.uint8), [np.rint(corners).astype(np.int32)], 1) > 0] = value
        return
    # The first pixels whose centre is not before a corner, all in a window of the image around the polygon.
    height, width = image.shape
    after = np.ceil(np.clip(corners - 0.5, 0, [width, height])).astype(int)
    (left, top), (right, bottom) = after.min(axis=0), after.max(axis=0)
    flips = np.zeros((bottom - top, right - left + 1), np.uint8)
    x0, y0 = corners.T
    x1, y1 = np.roll(corners, -1, axis=0).T
    # The rows whose centre line an edge crosses; half open, so that a corner on the line counts once.
    first, last = np.sort(np.stack([after[:, 1], np.roll(after[:, 1], -1)]), axis=0)
    for start in range(0, len(corners), _EDGES_AT_ONCE):
        count = (last - first)[start : start + _EDGES_AT_ONCE]
        edge = np.repeat(np.arange(start, start + len(count)), count)
        row = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + first[edge]
        x = x0[edge] + (row + 0.5 - y0[edge]) / (y1 - y0)[edge] * (x1 - x0)[edge]
        column = np.ceil(np.clip(x - 0.5, left, right)).astype(int)
        np.bitwise_xor.at(flips, (row - top, column - left), 1)
    inside = np.bitwise_xor.accumulate(flips, axis=1)[:, :-1].astype(bool)
    image[top:bottom, left:right][inside] = value


def _is_traced(corners: np.ndarray, height: int, width: int) -> bool:
    """Whether a polygon goes from pixel to pixel along rows, columns and diagonals, as OpenCV's contours do.

    One along pixel borders has no diagonals, and one drawn by hand has others. YOLO's shares are rounded.
    """
    pixels = np.rint(corners)
    across, down = np.abs(np.roll(pixels, -1, axis=0) - pixels).T
    slanted = (across > 0) & (down > 0)
    return (
        len(corners) >= _TRACED_CORNERS
        and np.abs(corners - pixels).max() < 0.01
        and slanted.any()
        and (across == down)[slanted].all()
        and pixels.min() >= 0
        and (pixels < [width, height]).all()
    )


def _is_midway(corners: np.ndarray) -> bool:
    """Whether every corner lies midway between two pixels of a row or a column, as those of scikit-image's contours do.

    pycococreator moves corners beyond the image's edge to 0.
    """
    halves = np.mod(corners * 2, 2)
    midway = (halves == [0, 1]).all(axis=1) | (halves == [1, 0]).all(axis=1)
    return len(corners) >= _TRACED_CORNERS and (midway | (corners == 0).any(axis=1)).all()


def decode_runs(counts: Sequence[int], width: int, height: int) -> np.ndarray:
    """The mask [height, width] bool of COCO's run lengths: pixels column by column, outside and inside by turns.

    Raises ValueError where the runs do not fill the mask.
    """
    if any(count < 0 for count in counts) or sum(counts) != width * height:
        raise ValueError(f"the runs do not fill {width}x{height} pixels")
    return np.repeat(np.arange(len(counts)) % 2 == 1, counts).reshape(width, height).T


def decompress_runs(text: str) -> list[int]:
    """COCO's run lengths from its compressed text.

    A number is written in groups of five bits, the lowest first; a group is a character from "0" (48) on, whose sixth
    bit says that more follow and whose fifth, in the last group, is the sign. From the fourth number on it is the
    difference to the number before the last.

    Raises ValueError for what is no such text.
    """
    counts: list[int] = []
    value = shift = 0
    for character in text:
        bits = ord(character) - 48
        if not 0 <= bits < 64 or shift > 60:
            raise ValueError("the compressed runs are damaged")
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        if bits & 16:
            value -= 1 << shift
        counts.append(value + counts[-2] if len(counts) > 2 else value)
        value = shift = 0
    if shift:
        raise ValueError("the compressed runs are cut off")
    return counts
