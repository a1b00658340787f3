"""Where a bundle is looked at from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from splatart_ns.bundle.bundle import Bundle
from splatart_ns.bundle.posing import configured_motions
from splatart_ns.capture.capture import Camera, Capture
from splatart_ns.capture.images import undistorted_camera
from splatart_ns.errors import InputError
from splatart_ns.geometry.se3 import transform_points

_SAMPLES_PER_PART = 500
_MIN_OPACITY = 0.1
_FIELD_OF_VIEW = math.radians(35)


@dataclass(frozen=True)
class Viewpoint:
    """A pinhole camera in the bundle's world."""

    camera: Camera
    """Without distortion."""
    T_world_camera: np.ndarray
    """[4, 4] float64, OpenGL axes, length in the bundle's unit."""


def bounding_sphere(bundle: Bundle, configurations: Sequence[Mapping[str, float]]) -> tuple[np.ndarray, float]:
    """Centre [3] and radius of a sphere about the visible Gaussians in all configurations, without the outermost 0.5 %.

    The radius is positive even for an object of one point.
    """
    samples = {}
    for part in bundle.parts:
        visible = part.splat.means[part.splat.opacities > _MIN_OPACITY].double()
        step = max(1, len(visible) // _SAMPLES_PER_PART)
        samples[part.name] = visible[::step]
    points = []
    for configuration in configurations:
        motions = configured_motions(bundle, configuration)
        points += [transform_points(motions[name], x) for name, x in samples.items()]
    x = torch.cat(points).numpy()
    if len(x) == 0:
        raise InputError("the bundle has no visible Gaussians; fit it again")
    low, high = np.quantile(x, [0.005, 0.995], axis=0)
    centre = (low + high) / 2
    radius = float(np.quantile(np.linalg.norm(x - centre, axis=1), 0.995))
    return centre, max(radius, 1e-6 * float(np.abs(centre).max()), 1e-12)


def front_azimuth(bundle: Bundle) -> float:
    """The direction in the xy plane, radian from +x to +y, from the root part to the others: where doors are seen."""
    centres = {part.name: part.splat.means.double().mean(0) for part in bundle.parts if len(part.splat)}
    root = centres.pop(bundle.root, None)
    if root is None or not centres:
        return 0.0
    x, y, _ = (torch.stack(list(centres.values())).mean(0) - root).tolist()
    return math.atan2(y, x)


def orbit_viewpoint(
    centre: np.ndarray, radius: float, azimuth: float, elevation: float, width: int, height: int
) -> Viewpoint:
    """A camera that shows the whole sphere; azimuth from +x towards +y and elevation above the xy plane, radian."""
    half = _FIELD_OF_VIEW / 2
    focal = min(width, height) / 2 / math.tan(half)
    back = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    T[:3, 3] = centre + back * 1.1 * radius / math.sin(half)
    return Viewpoint(Camera(focal, focal, width / 2, height / 2, width, height), T)


def capture_viewpoint(capture: Capture, index: int) -> Viewpoint:
    """The camera of a frame of the first state, by its number in the capture's order."""
    frames = capture.states[0].frames
    if not 0 <= index < len(frames):
        raise InputError(f"{capture.path}: camera {index} does not exist; there are 0 to {len(frames) - 1}")
    frame = frames[index]
    return Viewpoint(undistorted_camera(frame.camera), frame.T_world_camera)
