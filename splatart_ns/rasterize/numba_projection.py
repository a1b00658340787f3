"""Projection of Gaussians and its gradient, one pass each, compiled by numba; the formulas of `projection.project`.

Inside, everything is float64: that costs nothing here, and no scale, distance or needle that float32 can express
overflows or cancels. The gradients of the cameras are summed block by block, in an order that threads do not change.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatart_ns.rasterize.numba_runtime import even_bounds, jit, run
from splatart_ns.rasterize.projection import LARGEST_RADIUS, LEAST_QUATERNION, Projection
from splatart_ns.threads import num_threads

_BLOCK = 256
"""Gaussians whose gradients by the cameras are summed together."""


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
    """As `projection.project`, for float32 on the CPU."""
    settings = (eps2d, near_plane, far_plane, radius_clip, float(width), float(height))
    return Projection(*_Project.apply(means, quats, scales, viewmats, Ks, settings))


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, scales, viewmats, Ks, settings):
        C, N = len(viewmats), len(means)
        means_, quats_, scales_ = (t.detach().contiguous().numpy() for t in (means, quats, scales))
        cameras = _cameras(viewmats.detach().numpy(), Ks.detach().numpy(), *settings[-2:])
        radii = np.empty((C, N), np.int32)
        means2d, depths = np.empty((C, N, 2), np.float32), np.empty((C, N), np.float32)
        conics, compensations = np.empty((C, N, 3), np.float32), np.empty((C, N), np.float32)
        results = radii, means2d, depths, conics, compensations
        run(_project, even_bounds(N, num_threads()), means_, quats_, scales_, cameras, settings, *results)
        ctx.state = means_, quats_, scales_, cameras, settings
        radii, *results = (torch.from_numpy(result) for result in results)
        ctx.mark_non_differentiable(radii)
        return radii, *results

    @staticmethod
    @once_differentiable
    def backward(ctx, _, v_means2d, v_depths, v_conics, v_compensations):
        means, quats, scales, cameras, settings = ctx.state
        C, N = len(cameras), len(means)
        incoming = [t.contiguous().numpy() for t in (v_means2d, v_depths, v_conics, v_compensations)]
        v_means, v_quats, v_scales = (np.empty_like(a) for a in (means, quats, scales))
        blocks = -(-N // _BLOCK)
        v_cameras = np.zeros((blocks, C, 12))
        run(
            _project_backward,
            even_bounds(blocks, num_threads()),
            *(means, quats, scales, cameras, settings),
            *incoming,
            *(v_means, v_quats, v_scales, v_cameras),
        )
        v_viewmats = np.zeros((C, 4, 4), np.float32)
        v_viewmats[:, :3, :3] = v_cameras[..., :9].sum(0).reshape(C, 3, 3)
        v_viewmats[:, :3, 3] = v_cameras[..., 9:].sum(0)
        gradients = (torch.from_numpy(v) for v in (v_means, v_quats, v_scales, v_viewmats))
        return *(v if need else None for v, need in zip(gradients, ctx.needs_input_grad[:4], strict=True)), None, None


def _cameras(viewmats: np.ndarray, Ks: np.ndarray, width: float, height: float) -> np.ndarray:
    """Rows [C, 20], float64: rotation (9), translation (3), focal lengths, principal point, bounds of x / z and y / z.

    The bounds are those of the slope in the derivative, 0.15 of the image's size outside it.
    """
    cameras = np.empty((len(viewmats), 20))
    cameras[:, :9] = viewmats[:, :3, :3].reshape(-1, 9)
    cameras[:, 9:12] = viewmats[:, :3, 3]
    cameras[:, 12:14] = focal = np.stack([Ks[:, 0, 0], Ks[:, 1, 1]], -1)
    cameras[:, 14:16] = principal = Ks[:, :2, 2]
    size = np.array([width, height])
    cameras[:, 16:18] = (-0.15 * size - principal) / focal
    cameras[:, 18:20] = (1.15 * size - principal) / focal
    return cameras


@jit
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@jit
def _mix(a, x, b, y):
    """a x + b y for vectors x and y."""
    return a * x[0] + b * y[0], a * x[1] + b * y[1], a * x[2] + b * y[2]


@jit
def _rotation(quats, n):
    """Rows of the rotation matrix, the unit quaternion, and one over the norm, 0 for a zero quaternion."""
    w, x, y, z = np.float64(quats[n, 0]), np.float64(quats[n, 1]), np.float64(quats[n, 2]), np.float64(quats[n, 3])
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    inverse = 1.0 / norm if norm > LEAST_QUATERNION else 0.0
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    r0 = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    r1 = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    r2 = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
    return (r0, r1, r2), (w, x, y, z), inverse


@jit
def _view(camera, mean, axes, settings):
    """One Gaussian before one camera.

    Returns whether its depth is in range, the depth, its inverse (1 when out of range), the slopes x / z and y / z,
    the limited slopes, the rows of J W and those of J W R S; `axes` are the rows of R S.
    """
    w0, w1, w2 = (camera[0], camera[1], camera[2]), (camera[3], camera[4], camera[5]), (camera[6], camera[7], camera[8])
    depth = _dot(w2, mean) + camera[11]
    in_range = settings[1] < depth < settings[2]
    inverse = 1.0 / depth if in_range else 1.0
    slope_x, slope_y = (_dot(w0, mean) + camera[9]) * inverse, (_dot(w1, mean) + camera[10]) * inverse
    limited_x = min(max(slope_x, camera[16]), camera[18])
    limited_y = min(max(slope_y, camera[17]), camera[19])
    scale_x, scale_y = camera[12] * inverse, camera[13] * inverse
    jx, jy = _mix(scale_x, w0, -scale_x * limited_x, w2), _mix(scale_y, w1, -scale_y * limited_y, w2)
    p = _mix(1.0, _mix(jx[0], axes[0], jx[1], axes[1]), jx[2], axes[2])
    q = _mix(1.0, _mix(jy[0], axes[0], jy[1], axes[1]), jy[2], axes[2])
    return in_range, depth, inverse, (slope_x, slope_y), (limited_x, limited_y), (jx, jy), (p, q)


@jit
def _project(
    begin, end, worker, means, quats, scales, cameras, settings, radii, means2d, depths, conics, compensations
):
    eps, radius_clip, width, height = settings[0], settings[3], settings[4], settings[5]
    for n in range(begin, end):
        mean = np.float64(means[n, 0]), np.float64(means[n, 1]), np.float64(means[n, 2])
        s0, s1, s2 = np.float64(scales[n, 0]), np.float64(scales[n, 1]), np.float64(scales[n, 2])
        rows, _, _ = _rotation(quats, n)
        r0, r1, r2 = rows
        axes = (
            (r0[0] * s0, r0[1] * s1, r0[2] * s2),
            (r1[0] * s0, r1[1] * s1, r1[2] * s2),
            (r2[0] * s0, r2[1] * s1, r2[2] * s2),
        )
        for c in range(cameras.shape[0]):
            camera = cameras[c]
            in_range, depth, _, slope, _, _, pq = _view(camera, mean, axes, settings)
            p, q = pq
            x, y = camera[12] * slope[0] + camera[14], camera[13] * slope[1] + camera[15]
            pp, qq, normal = _dot(p, p), _dot(q, q), _cross(p, q)
            sharp = _dot(normal, normal)
            inverse_det = 1.0 / (sharp + eps * (pp + qq) + eps * eps)
            half_trace = 0.5 * (pp + qq) + eps
            largest = half_trace + math.sqrt(max(half_trace * half_trace - 1.0 / inverse_det, 0.01))
            radius = min(np.ceil(3.0 * math.sqrt(largest)), LARGEST_RADIUS)
            inside = x + radius > 0.0 and x - radius < width and y + radius > 0.0 and y - radius < height
            radii[c, n] = np.int32(radius) if in_range and inside and radius > radius_clip else np.int32(0)
            means2d[c, n, 0] = x
            means2d[c, n, 1] = y
            depths[c, n] = depth
            conics[c, n, 0] = (qq + eps) * inverse_det
            conics[c, n, 1] = -_dot(p, q) * inverse_det
            conics[c, n, 2] = (pp + eps) * inverse_det
            compensations[c, n] = math.sqrt(sharp * inverse_det)


@jit
def _project_backward(
    begin,
    end,
    worker,
    means,
    quats,
    scales,
    cameras,
    settings,
    v_means2d,
    v_depths,
    v_conics,
    v_compensations,
    v_means,
    v_quats,
    v_scales,
    v_cameras,
):
    """Fills the gradients of the blocks begin..end of Gaussians, and v_cameras [blocks, C, 12] (rotation, translation).

    With det = sharp + eps (pp + qq) + eps^2, conics = (qq + eps, -pq, pp + eps) / det, compensation^2 = sharp / det.
    """
    eps = settings[0]
    zero = (0.0, 0.0, 0.0)
    for n in range(begin * _BLOCK, min(end * _BLOCK, means.shape[0])):
        mean = np.float64(means[n, 0]), np.float64(means[n, 1]), np.float64(means[n, 2])
        s0, s1, s2 = np.float64(scales[n, 0]), np.float64(scales[n, 1]), np.float64(scales[n, 2])
        (r0, r1, r2), unit, inverse_norm = _rotation(quats, n)
        axes = (
            (r0[0] * s0, r0[1] * s1, r0[2] * s2),
            (r1[0] * s0, r1[1] * s1, r1[2] * s2),
            (r2[0] * s0, r2[1] * s1, r2[2] * s2),
        )
        v_mean, v_axes0, v_axes1, v_axes2 = zero, zero, zero, zero
        for c in range(cameras.shape[0]):
            v_x, v_y = np.float64(v_means2d[c, n, 0]), np.float64(v_means2d[c, n, 1])
            v_a, v_b = np.float64(v_conics[c, n, 0]), np.float64(v_conics[c, n, 1])
            v_c, v_z = np.float64(v_conics[c, n, 2]), np.float64(v_depths[c, n])
            v_compensation = np.float64(v_compensations[c, n])
            if v_x == 0 and v_y == 0 and v_a == 0 and v_b == 0 and v_c == 0 and v_z == 0 and v_compensation == 0:
                continue  # culled or hidden
            camera = cameras[c]
            in_range, _, inverse, slope, limited, jacobian, pq = _view(camera, mean, axes, settings)
            jx, jy = jacobian
            p, q = pq
            pp, qq, normal = _dot(p, p), _dot(q, q), _cross(p, q)
            sharp = _dot(normal, normal)
            inverse_det = 1.0 / (sharp + eps * (pp + qq) + eps * eps)
            v_log = 0.5 * v_compensation * math.sqrt(sharp * inverse_det)
            v_det = -((v_a * (qq + eps) - v_b * _dot(p, q) + v_c * (pp + eps)) * inverse_det + v_log) * inverse_det
            v_sharp = v_det + (v_log / sharp if sharp > 0.0 else 0.0)
            v_pq = -v_b * inverse_det
            v_pp, v_qq = v_c * inverse_det + eps * v_det, v_a * inverse_det + eps * v_det
            v_p = _mix(1.0, _mix(2.0 * v_pp, p, v_pq, q), 2.0 * v_sharp, _cross(q, normal))
            v_q = _mix(1.0, _mix(2.0 * v_qq, q, v_pq, p), 2.0 * v_sharp, _cross(normal, p))

            v_axes0 = _mix(1.0, v_axes0, 1.0, _mix(jx[0], v_p, jy[0], v_q))
            v_axes1 = _mix(1.0, v_axes1, 1.0, _mix(jx[1], v_p, jy[1], v_q))
            v_axes2 = _mix(1.0, v_axes2, 1.0, _mix(jx[2], v_p, jy[2], v_q))
            v_jx = _dot(axes[0], v_p), _dot(axes[1], v_p), _dot(axes[2], v_p)
            v_jy = _dot(axes[0], v_q), _dot(axes[1], v_q), _dot(axes[2], v_q)
            w0, w1 = (camera[0], camera[1], camera[2]), (camera[3], camera[4], camera[5])
            w2 = camera[6], camera[7], camera[8]
            scale_x, scale_y = camera[12] * inverse, camera[13] * inverse
            v_slope_x, v_slope_y = camera[12] * v_x, camera[13] * v_y
            if slope[0] == limited[0]:
                v_slope_x -= scale_x * _dot(v_jx, w2)
            if slope[1] == limited[1]:
                v_slope_y -= scale_y * _dot(v_jy, w2)
            if in_range:
                v_inverse = v_slope_x * slope[0] + v_slope_y * slope[1] + _dot(v_jx, jx) + _dot(v_jy, jy)
                v_z -= v_inverse * inverse
            v_local = v_slope_x * inverse, v_slope_y * inverse, v_z
            v_mean = _mix(1.0, v_mean, 1.0, _mix(1.0, _mix(v_local[0], w0, v_local[1], w1), v_local[2], w2))
            v_w2 = _mix(-limited[0] * scale_x, v_jx, -limited[1] * scale_y, v_jy)
            v_camera = v_cameras[n // _BLOCK, c]
            for i in range(3):
                v_camera[i] += v_local[0] * mean[i] + scale_x * v_jx[i]
                v_camera[3 + i] += v_local[1] * mean[i] + scale_y * v_jy[i]
                v_camera[6 + i] += v_local[2] * mean[i] + v_w2[i]
                v_camera[9 + i] += v_local[i]

        for i in range(3):
            v_means[n, i] = v_mean[i]
            v_scales[n, i] = v_axes0[i] * r0[i] + v_axes1[i] * r1[i] + v_axes2[i] * r2[i]
        v00, v01, v02 = v_axes0[0] * s0, v_axes0[1] * s1, v_axes0[2] * s2
        v10, v11, v12 = v_axes1[0] * s0, v_axes1[1] * s1, v_axes1[2] * s2
        v20, v21, v22 = v_axes2[0] * s0, v_axes2[1] * s1, v_axes2[2] * s2
        w, x, y, z = unit
        v_unit = (
            2.0 * (x * (v21 - v12) + y * (v02 - v20) + z * (v10 - v01)),
            2.0 * (y * (v01 + v10) + z * (v02 + v20) + w * (v21 - v12)) - 4.0 * x * (v11 + v22),
            2.0 * (x * (v01 + v10) + z * (v12 + v21) + w * (v02 - v20)) - 4.0 * y * (v00 + v22),
            2.0 * (x * (v02 + v20) + y * (v12 + v21) + w * (v10 - v01)) - 4.0 * z * (v00 + v11),
        )
        along = w * v_unit[0] + x * v_unit[1] + y * v_unit[2] + z * v_unit[3]
        for i in range(4):
            v_quats[n, i] = (v_unit[i] - unit[i] * along) * inverse_norm
