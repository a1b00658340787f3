"""One frame's pixels and camera as tensors, undistorted and in the normalised world."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from splatart_ns.capture import images
from splatart_ns.capture.capture import UNLABELLED, Capture, CaptureError, Frame, Normalization, State
from splatart_ns.capture.images import (
    downscale_labels,
    read_depth_for,
    read_image,
    read_labels,
    read_mask,
    read_silhouette,
    read_sized,
    undistort,
    undistort_labels,
    undistorted_camera,
)
from splatart_ns.errors import InputError
from splatart_ns.machine import num_cores

Window = tuple[int, int, int, int]
"""A piece of an image: left, top, right, bottom, in pixels; the last two are one past it."""
MARGIN = 16
"""Pixels around an object that are looked at too."""
GRAIN = 8
"""A piece begins at a multiple of so many pixels, so that one of smaller images does."""


@dataclass
class View:
    """What one pinhole camera saw."""

    name: str
    viewmat: Tensor
    """World to camera [4, 4] float32, OpenCV axes, in the normalised world."""
    K: Tensor
    """[3, 3] float32, pixel centres at + 0.5."""
    width: int
    height: int
    rgb: Tensor
    """uint8 [H, W, 3], straight: not multiplied by alpha."""
    alpha: Tensor | None = None
    """uint8 [H, W], how much of each pixel the object covers."""
    labels: Tensor | None = None
    """uint8 [H, W]: 0 background, 1..P parts, 255 unlabelled."""
    mask: Tensor | None = None
    """bool [H, W], the pixels that count in the loss."""
    depth: Tensor | None = None
    """float32 [H, W], along the optical axis in the normalised world; 0 where unknown."""
    outlined_by_splat: bool = False
    """Whether `alpha` is not what somebody gave, but rendered from the state's own splat."""

    def to(self, device: torch.device | str) -> View:
        """The view with its tensors on a device."""
        tensors = {f.name: v.to(device) for f in fields(self) if isinstance(v := getattr(self, f.name), Tensor)}
        return replace(self, **tensors)

    def rgb_on(self, background: Tensor) -> Tensor:
        """The image in front of a background colour [3] in 0..1: float32 [H, W, 3] in 0..1."""
        rgb = self.rgb.float() / 255
        if self.alpha is None:
            return rgb
        alpha = self.alpha.float()[..., None] / 255
        return rgb * alpha + background * (1 - alpha)

    def object_window(self) -> Window:
        """The piece that shows the object and a margin, from a multiple of `GRAIN` to a multiple of it or the border;
        all of an image without an alpha, or without the object."""
        shown = None if self.alpha is None else self.alpha > 0
        if shown is None or not shown.any():
            return 0, 0, self.width, self.height
        left, top, right, bottom = box(shown)
        low = (max(0, (x - MARGIN) // GRAIN * GRAIN) for x in (left, top))
        high = (min(n, -(-(x + MARGIN) // GRAIN) * GRAIN) for x, n in ((right, self.width), (bottom, self.height)))
        return *low, *high

    def cropped(self, window: Window) -> View:
        """The piece of the view in a window."""
        left, top, right, bottom = window
        K = self.K.clone()
        K[0, 2] -= left
        K[1, 2] -= top
        names = ("rgb", "alpha", "labels", "mask", "depth")
        pixels = {k: x[top:bottom, left:right] for k in names if (x := getattr(self, k)) is not None}
        return replace(self, K=K, width=right - left, height=bottom - top, **pixels)


def box(shown: Tensor) -> Window:
    """The smallest piece of an image that holds all that is `shown` [H, W] bool, which is something."""
    columns, rows = (shown.any(dim).nonzero() for dim in (0, 1))
    return int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1


def load_views(capture: Capture, state: int | State, split: str = "train", downscale: int = 1) -> list[View]:
    """The views of one split of a state (its number, or itself), `downscale` times smaller, in the frames' order.

    Raises `InputError` for a file that cannot be used.
    """
    frames = (capture.states[state] if isinstance(state, int) else state).split(split)
    with ThreadPoolExecutor(num_cores()) as pool:
        return list(pool.map(lambda frame: load_view(frame, capture.normalization, downscale), frames))


def evenly(views: Sequence[View], most: int) -> Sequence[View]:
    """At most so many of some views, evenly spread over them."""
    return views if len(views) <= most else [views[len(views) * k // most] for k in range(most)]


def load_view(frame: Frame, normalization: Normalization, downscale: int = 1) -> View:
    """One view. Its alpha is the image's where there is one, without what the frame's object mask leaves out; for an
    opaque image, also one whose alpha is 255 everywhere, it is the mask, and None when there is none.

    Raises `InputError` for a file that cannot be used.
    """
    distorted = frame.camera
    camera = undistorted_camera(distorted).downscaled(downscale)
    if min(camera.width, camera.height) < 1:
        raise InputError(f"{frame.image}: nothing is left of the image at 1/{downscale}; use a smaller factor.")

    def read(path: Path, reader: Callable[[Path], np.ndarray]) -> np.ndarray:
        return images.downscale(undistort(read_sized(path, reader, distorted), distorted), downscale)

    image = read(frame.image, read_image)
    alpha = labels = mask = depth = None
    if image.shape[2] == 4 and not (image[..., 3] == 255).all():
        alpha = torch.from_numpy(np.ascontiguousarray(image[..., 3]))
    if frame.object_mask is not None:
        silhouette = read(frame.object_mask, read_silhouette)
        if alpha is None:
            alpha = torch.from_numpy(silhouette)
        else:  # a mask is hard where the alpha is soft: leave the pixels along its edge to the alpha
            alpha = torch.minimum(alpha, torch.from_numpy(cv2.dilate(silhouette, np.ones((3, 3), np.uint8))))
    if frame.labels is not None:
        ids = undistort_labels(read_sized(frame.labels, read_labels, distorted), distorted)
        labels = torch.from_numpy(downscale_labels(ids, downscale))
    if frame.mask is not None:
        mask = torch.from_numpy(read(frame.mask, read_mask) > 127)
        if labels is not None:
            labels = torch.where(mask, labels, UNLABELLED)
    if frame.depth is not None:
        measured = read_depth_for(frame.depth, distorted, normalization.scale * frame.depth_unit)
        depth = torch.from_numpy(downscale_labels(undistort_labels(measured, distorted, unknown=0), downscale))
    T = normalization.camera_to_normal(frame.T_world_camera) @ np.diag([1.0, -1.0, -1.0, 1.0])
    return View(
        name=frame.name,
        viewmat=torch.from_numpy(np.linalg.inv(T)).float(),
        K=torch.from_numpy(camera.K).float(),
        width=camera.width,
        height=camera.height,
        rgb=torch.from_numpy(np.ascontiguousarray(image[..., :3])),
        alpha=alpha,
        labels=labels,
        mask=mask,
        depth=depth,
    )


def load_points(path: Path, normalization: Normalization, placement: np.ndarray | None = None) -> tuple[Tensor, Tensor]:
    """A point cloud (PLY) in the normalised world: float32 [N, 3], and uint8 colours [N, 3], grey where it has none.

    `placement` [4, 4] brings its world to the capture's.
    Raises `InputError` if it cannot be read or is empty.
    """
    import trimesh  # which takes a while, for what few captures have

    try:  # from bytes: a file could name a texture elsewhere
        cloud = trimesh.load(io.BytesIO(images.read_bytes(path)), file_type="ply", process=False)
        xyz = np.asarray(cloud.vertices, dtype=np.float64)
        rgb = np.asarray(cloud.visual.vertex_colors)
    except CaptureError:
        raise
    except Exception as error:  # trimesh lets whatever its parsers meet through
        found = f"the point cloud cannot be read ({type(error).__name__}: {error})"
        raise CaptureError(path, found, "write it again as a PLY of points, or take ply_file_path out") from None
    if len(xyz) == 0 or not np.isfinite(xyz).all():
        raise CaptureError(path, "the point cloud is empty or not finite", "write it again, or take ply_file_path out")
    if placement is not None:
        xyz = xyz @ placement[:3, :3].T + placement[:3, 3]
    rgb = rgb[:, :3].astype(np.uint8) if len(rgb) == len(xyz) else np.full(xyz.shape, 128, np.uint8)
    return torch.from_numpy(normalization.scale * (xyz - normalization.centre)).float(), torch.from_numpy(rgb)
