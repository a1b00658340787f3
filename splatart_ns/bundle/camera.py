"""Cameras in a bundle's world, and where to put them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from splatart_ns.bundle.bundle import Bundle
from splatart_ns.bundle.numbers import as_float64
from splatart_ns.bundle.posing import JointValue, configured_motions
from splatart_ns.capture.capture import Capture
from splatart_ns.capture.images import undistorted_camera
from splatart_ns.errors import InputError
from splatart_ns.geometry.se3 import transform_points
from splatart_ns.records import LONGEST

_SAMPLES_PER_PART = 500
SIZED_BY = 256
"""So many configurations at most say how large the object is."""
_MIN_OPACITY = 0.1
FIELD_OF_VIEW = math.radians(35)
ELEVATION = math.radians(25)
"""Above the xy plane, from where an object is looked at if nothing else is asked for."""
_BESIDE = math.radians(40)
_MOST_PIXELS = 1e9
"""Focal lengths and centres reach no further."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in the bundle's world, or B of one image size. Takes arrays, lists or tensors.

    Raises:
        InputError: shapes that do not fit, a pose that is not rigid, intrinsics that are not a pinhole camera's.
    """

    T_world_camera: Tensor
    """Camera to world [4, 4] or [B, 4, 4], OpenGL axes (x right, y up, looks along -z), length in the bundle's unit."""
    K: Tensor
    """Intrinsics [3, 3] or [B, 3, 3], or (fx, fy, cx, cy): pixels, pixel centres at + 0.5; no skew, no distortion."""
    width: int
    height: int

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            size = getattr(self, name)
            if isinstance(size, bool) or not isinstance(size, int | np.integer) or size < 1:
                raise InputError(f"the camera's {name} is {size!r}; give a whole number of pixels, 1 or more")
            object.__setattr__(self, name, int(size))
        T, K = _pose(self.T_world_camera), _intrinsics(self.K)
        if T.ndim == K.ndim == 3 and len(T) != len(K):
            raise InputError(f"the camera has {len(T)} T_world_camera but {len(K)} K; give as many, or one K")
        object.__setattr__(self, "T_world_camera", T)
        object.__setattr__(self, "K", K)

    @property
    def batch(self) -> tuple[int, ...]:
        """(B,), or () for one camera."""
        return tuple(torch.broadcast_shapes(self.T_world_camera.shape[:-2], self.K.shape[:-2]))


def _pose(value: object) -> Tensor:
    T = _numbers("T_world_camera", value)
    _require_matrices("T_world_camera", T, 4)
    R, last = T[..., :3, :3], T[..., 3, :]
    rigid = torch.allclose(R @ R.mT, torch.eye(3).to(T), atol=1e-4) and bool((torch.linalg.det(R) > 0).all())
    if not rigid or not torch.equal(last, T.new_tensor([0, 0, 0, 1]).expand_as(last)):
        raise InputError("the camera's T_world_camera is no rigid motion; give [R t; 0 0 0 1]")
    if not bool((T.abs() < LONGEST).all()):
        raise InputError(f"the camera's T_world_camera has a number of {float(T.abs().max()):g}; give lengths")
    return T


def _intrinsics(value: object) -> Tensor:
    K = _numbers("K", value)
    if K.shape == (4,):
        (fx, fy, cx, cy), (zero, one) = K, K.new_tensor([0, 1])
        K = torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one]).view(3, 3)
    _require_matrices("K", K, 3)
    pinhole = K.clone()
    pinhole[..., [0, 1], [1, 0]] = 0
    pinhole[..., 2, :] = K.new_tensor([0, 0, 1])
    if not torch.equal(K, pinhole) or not bool((K[..., [0, 1], [0, 1]] > 0).all()):
        raise InputError("the camera's K is no pinhole; give [fx 0 cx; 0 fy cy; 0 0 1] with fx and fy above 0")
    if not bool((K.abs() < _MOST_PIXELS).all()):
        raise InputError(f"the camera's K has a number of {float(K.abs().max()):g}; give pixels")
    return K


