"""The values in a capture's JSON files: numbers, paths, matrices, cameras, poses, each checked as it is read.

All functions raise `CaptureError`, which names the file, the entry (`what`, or its `owner`) and the value found.
"""

from __future__ import annotations

import json
import math
import os
import reprlib
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from splatart_ns.capture.capture import Camera, CaptureError
from splatart_ns.capture.images import image_size, undistorted_camera
from splatart_ns.errors import InputError
from splatart_ns.plain_yaml import parse_yaml
from splatart_ns.shape import with_keys_once

PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_TOGETHER = (
    {"fl_x", "fl_y", "camera_angle_x", "camera_angle_y"},
    {*DISTORTION, "distortion_params"},
)
_MOST_BYTES = 256 << 20
LONGEST = 1e12  # a coordinate or focal length beyond this is a mistake, and its square still is a float


def read_text(file: Path) -> str:
    """The text of a file, of at most 256 MiB of UTF-8."""
    if not os.path.isfile(file):
        raise CaptureError(file, "the file does not exist", "add it or correct its path")
    try:
        with open(file, "rb") as stream:
            data = stream.read(_MOST_BYTES + 1)
    except OSError as error:
        raise CaptureError(file, f"the file cannot be read ({error.strerror})", "make it readable") from None
    if len(data) > _MOST_BYTES:
        raise CaptureError(file, "the file is larger than 256 MiB", "give one that describes fewer frames")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise CaptureError(file, "the file is not UTF-8 text", "write it again, or restore a copy") from None


def is_inside(folder: Path, path: Path) -> bool:
    """Whether a path, all links followed, lies in a folder."""
    try:
        return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))
    except (OSError, ValueError):  # too long, or with a null byte
        return False


def read_json(file: Path) -> dict[str, Any]:
    def refuse(key: str) -> CaptureError:
        return CaptureError(file, f"an object has the key {show(key)} twice", "keep one of them")

    try:
        value = json.loads(read_text(file), object_pairs_hook=with_keys_once(refuse))
    except (ValueError, RecursionError) as error:
        raise CaptureError(file, f"the file is not JSON ({error})", "write it again, or restore a copy") from None
    if not isinstance(value, dict):
        raise CaptureError(file, f"the file holds {show(value)}", "write one JSON object")
    return value


def read_yaml(file: Path) -> Any:
    try:
        return parse_yaml(read_text(file))
    except ValueError as error:
        raise CaptureError(file, f"the file is not YAML ({error})", "write it again, or restore a copy") from None


def check_inside(root: Path, file: Path) -> Path:
    """The file, which lies in `root`, all links followed."""
    if not is_inside(root, file):
        raise CaptureError(file, "it is a link out of the capture", "copy what it leads to into the capture")
    return file


def read_inner_json(file: Path, root: Path) -> dict[str, Any]:
    """A JSON object of a file that lies in `root`, all links followed."""
    return read_json(check_inside(root, file))


def relative_path(file: Path, what: str, value: Any) -> str:
    """A path as JSON gives it, in one spelling: ./a//b is a/b."""
    if not isinstance(value, str) or not value.strip():
        found = "is missing" if value is None else f"is {show(value)}"
        raise CaptureError(file, f"{what} {found}", "give the path of a file, from this file's folder")
    return PurePosixPath(value).as_posix()


def inner_path(file: Path, root: Path, what: str, value: Any) -> Path:
    """The file that a path in `file` leads to, from its folder, all links followed: it must lie in `root`."""
    path = file.parent / relative_path(file, what, value)
    if not is_inside(root, path):
        raise CaptureError(file, f"{what} is {show(value)}, outside the capture", "copy the file into the capture")
    return path


