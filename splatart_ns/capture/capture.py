"""What a capture is: states, frames, cameras, part names."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from splatart_ns.choices import Worlds
from splatart_ns.errors import InputError, printable

UNLABELLED = 255
"""The label of a pixel that nobody labelled."""
REACH = 1.5
"""Along each axis of the normalised world, the object is looked for so far from its centre."""


@dataclass(frozen=True)
class Problem:
    """What is wrong with a capture, where, and how to mend it."""

    severity: str
    """"error": it cannot be fitted so; "warning": it can, and somebody should know."""
    file: Path
    message: str
    """What was found."""
    mend: str
    """What to do about it."""

    def __str__(self) -> str:
        return printable(f"{self.file}: {self.message}; {self.mend}")


class CaptureError(InputError):
    """An error in a capture, with its parts kept apart for a list of problems."""

    def __init__(self, file: Path, message: str, mend: str) -> None:
        self.problem = Problem("error", file, message, mend)
        super().__init__(f"{self.problem}.")


Report = Callable[[Problem], None]
"""Takes one problem; it raises, or notes the problem and lets the reader go on."""


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

    @property
    def K(self) -> np.ndarray:
        """The intrinsic matrix [3, 3] float64."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def downscaled(self, factor: int) -> Camera:
        """The camera of the image whose pixels are means of factor x factor pixels; what remains is cut off."""
        return replace(
            self,
            fx=self.fx / factor,
            fy=self.fy / factor,
            cx=self.cx / factor,
            cy=self.cy / factor,
            width=self.width // factor,
            height=self.height // factor,
        )


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
    """Along the optical axis, in counts of `depth_unit`; 0 where unknown."""
    depth_unit: float = 1e-3
    """In the capture's length unit."""


@dataclass(frozen=True)
class State:
    """The frames of one configuration of the object."""

    name: str
    frames: tuple[Frame, ...]
    points: Path | None = None
    """A point cloud (PLY) of the object at this state, in the world that the state came in."""
    placement: np.ndarray = field(default_factory=lambda: np.eye(4))
    """The similarity [4, 4] that brought the frames' poses from that world (see `worlds`)."""

    def split(self, name: str) -> tuple[Frame, ...]:
        return tuple(f for f in self.frames if f.split == name)

    def normalization(self) -> Normalization:
        """The one that this state's cameras alone suggest."""
        return Normalization.from_frames(self.frames)


@dataclass(frozen=True)
class Capture:
    """An articulated object seen at two or more configurations."""

    path: Path
    states: tuple[State, ...]
    parts: dict[int, str]
    """Part id to name, in order of id, without the background."""
    length_unit: str = "unknown"
    worlds: Worlds = "shared"
    normalization: Normalization = field(default_factory=lambda: Normalization(np.zeros(3), 1.0))


@dataclass(frozen=True)
class Normalization:
    """The one similarity that brings all states to a working frame: x_normal = scale * (x - centre)."""

    centre: np.ndarray
    """[3] float64, in the capture's unit."""
    scale: float

    @staticmethod
    def from_frames(frames: Sequence[Frame]) -> Normalization:
        """That of the frames' cameras."""
        half_fov = [math.atan(min(c.width / c.fx, c.height / c.fy) / 2) for c in (f.camera for f in frames)]
        return Normalization.from_cameras(np.stack([f.T_world_camera for f in frames]), np.array(half_fov))

    @staticmethod
    def from_cameras(T_world_camera: np.ndarray, half_fov: np.ndarray) -> Normalization:
        """The centre that all optical axes pass nearest to, at the scale at which the images' half width there is 1.

        So an object that fills the images has a radius of about 1. `T_world_camera` [N, 4, 4] are OpenGL poses,
        `half_fov` [N] the half of the smaller field of view, in radians. The centre is the least-squares solution of
        sum (I - d d^T) (x - c) = 0 over the axes (c, d). Where the axes are parallel, or cross behind the cameras, it
        lies before the cameras' mean, as far away as the cameras are apart.
        """
        c, d = T_world_camera[:, :3, 3], -T_world_camera[:, :3, 2]
        mean = c.mean(axis=0)
        across = np.eye(3) - d[:, :, None] * d[:, None, :]
        A = across.mean(axis=0)
        depth = np.zeros(len(c))
        if np.linalg.eigvalsh(A)[0] > 1e-4:  # about half a degree between the axes
            centre = mean + np.linalg.solve(A, np.einsum("nij,nj->i", across, c - mean) / len(c))
            depth = np.einsum("ni,ni->n", centre - c, d)
        if np.median(depth) <= 0:
            forward = d.mean(axis=0)
            forward = forward / max(np.linalg.norm(forward), 1e-9)
            distance = np.linalg.norm(c - mean, axis=1).max() or 1.0
            centre, depth = mean + distance * forward, np.full(len(c), distance)
        return Normalization(centre, float(1.0 / np.median((depth * np.tan(half_fov))[depth > 0])))

    def camera_to_normal(self, T_world_camera: np.ndarray) -> np.ndarray:
        """A camera pose [..., 4, 4] in the normalised world."""
        T = T_world_camera.copy()
        T[..., :3, 3] = self.scale * (T[..., :3, 3] - self.centre)
        return T

    def motion_to_world(self, T: np.ndarray) -> np.ndarray:
        """A rigid motion [..., 4, 4] of the normalised world as a motion of the capture's world."""
        out = T.copy()
        R, t = T[..., :3, :3], T[..., :3, 3]
        out[..., :3, 3] = t / self.scale + self.centre - R @ self.centre  # also right for similarities
        return out

    def motion_to_normal(self, T: np.ndarray) -> np.ndarray:
        """The inverse of `motion_to_world`."""
        out = T.copy()
        R, t = T[..., :3, :3], T[..., :3, 3]
        out[..., :3, 3] = self.scale * (t + R @ self.centre - self.centre)
        return out