def _numbers(name: str, value: object) -> Tensor:
    try:
        return as_float64(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"the camera's {name} is {value!r}; give numbers") from error


def _require_matrices(name: str, tensor: Tensor, size: int) -> None:
    if tensor.ndim not in (2, 3) or tensor.shape[-2:] != (size, size):
        wanted = f"give [{size}, {size}] or [B, {size}, {size}]"
        raise InputError(f"the camera's {name} has the shape {list(tensor.shape)}; {wanted}")
    if not tensor.isfinite().all():
        raise InputError(f"the camera's {name} has a number that is not finite; give finite numbers")


def bounding_sphere(bundle: Bundle, configurations: Sequence[Mapping[str, JointValue]]) -> tuple[np.ndarray, float]:
    """Centre [3] and radius of a sphere about the visible Gaussians in all configurations, or an even choice of them,
    without the outermost 0.5 %.

    The radius is positive even for an object of one point.
    """
    samples = {}
    for part in bundle.parts:
        visible = part.splat.means[part.splat.opacities > _MIN_OPACITY].double()
        step = max(1, len(visible) // _SAMPLES_PER_PART)
        samples[part.name] = visible[::step]
    points = []
    for k in np.unique(np.linspace(0, len(configurations) - 1, SIZED_BY).round().astype(int)):
        configuration = configurations[k]
        motions = configured_motions(bundle, configuration)
        points += [transform_points(motions[name], x).reshape(-1, 3) for name, x in samples.items()]
    x = torch.cat(points).numpy()
    if len(x) == 0:
        raise InputError("the bundle has no visible Gaussians; fit it again")
    low, high = np.quantile(x, [0.005, 0.995], axis=0)
    centre = (low + high) / 2
    radius = float(np.quantile(np.linalg.norm(x - centre, axis=1), 0.995))
    return centre, max(radius, 1e-6 * float(np.abs(centre).max()), 1e-12)


def front_azimuth(bundle: Bundle) -> float:
    """The direction in the xy plane, radian from +x to +y, from which an object is looked at if nothing else is asked
    for: beside that from the root part to the others, where doors are seen."""
    centres = {part.name: part.splat.means.double().mean(0) for part in bundle.parts if len(part.splat)}
    root = centres.pop(bundle.root, None)
    if root is None or not centres:
        return _BESIDE
    x, y, _ = (torch.stack(list(centres.values())).mean(0) - root).tolist()
    return math.atan2(y, x) + _BESIDE


def orbit_camera(
    centre: np.ndarray, radius: float, azimuth: float, elevation: float, width: int, height: int
) -> Camera:
    """A camera that shows the whole sphere; azimuth from +x towards +y and elevation above the xy plane, radian.

    Raises InputError for a radius that is not above 0, and as `Camera` does.
    """
    if not 0 < radius < math.inf:
        raise InputError(f"the radius is {radius}; give a number above 0")
    half = FIELD_OF_VIEW / 2
    focal = min(width, height) / 2 / math.tan(half)
    back = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    T[:3, 3] = centre + back * 1.1 * radius / math.sin(half)
    return Camera(T, (focal, focal, width / 2, height / 2), width, height)


def capture_camera(capture: Capture, index: int) -> Camera:
    """The camera of a frame of the first state, without its distortion, by its number in the capture's order.

    Where there is distortion, it sees a little less than the image shows, as `undistorted_camera` has it.
    """
    frames = capture.states[0].frames
    if not 0 <= index < len(frames):
        raise InputError(f"{capture.path}: camera {index} does not exist; there are 0 to {len(frames) - 1}")
    seen = undistorted_camera(frames[index].camera)
    return Camera(frames[index].T_world_camera, seen.K, seen.width, seen.height)
