"""Perspective projection of 3D Gaussians to 2D Gaussians in pixels."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

LARGEST_RADIUS = 1e9
"""Radii end here, to fit an int32; pixels."""
LEAST_QUATERNION = 1e-30
"""Quaternions of a norm up to this count as the identity; their gradient is 0."""


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
        quats: Rotations [N, 4], wxyz, of any norm; zero, or nearly, counts as the identity.
        scales: Standard deviations [N, 3].
        viewmats: World-to-camera transforms [C, 4, 4], OpenCV axes.
        Ks: Pinhole intrinsics [C, 3, 3], pixels.
        width, height: Image size.
        eps2d: Variance added to the projected covariance, pixels^2.
        near_plane, far_plane: Gaussians with depths outside are culled.
        radius_clip: Gaussians with smaller or equal radii are culled, pixels.
    """
    outputs = _Project.apply(
        means, quats, scales, viewmats, Ks, (width, height), eps2d, (near_plane, far_plane), radius_clip
    )
    return Projection(*outputs)


class _Project(torch.autograd.Function):
    """Components come before Gaussians ([3, C, N] and the like), so that every operation runs over long vectors."""

    @staticmethod
    def forward(ctx, means, quats, scales, viewmats, Ks, size, eps2d, depth_range, radius_clip):
        size = means.new_tensor(size)[:, None, None]
        focal = Ks[:, :2, :2].diagonal(dim1=1, dim2=2).T[..., None]  # [2, C, 1], as all of x and y
        principal = Ks[:, :2, 2].T[..., None]
        W = viewmats[:, :3, :3].permute(1, 2, 0)[..., None]  # [3, 3, C, 1]

        local = viewmats[:, :3, :3] @ means.T + viewmats[:, :3, 3:]
        depths = local[:, 2]
        in_range = (depths > depth_range[0]) & (depths < depth_range[1])
        inverse = 1 / depths.where(in_range, 1.0)
        slope = local[:, :2].transpose(0, 1) * inverse
        means2d = focal * slope + principal

        # Outside the image by more than 0.15 of its size the slope in the derivative is kept from growing.
        margin = 0.15 * size
        limited = slope.clamp((-margin - principal) / focal, (size + margin - principal) / focal)

        # The rows p and q of J W, the image's derivative by the world, and those of J W R S.
        scale = focal * inverse
        JW = scale[:, None] * (W[:2] - limited[:, None] * W[2])
        R, unit, inverse_norm = _rotation(quats)
        axes = R * scales.T  # [3 (world), 3 (own), N]
        JWRS = (JW[:, :, None] * axes[:, :, None]).sum(1)
        # In units of the Gaussian's own size in the image fourth powers of it neither overflow nor underflow.
        size2d = (JWRS.square().sum((0, 1)) + max(eps2d, 1e-12)).sqrt()
        JWRS = JWRS / size2d
        eps = eps2d / size2d.square()
        p, q = JWRS
        (pp, qq), pq = JWRS.square().sum(1), (p * q).sum(0)

        # det(cov) = |p x q|^2 has no cancellation, where pp qq - pq^2 loses all digits for needles.
        normal = _cross(p, q)
        sharp = normal.square().sum(0)
        inverse_det = 1 / (sharp + eps * (pp + qq) + eps.square())
        conics = torch.stack([qq + eps, -pq, pp + eps]) * (inverse_det / size2d.square())
        compensations = (sharp * inverse_det).sqrt()

        half_trace = 0.5 * (pp + qq) + eps
        spread = (half_trace.square() - 1 / inverse_det).clamp_min(0).sqrt() * size2d.square()
        largest = half_trace * size2d.square() + spread.clamp_min(0.1)
        radii = (3 * largest.sqrt()).ceil().clamp_max(LARGEST_RADIUS)
        inside = ((means2d + radii > 0) & (means2d - radii < size)).all(0)
        radii = radii.where(in_range & inside & (radii > radius_clip), 0).int()

        ctx.eps = eps
        ctx.save_for_backward(means, scales, viewmats, focal, inverse, in_range, slope, limited, JW, R, unit)
        ctx.intermediates = inverse_norm, JWRS, size2d, normal, sharp, inverse_det, conics, compensations
        ctx.mark_non_differentiable(radii)
        means2d, conics = (x.permute(1, 2, 0).contiguous() for x in (means2d, conics))
        return radii, means2d, depths.contiguous(), conics, compensations.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx, _, v_means2d, v_depths, v_conics, v_compensations):
        means, scales, viewmats, focal, inverse, in_range, slope, limited, JW, R, unit = ctx.saved_tensors
        inverse_norm, JWRS, size2d, normal, sharp, inverse_det, conics, compensations = ctx.intermediates
        W = viewmats[:, :3, :3].permute(1, 2, 0)[..., None]
        p, q = JWRS

        # conics = (qq + eps, -pq, pp + eps) / det / size2d^2 and compensation^2 = sharp / det.
        v_a, v_b, v_c = v_conics.unbind(-1)
        a, b, c = conics
        v_log_compensation = 0.5 * v_compensations * compensations
        v_det = -(v_a * a + v_b * b + v_c * c + v_log_compensation) * inverse_det
        v_sharp = v_det + (v_log_compensation / sharp).where(sharp > 0, 0.0)
        scaled = inverse_det / size2d.square()
        v_pq = -v_b * scaled
        v_pp, v_qq = v_c * scaled + ctx.eps * v_det, v_a * scaled + ctx.eps * v_det
        turn = 2 * v_sharp * normal
        v_JWRS = torch.stack([2 * v_pp * p + v_pq * q + _cross(q, turn), 2 * v_qq * q + v_pq * p + _cross(turn, p)])
        v_JWRS = v_JWRS / size2d

        axes = R * scales.T
        v_JW = (v_JWRS[:, None] * axes[:, :, None]).sum(2)
        scale = focal * inverse
        v_limited = -scale * (v_JW * W[2]).sum(1)
        is_free = slope == limited
        v_slope = focal * v_means2d.permute(2, 0, 1) + v_limited * is_free
        v_inverse = (v_slope * slope).sum(0) + (v_JW * JW).sum((0, 1))
        v_depth = v_depths - v_inverse * inverse * in_range
        v_local = torch.cat([v_slope * inverse, v_depth[None]]).transpose(0, 1)  # [C, 3, N]

        v_means = v_quats = v_scales = v_viewmats = None
        if ctx.needs_input_grad[0]:
            v_means = (viewmats[:, :3, :3].mT @ v_local).sum(0).T
        if ctx.needs_input_grad[1] or ctx.needs_input_grad[2]:
            v_axes = (JW[:, :, None] * v_JWRS[:, None]).sum((0, 3))
            v_scales = (v_axes * R).sum(0).T
            v_quats = _rotation_backward(v_axes * scales.T, unit, inverse_norm)
        if ctx.needs_input_grad[3]:
            v_viewmats = torch.zeros_like(viewmats)
            v_viewmats[:, :3, 3] = v_local.sum(-1)
            v_viewmats[:, :3, :3] = v_local @ means
            v_rows = (scale[:, None] * v_JW).sum(-1)  # [2, 3, C]
            v_forward = -((limited * scale)[:, None] * v_JW).sum((0, -1))
            v_viewmats[:, :3, :3] += torch.cat([v_rows, v_forward[None]]).permute(2, 0, 1)
        return v_means, v_quats, v_scales, v_viewmats, None, None, None, None, None