def parse_number(file: Path, what: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not -LONGEST < value < LONGEST:
        raise CaptureError(file, f"{what} is {show(value)}", "write a number")
    return float(value)


def parse_positive(file: Path, what: str, value: Any) -> float:
    number = parse_number(file, what, value)
    if number <= 0:
        raise CaptureError(file, f"{what} is {number:g}", "it must be positive")
    return number


def parse_matrix(file: Path, what: str, value: Any, shapes: Sequence[tuple[int, int]]) -> np.ndarray:
    if isinstance(value, list) and all(isinstance(row, list) for row in value):
        rows = [[parse_number(file, f"an entry of {what}", x) for x in row] for row in value]
        if any(len(rows) == m and all(len(row) == n for row in rows) for m, n in shapes):
            return np.array(rows)
    found = "is missing" if value is None else f"is {show(value)}"
    raise CaptureError(file, f"{what} {found}", f"write a {shapes[0][0]}x{shapes[0][1]} matrix as a list of rows")


def show(value: Any) -> str:
    return reprlib.repr(value)


def own_before(entry: dict[str, Any], meta: dict[str, Any]) -> dict[str, Any]:
    """A frame's own values, and those of its file that they do not replace: a focal length of its own replaces both, in
    either form, and so does a distortion. Null is none."""
    own, of_file = ({key: value for key, value in of.items() if value is not None} for of in (entry, meta))
    replaced = {key for group in _TOGETHER if group & own.keys() for key in group}
    return {key: value for key, value in of_file.items() if key not in replaced} | own


def parse_camera(file: Path, owner: str, values: dict[str, Any], image: Path) -> Camera:
    """A camera from nerfstudio's keys in `values`; the image is looked at only where w or h are missing."""

    def number(key: str) -> float | None:
        value = values.get(key)
        return None if value is None else parse_number(file, f"{key} of {owner}", value)

    def positive(key: str) -> float | None:
        value = values.get(key)
        return None if value is None else parse_positive(file, f"{key} of {owner}", value)

    def focal(key: str, angle_key: str, size: int) -> float | None:
        angle = positive(angle_key) if values.get(key) is None else None
        if angle is None:
            return positive(key)
        if angle >= 3.1:
            raise CaptureError(file, f"{angle_key} of {owner} is {angle:g}", "give the field of view in radians")
        return size / 2 / math.tan(angle / 2)

    model = values.get("camera_model") or "OPENCV"
    if str(model).upper() not in PINHOLE_MODELS:
        raise CaptureError(
            file,
            f"camera_model of {owner} is {show(model)}",
            "undistort the images to a pinhole camera first (for instance with COLMAP) and write OPENCV",
        )
    width, height = positive("w"), positive("h")
    if width is None or height is None:
        width, height = image_size(image)
    if width != int(width) or height != int(height) or max(width, height) > 65535:
        raise CaptureError(file, f"w and h of {owner} are {width:g} and {height:g}", "give whole numbers of pixels")
    width, height = int(width), int(height)
    fx = focal("fl_x", "camera_angle_x", width)
    fy = focal("fl_y", "camera_angle_y", height)
    if fx is None and fy is None:
        raise CaptureError(file, f"{owner} has no focal length", "add fl_x and fl_y, in pixels, or camera_angle_x")
    fx, fy = fx or fy, fy or fx
    for key, value, size in (("fl_x", fx, width), ("fl_y", fy, height)):
        if not 0.01 * size < value < 1e4 * size:
            found = f"{key} of {owner} is {value:g}, for {size} pixels"
            raise CaptureError(file, found, "give the focal length in pixels, not in millimetres or image widths")
    cx, cy = number("cx"), number("cy")
    camera = Camera(
        fx=fx,
        fy=fy,
        cx=width / 2 if cx is None else cx,
        cy=height / 2 if cy is None else cy,
        width=width,
        height=height,
        distortion=_distortion(file, owner, values),
    )
    try:
        undistorted_camera(camera)
    except InputError:
        found = f"the distortion of {owner}, {camera.distortion}, leaves no image"
        raise CaptureError(file, found, "correct k1, k2, k3, p1, p2") from None
    return camera


def _distortion(file: Path, owner: str, values: dict[str, Any]) -> tuple[float, ...]:
    given = values.get("distortion_params")
    if given is None:
        given = [0.0 if values.get(key) is None else values[key] for key in DISTORTION]
    if not isinstance(given, list) or len(given) != len(DISTORTION):
        found = f"distortion_params of {owner} is {show(given)}"
        raise CaptureError(file, found, "list k1, k2, k3, k4, p1, p2")
    out = tuple(parse_number(file, f"{key} of {owner}", value) for key, value in zip(DISTORTION, given, strict=True))
    if out[3] != 0.0:
        raise CaptureError(
            file, f"k4 of {owner} is {out[3]:g}", "a pinhole camera has no k4 in nerfstudio: undistort the images first"
        )
    return out


def parse_pose(file: Path, owner: str, value: Any) -> np.ndarray:
    """A camera-to-world pose [4, 4], its rotation made exactly orthonormal."""
    what = f"transform_matrix of {owner}"
    given = parse_matrix(file, what, value, ((4, 4), (3, 4)))
    T = np.eye(4)
    T[: len(given)] = given
    if np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise CaptureError(file, f"{what} has the last row {T[3].tolist()}", "write a camera-to-world pose, row by row")
    U, S, Vt = np.linalg.svd(T[:3, :3])
    scale = float(np.cbrt(np.prod(S)))
    if S[2] < 1e-6:
        found, mend = "cannot be inverted", "write a rotation and a translation"
    elif np.abs(S / scale - 1).max() > 1e-2:
        found, mend = "shears or stretches", "write a rotation and a translation"
    elif abs(scale - 1) > 1e-2:
        found, mend = f"scales by {scale:.4g}", "divide its first three columns by this"
    elif np.linalg.det(T[:3, :3]) < 0:
        found, mend = "mirrors", "negate one column of the rotation, or undo the change of handedness"
    else:
        T[:3, :3] = U @ Vt
        T[3] = [0, 0, 0, 1]
        return T
    raise CaptureError(file, f"{what} {found}", mend)
