"""One picture of a capture's frames with their labels and what is wrong with them."""

from __future__ import annotations

import colorsys
import textwrap
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from splatart_ns.capture.capture import UNLABELLED, Capture, Frame, Normalization, Problem, State
from splatart_ns.capture.images import write_png
from splatart_ns.capture.view import load_view
from splatart_ns.errors import InputError

MOST_TILES = 96
_COLUMNS, _TILE, _CAPTION, _GAP, _LINES = 8, 160, 66, 8, 4
_BACK, _GREY, _WHITE = (32, 32, 32), (96, 96, 96), (235, 235, 235)
_MARKS = {"error": (60, 60, 235), "warning": (40, 165, 255), "label next": (235, 170, 60)}  # BGR


def write_contact_sheet(
    file: Path, capture: Capture, problems: Sequence[Problem], suggested: Sequence[Frame] = ()
) -> None:
    """Write a PNG of tiles, one a frame: the image with its labels in the parts' colours and the silhouette's outline,
    framed red for an error, orange for a warning, blue for a frame to label next, and what is said of it below.

    Of many frames those with a mark come first, then others evenly, up to `MOST_TILES`.
    """
    said: dict[Path, list[Problem]] = {}
    for problem in problems:
        said.setdefault(problem.file, []).append(problem)
    marked, plain = [], []
    for state in capture.states:
        for frame in state.frames:
            files = (frame.image, frame.labels, frame.object_mask, frame.mask, frame.depth)
            marks = [(p.severity, p.message) for f in dict.fromkeys(files) for p in said.get(f, ())]
            marks += [("label next", "label this frame next")] * any(frame is other for other in suggested)
            (marked if marks else plain).append((state, frame, marks))
    marked.sort(key=lambda item: "error" not in [severity for severity, _ in item[2]])
    room = max(0, MOST_TILES - len(marked))
    if len(plain) > room:
        plain = [plain[i] for i in np.linspace(0, len(plain) - 1, room).astype(int)]
    rows = [
        [_tile(*item, caption=_CAPTION) for item in marked[:MOST_TILES]],
        [_tile(*item, caption=18) for item in plain],
    ]
    frames = [frame for state in capture.states for frame in state.frames]
    of_frames = {f for x in frames for f in (x.image, x.labels, x.object_mask, x.mask, x.depth)}
    general = [p for p in problems if p.file not in of_frames]
    header = _header(capture, general, len(frames), sum(map(len, rows)))
    write_png(file, np.concatenate([header, *(_grid(tiles) for tiles in rows if tiles)]))


def _grid(tiles: Sequence[np.ndarray]) -> np.ndarray:
    blank = np.full_like(tiles[0], _BACK)
    tiles = [*tiles, *[blank] * (-len(tiles) % _COLUMNS)]
    return np.concatenate([np.concatenate(tiles[i : i + _COLUMNS], axis=1) for i in range(0, len(tiles), _COLUMNS)])


def _header(capture: Capture, problems: Sequence[Problem], frames: int, shown: int) -> np.ndarray:
    """What is said of the capture as a whole, and which colour each part has."""
    width = _COLUMNS * (_TILE + 2 * _GAP)
    lines = [(f"{capture.path.name}: {len(capture.states)} states, {frames} frames, {shown} shown", _WHITE)]
    for problem in problems[:12]:
        text = f"{problem.severity}: {problem.file.name}: {problem.message}"
        lines += [(line, _MARKS[problem.severity]) for line in textwrap.wrap(text, 150)]
    image = np.full((26 + 20 * len(lines) + 24, width, 3), _BACK, np.uint8)
    for i, (line, colour) in enumerate(lines):
        _write(image, line, (_GAP, 24 + 20 * i), colour, 0.5)
    x, y = _GAP, 24 + 20 * len(lines)
    for part, name in list(capture.parts.items())[:16]:
        cv2.rectangle(image, (x, y - 10), (x + 12, y + 2), _colour(part), -1)
        _write(image, f"{part} {name}"[:20], (x + 18, y + 1), _WHITE, 0.42)
        x += 40 + 8 * len(f"{part} {name}"[:20])
    return image


def _tile(state: State, frame: Frame, marks: Sequence[tuple[str, str]], caption: int) -> np.ndarray:
    tile = np.full((_TILE + caption + 2 * _GAP, _TILE + 2 * _GAP, 3), _BACK, np.uint8)
    picture = _picture(frame)
    height, width = picture.shape[:2]
    top, left = _GAP + (_TILE - height) // 2, _GAP + (_TILE - width) // 2
    tile[top : top + height, left : left + width] = picture
    severity = next((s for s in _MARKS if s in [severity for severity, _ in marks]), None)
    if severity is not None:
        cv2.rectangle(tile, (3, 3), (_TILE + 2 * _GAP - 4, _TILE + 2 * _GAP - 4), _MARKS[severity], 3)
    _write(tile, f"{state.name}/{frame.name}"[-27:], (_GAP, _TILE + 2 * _GAP + 8), _WHITE)
    text = "; ".join(message for _, message in marks).replace(f" of {frame.name}", "")
    for i, line in enumerate(textwrap.wrap(text, 27, max_lines=_LINES, placeholder="...")):
        _write(tile, line, (_GAP, _TILE + 2 * _GAP + 22 + 12 * i), _MARKS[severity])
    return tile


def _picture(frame: Frame) -> np.ndarray:
    """A frame, BGR, at most a tile wide, its parts in their colours; what cannot be read is a cross."""
    longest = max(frame.camera.width, frame.camera.height)
    try:
        view = load_view(frame, Normalization(np.zeros(3), 1.0), max(1, longest // _TILE))
    except InputError:
        cross = np.full((_TILE, _TILE, 3), _GREY, np.uint8)
        cv2.line(cross, (0, 0), (_TILE, _TILE), _MARKS["error"], 2)
        cv2.line(cross, (0, _TILE), (_TILE, 0), _MARKS["error"], 2)
        return cross
    image = view.rgb.numpy()[..., ::-1].astype(np.float32)
    if view.alpha is not None:
        alpha = view.alpha.numpy()[..., None] / 255
        image = image * alpha + np.array(_GREY, np.float32) * (1 - alpha)
    if view.labels is not None:
        labels = view.labels.numpy()
        for part in np.unique(labels[(labels > 0) & (labels != UNLABELLED)]):
            image[labels == part] = 0.45 * image[labels == part] + 0.55 * np.array(_colour(int(part)))
    image = image.astype(np.uint8)
    if view.alpha is not None:
        outlines, _ = cv2.findContours(
            (view.alpha.numpy() > 127).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE
        )
        cv2.drawContours(image, outlines, -1, _WHITE, 1)
    scale = _TILE / max(image.shape[:2])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST)


def _colour(part: int) -> tuple[int, int, int]:
    """BGR; the hues of `splats.palette`, which cannot be imported from here."""
    red, green, blue = colorsys.hsv_to_rgb(part * 0.6180339887498949 % 1, 0.65, 0.9)
    return round(255 * blue), round(255 * green), round(255 * red)


def _write(
    image: np.ndarray, text: str, at: tuple[int, int], colour: tuple[int, int, int], scale: float = 0.36
) -> None:
    plain = text.encode("ascii", "replace").decode()  # OpenCV's letters
    cv2.putText(image, plain, at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)
