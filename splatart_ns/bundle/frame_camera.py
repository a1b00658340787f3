"""Cameras of a capture's frames: which one, and what lies where in its image, which may be distorted."""

from __future__ import annotations

import math

import cv2
import numpy as np

from splatart_ns.bundle.camera import Camera
from splatart_ns.capture import capture as captures
from splatart_ns.capture.capture import Capture, Frame
from splatart_ns.capture.images import undistorted_points
from splatart_ns.errors import InputError


def find_frame(capture: Capture, camera: str, state: str | None = None) -> Frame:
    """The frame of a state, the first if none is named, by its number in the capture's order or its file's name.

    Raises:
        InputError: there is no such state or frame, or more than one.
    """
    names = [each.name for each in capture.states]
    if state is not None and state not in names:
        raise InputError(f"{capture.path}: has no state '{state}'; choose --state from {', '.join(names)}")
    frames = capture.states[names.index(state) if state is not None else 0].frames
    found = [frame for frame in frames if camera in (frame.name, frame.image.name)]
    if not found and camera.isdecimal():
        found = list(frames[int(camera) : int(camera) + 1])
    if len(found) != 1:
        what = "does not exist" if not found else f"is any of {len(found)}"
        raise InputError(
            f"{capture.path}: camera {camera} {what}; there are 0 to {len(frames) - 1}, {frames[0].name} and so on"
        )
    return found[0]


class FrameView:
    """What a frame's camera sees, by way of a pinhole camera that sees all of it."""

    def __init__(self, frame: Frame):
        self._pixels, wide = pinhole_pixels(frame.camera)
        self.camera = Camera(frame.T_world_camera, (wide.fx, wide.fy, wide.cx, wide.cy), wide.width, wide.height)
        """In the capture's world."""
        self._distorted = frame.camera.distorted

    def as_taken(self, picture: np.ndarray) -> np.ndarray:
        """A picture [h, w, C] of `camera` at the size of the frame's image [H, W, C], and distorted as it is."""
        if not self._distorted:
            return picture
        x, y = (self._pixels - 0.5).astype(np.float32).transpose(2, 0, 1)
        return cv2.remap(picture, x, y, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)


def pinhole_pixels(camera: captures.Camera) -> tuple[np.ndarray, captures.Camera]:
    """For every pixel of a camera, where its ray goes in an image without distortion that holds all of them
    [H, W, 2] float64, column and row, pixel centres at + 0.5; and the camera of that image."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    points = undistorted_points(np.stack([u, v], axis=-1).reshape(-1, 2), camera)
    pixels = points * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    # Rays far beyond the image, which only a bad distortion gives, are clamped to its surroundings.
    size = np.array([camera.width, camera.height])
    pixels = pixels.clip(-size, 2 * size - 1e-6)
    left, top = (math.floor(x) for x in pixels.min(axis=0))
    right, bottom = (math.floor(x) + 1 for x in pixels.max(axis=0))
    wide = captures.Camera(camera.fx, camera.fy, camera.cx - left, camera.cy - top, right - left, bottom - top)
    return (pixels - [left, top]).reshape(camera.height, camera.width, 2), wide