def _rotation(quats: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rotation matrices [3, 3, N], the unit quaternions [4, N], and one over the norms [N], 0 for zero quaternions."""
    quats = quats.T.contiguous()
    largest = quats.abs().amax(0).clamp_min(LEAST_QUATERNION)
    norm = (quats / largest).square().sum(0).sqrt() * largest
    inverse_norm = (1 / norm).where(norm > LEAST_QUATERNION, 0.0)
    unit = quats * inverse_norm
    ww, wx, wy, wz, _, xx, xy, xz, _, _, yy, yz, _, _, _, zz = (2 * unit[:, None] * unit).flatten(0, 1)
    del ww
    R = torch.stack(
        [*(1 - yy - zz, xy - wz, xz + wy), *(xy + wz, 1 - xx - zz, yz - wx), *(xz - wy, yz + wx, 1 - xx - yy)]
    )
    return R.unflatten(0, (3, 3)), unit, inverse_norm


def _rotation_backward(v_R: Tensor, unit: Tensor, inverse_norm: Tensor) -> Tensor:
    """Gradient [N, 4] of the quaternions from that of the matrices [3, 3, N]."""
    w, vector = unit[0], unit[1:]
    twice = v_R + v_R.transpose(0, 1)
    skew = torch.stack([v_R[2, 1] - v_R[1, 2], v_R[0, 2] - v_R[2, 0], v_R[1, 0] - v_R[0, 1]])
    trace = twice.diagonal().sum(-1)
    v_vector = 2 * ((twice * vector).sum(1) - trace * vector + w * skew)
    v_unit = torch.cat([2 * (vector * skew).sum(0, keepdim=True), v_vector])
    return ((v_unit - unit * (unit * v_unit).sum(0)) * inverse_norm).T


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product along the first dimension; torch's own is several times slower there."""
    (ax, ay, az), (bx, by, bz) = a, b
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
