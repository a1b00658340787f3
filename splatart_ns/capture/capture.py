"""What a capture is: states, frames, cameras, part names."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

UNLABELLED = 255
"""The label of a pixel that nobody labelled."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with OpenCV distortion; pixel centres lie at + 0.5."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = (0.0,) * 6
    """k1, k2, k3, k4, p1, p2, in nerfstudio's order."""

    @property
    def distorted(self) -> bool:
        return any(d != 0.0 for d in self.distortion)


@dataclass(frozen=True)
class Frame:
    """One posed image and what belongs to it. Files that are not there are None."""

    name: str
    """The image's path as the capture gives it."""
    image: Path
    camera: Camera
    T_world_camera: np.ndarray
    """Camera to world [4, 4] float64, OpenGL axes, in the capture's length unit."""
    split: str
    """"train", "val" or "test"; a frame in both val and test says "test"."""
    labels: Path | None = None
    """Part ids, one channel of 8 or 16 bits."""
    object_mask: Path | None = None
    """The object's silhouette; without it, the image's alpha."""
    mask: Path | None = None
    """Pixels that count in the loss."""
    depth: Path | None = None


@dataclass(frozen=True)
class State:
    """The frames of one configuration of the object."""

    name: str
    frames: tuple[Frame, ...]
    points: Path | None = None
    """A point cloud (PLY) of the object at this state."""

    def split(self, name: str) -> tuple[Frame, ...]:
        return tuple(f for f in self.frames if f.split == name)


@dataclass(frozen=True)
class Capture:
    """An articulated object seen at two or more configurations."""

    path: Path
    states: tuple[State, ...]
    parts: dict[int, str]
    """Part id to name, in order of id, without the background."""
    length_unit: str = "unknown"
    normalization: Normalization = field(default_factory=lambda: Normalization(np.zeros(3), 1.0))


@dataclass(frozen=True)
class Normalization:
    """The one similarity that brings all states to a working frame: x_normal = scale * (x - centre)."""

    centre: np.ndarray
    """[3] float64, in the capture's unit."""
    scale: float

    def camera_to_normal(self, T_world_camera: np.ndarray) -> np.ndarray:
        """A camera pose [..., 4, 4] in the normalised world."""
        T = T_world_camera.copy()
        T[..., :3, 3] = self.scale * (T[..., :3, 3] - self.centre)
        return T

    def motion_to_world(self, T: np.ndarray) -> np.ndarray:
        """A rigid motion [..., 4, 4] of the normalised world as a motion of the capture's world."""
        out = T.copy()
        R, t = T[..., :3, :3], T[..., :3, 3]
        out[..., :3, 3] = t / self.scale + self.centre - R @ self.centre
        return out

    def motion_to_normal(self, T: np.ndarray) -> np.ndarray:
        """The inverse of `motion_to_world`."""
        out = T.copy()
        R, t = T[..., :3, :3], T[..., :3, 3]
        out[..., :3, 3] = self.scale * (t + R @ self.centre - self.centre)
        return out
