"""Perspective projection of 3D Gaussians to 2D Gaussians in pixels."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Projection(NamedTuple):
    """2D Gaussians of C cameras; rows with radius 0 are culled and their other values are not to be used."""

    radii: Tensor
    """Three standard deviations along the longest axis, rounded up [C, N], int32, pixels; 0 when culled."""
    means2d: Tensor
    """Centres [C, N, 2], pixels."""
    depths: Tensor
    """Depths along the optical axis [C, N], length."""
    conics: Tensor
    """Inverse covariances [C, N, 3] as (xx, xy, yy)."""
    compensations: Tensor
    """What the blur `eps2d` leaves of a Gaussian's peak when its mass is kept [C, N] (Mip-Splatting)."""


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    eps2d: float = 0.3,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
) -> Projection:
    """Project Gaussians by the local affine approximation of EWA splatting (Zwicker et al. 2001), as gsplat 1.4.0 does.

    Args:
        means: Centres [N, 3], world.
        quats: Rotations [N, 4], wxyz, of any norm; zero counts as the identity.
        scales: Standard deviations [N, 3].
        viewmats: World-to-camera transforms [C, 4, 4], OpenCV axes.
        Ks: Pinhole intrinsics [C, 3, 3], pixels.
        width, height: Image size.
        eps2d: Variance added to the projected covariance, pixels^2.
        near_plane, far_plane: Gaussians with depths outside are culled.
        radius_clip: Gaussians with smaller or equal radii are culled, pixels.
    """
    fx, fy, cx, cy = (Ks[:, i, j, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    R, t = viewmats[:, :3, :3], viewmats[:, :3, 3:]
    x, y, depths = (R @ means.T + t).unbind(1)
    in_range = (depths > near_plane) & (depths < far_plane)
    inverse = 1 / depths.where(in_range, 1.0)
    u, v = x * inverse, y * inverse
    means2d = torch.stack([fx * u + cx, fy * v + cy], -1)

    # Outside the image by more than 0.15 of its size the slope of the perspective is kept from growing.
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    u = torch.minimum(torch.maximum(u, -cx / fx - margin_x), (width - cx) / fx + margin_x)
    v = torch.minimum(torch.maximum(v, -cy / fy - margin_y), (height - cy) / fy + margin_y)

    # Rows of J R, the image's derivative by the world, and then in the Gaussian's own axes times its scales.
    right, down, forward = (R[:, i, :, None] for i in range(3))
    p = (right - u[:, None] * forward) * (fx * inverse)[:, None]
    q = (down - v[:, None] * forward) * (fy * inverse)[:, None]
    axes = _scaled_axes(quats, scales)
    p = (p[:, :, None] * axes).sum(1)
    q = (q[:, :, None] * axes).sum(1)
    pp, pq, qq = p.square().sum(1), (p * q).sum(1), q.square().sum(1)

    # det(cov) = |p x q|^2 has no cancellation, where pp qq - pq^2 loses all digits for needles.
    sharp = torch.linalg.cross(p, q, dim=1).square().sum(1)
    det = sharp + eps2d * (pp + qq) + eps2d**2
    conics = torch.stack([qq + eps2d, -pq, pp + eps2d], -1) / det[..., None]
    has_area = sharp > 0
    compensations = (sharp / det).where(has_area, 1.0).sqrt().where(has_area, 0.0)

    with torch.no_grad():
        half_trace = 0.5 * (pp + qq) + eps2d
        largest = half_trace + (half_trace.square() - det).clamp_min(0.01).sqrt()
        radii = (3 * largest.sqrt()).ceil()
        px, py = means2d.unbind(-1)
        inside = (px + radii > 0) & (px - radii < width) & (py + radii > 0) & (py - radii < height)
        radii = radii.where(in_range & inside & (radii > radius_clip), 0).int()
    return Projection(radii, means2d, depths, conics, compensations)


def _scaled_axes(quats: Tensor, scales: Tensor) -> Tensor:
    """Rotation matrix times scales [3, 3, N] (world axis, own axis, Gaussian)."""
    w, x, y, z = quats.T
    norm2 = w * w + x * x + y * y + z * z
    is_zero = norm2 == 0
    k = 2 / norm2.where(~is_zero, 1.0)
    kx, ky, kz = k * x, k * y, k * z
    xx, yy, zz = kx * x, ky * y, kz * z
    xy, xz, yz = kx * y, kx * z, ky * z
    wx, wy, wz = kx * w, ky * w, kz * w
    sx, sy, sz = scales.T
    return torch.stack(
        [
            torch.stack([sx * (1 - yy - zz), sy * (xy - wz), sz * (xz + wy)]),
            torch.stack([sx * (xy + wz), sy * (1 - xx - zz), sz * (yz - wx)]),
            torch.stack([sx * (xz - wy), sy * (yz + wx), sz * (1 - xx - yy)]),
        ]
    )
