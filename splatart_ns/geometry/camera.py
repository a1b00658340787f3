"""Camera poses and the projection of points."""

from __future__ import annotations

import torch
from torch import Tensor

from splatart_ns.geometry.se3 import inverse, transform_points


def viewmat_from_opengl(T_world_camera: Tensor) -> Tensor:
    """World-to-camera matrices [..., 4, 4] with OpenCV axes (x right, y down, z forward) of OpenGL camera poses."""
    return inverse(T_world_camera * torch.tensor([1.0, -1.0, -1.0, 1.0]).to(T_world_camera))


def project_points(points: Tensor, viewmats: Tensor, Ks: Tensor) -> tuple[Tensor, Tensor]:
    """Pixel positions [..., N, 2] and depths [..., N] of world points [..., N, 3] seen by pinhole cameras.

    `viewmats` [..., 4, 4] are OpenCV world-to-camera, `Ks` [..., 3, 3] intrinsics in pixels. Only points of positive
    depth have a meaningful position; the others get that of a point at depth 1.
    """
    in_camera = transform_points(viewmats, points)
    depths = in_camera[..., 2]
    image = in_camera @ Ks.mT
    return image[..., :2] / torch.where(depths > 0, depths, 1.0)[..., None], depths
