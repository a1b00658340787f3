"""Colours from spherical harmonics and their gradient in one pass each, compiled by numba."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatart_ns.rasterize.numba_runtime import even_bounds, jit, run
from splatart_ns.threads import num_threads

_C0 = np.float32(0.5 / math.sqrt(math.pi))
_C1 = np.float32(math.sqrt(3 / (4 * math.pi)))
_C2, _C20, _C22 = (np.float32(math.sqrt(15 / (4 * math.pi)) / d) for d in (1, math.sqrt(12), 2))
_C33, _C31 = (np.float32(math.sqrt(c / (32 * math.pi))) for c in (35, 21))
_C32, _C30, _C322 = (np.float32(math.sqrt(105 / (4 * math.pi)) / d) for d in (1, math.sqrt(60), 2))
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_TWO, _THREE, _FOUR, _SIX, _EIGHT = np.float32(2), np.float32(3), np.float32(4), np.float32(6), np.float32(8)


def sh_colors(means: Tensor, sh: Tensor, viewmats: Tensor, degree: int) -> Tensor:
    """As `rasterization.sh_colors`, for float32 on the CPU."""
    R, t = viewmats[:, :3, :3], viewmats[:, :3, 3:]
    return _Colors.apply(means, sh, -(R.mT @ t)[..., 0], degree)


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, sh, centers, degree):
        C, N = len(centers), len(means)
        arrays = [t.detach().contiguous().numpy() for t in (means, sh if sh.ndim == 4 else sh[None], centers)]
        colors = np.empty((C, N, 3), np.float32)
        run(_colors, even_bounds(N, num_threads()), *arrays, degree, colors)
        ctx.state = arrays, colors, degree, sh.shape
        return torch.from_numpy(colors)

    @staticmethod
    @once_differentiable
    def backward(ctx, v_colors):
        (means, sh, centers), colors, degree, shape = ctx.state
        need_means, need_sh, need_centers, _ = ctx.needs_input_grad
        v_offsets = np.empty((len(centers) if need_means or need_centers else 0, *means.shape), np.float32)
        v_sh = np.empty(sh.shape if need_sh else (0, 0, 0, 0), np.float32)
        bounds = even_bounds(len(means), num_threads())
        run(
            _colors_backward, bounds, means, sh, centers, degree, colors, v_colors.contiguous().numpy(), v_offsets, v_sh
        )
        v_offsets = torch.from_numpy(v_offsets)
        return (
            v_offsets.sum(0) if need_means else None,
            torch.from_numpy(v_sh).view(shape) if need_sh else None,
            -v_offsets.sum(1) if need_centers else None,
            None,
        )


@jit
def _direction(means, centers, c, n):
    """Unit vector from a camera to a Gaussian, and one over their distance, 0 where they coincide."""
    x, y, z = means[n, 0] - centers[c, 0], means[n, 1] - centers[c, 1], means[n, 2] - centers[c, 2]
    # In float64, so that squares neither overflow nor underflow.
    distance = math.sqrt(np.float64(x) * x + np.float64(y) * y + np.float64(z) * z)
    inverse = np.float32(1.0 / distance) if distance > 1e-12 else _ZERO
    return x * inverse, y * inverse, z * inverse, inverse


@jit
def _fill_basis(x, y, z, degree, basis):
    """The values of `geometry.spherical_harmonics.sh_basis`."""
    basis[0] = _C0
    if degree > 0:
        basis[1] = -_C1 * y
        basis[2] = _C1 * z
        basis[3] = -_C1 * x
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        basis[4] = _C2 * x * y
        basis[5] = -_C2 * y * z
        basis[6] = _C20 * (_TWO * zz - xx - yy)
        basis[7] = -_C2 * x * z
        basis[8] = _C22 * (xx - yy)
        if degree > 2:
            basis[9] = -_C33 * y * (_THREE * xx - yy)
            basis[10] = _C32 * x * y * z
            basis[11] = -_C31 * y * (_FOUR * zz - xx - yy)
            basis[12] = _C30 * z * (_TWO * zz - _THREE * xx - _THREE * yy)
            basis[13] = -_C31 * x * (_FOUR * zz - xx - yy)
            basis[14] = _C322 * z * (xx - yy)
            basis[15] = -_C33 * x * (xx - _THREE * yy)


@jit
def _basis_backward(x, y, z, degree, v):
    """Gradient by the direction of the sum of v times the basis."""
    if degree == 0:
        return _ZERO, _ZERO, _ZERO
    vx, vy, vz = -_C1 * v[3], -_C1 * v[1], _C1 * v[2]
    if degree > 1:
        a, b, c, d, e = _C2 * v[4], -_C2 * v[5], _C20 * v[6], -_C2 * v[7], _C22 * v[8]
        vx += a * y + d * z + _TWO * x * (e - c)
        vy += a * x + b * z - _TWO * y * (e + c)
        vz += b * y + d * x + _FOUR * c * z
    if degree > 2:
        xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
        a, b, c, d = -_C33 * v[9], _C32 * v[10], -_C31 * v[11], _C30 * v[12]
        e, f, g = -_C31 * v[13], _C322 * v[14], -_C33 * v[15]
        four = _FOUR * zz - xx - yy
        vx += _SIX * a * xy + b * yz - _TWO * c * xy - _SIX * d * xz + e * (four - _TWO * xx) + _TWO * f * xz
        vx += _THREE * g * (xx - yy)
        vy += _THREE * a * (xx - yy) + b * xz + c * (four - _TWO * yy) - _SIX * d * yz - _TWO * e * xy - _TWO * f * yz
        vy -= _SIX * g * xy
        vz += b * xy + _EIGHT * c * yz + _THREE * d * (_TWO * zz - xx - yy) + _EIGHT * e * xz + f * (xx - yy)
    return vx, vy, vz


@jit
def _colors(begin, end, worker, means, sh, centers, degree, colors):
    K = (degree + 1) ** 2
    basis = np.empty(16, np.float32)
    for c in range(centers.shape[0]):
        coefficients = sh[min(c, sh.shape[0] - 1)]
        for n in range(begin, end):
            x, y, z, _ = _direction(means, centers, c, n)
            _fill_basis(x, y, z, degree, basis)
            red, green, blue = _HALF, _HALF, _HALF
            for k in range(K):
                red += basis[k] * coefficients[n, k, 0]
                green += basis[k] * coefficients[n, k, 1]
                blue += basis[k] * coefficients[n, k, 2]
            colors[c, n, 0] = max(red, _ZERO)
            colors[c, n, 1] = max(green, _ZERO)
            colors[c, n, 2] = max(blue, _ZERO)


@jit
def _colors_backward(begin, end, worker, means, sh, centers, degree, colors, v_colors, v_offsets, v_sh):
    """Fills v_offsets [C, N, 3], the gradients by the positions before each camera, and v_sh, unless empty."""
    K = (degree + 1) ** 2
    basis, v_basis = np.empty(16, np.float32), np.empty(16, np.float32)
    if v_sh.shape[1] > 0:
        v_sh[:, begin:end] = _ZERO
    for c in range(centers.shape[0]):
        share = min(c, sh.shape[0] - 1)
        for n in range(begin, end):
            red = v_colors[c, n, 0] if colors[c, n, 0] > _ZERO else _ZERO
            green = v_colors[c, n, 1] if colors[c, n, 1] > _ZERO else _ZERO
            blue = v_colors[c, n, 2] if colors[c, n, 2] > _ZERO else _ZERO
            if red == _ZERO and green == _ZERO and blue == _ZERO:
                if v_offsets.shape[0] > 0:
                    v_offsets[c, n] = _ZERO
                continue
            x, y, z, inverse = _direction(means, centers, c, n)
            if v_sh.shape[1] > 0:
                _fill_basis(x, y, z, degree, basis)
                for k in range(K):
                    v_sh[share, n, k, 0] += basis[k] * red
                    v_sh[share, n, k, 1] += basis[k] * green
                    v_sh[share, n, k, 2] += basis[k] * blue
            if v_offsets.shape[0] > 0:
                for k in range(K):
                    v_basis[k] = sh[share, n, k, 0] * red + sh[share, n, k, 1] * green + sh[share, n, k, 2] * blue
                vx, vy, vz = _basis_backward(x, y, z, degree, v_basis)
                along = x * vx + y * vy + z * vz
                v_offsets[c, n, 0] = (vx - x * along) * inverse
                v_offsets[c, n, 1] = (vy - y * along) * inverse
                v_offsets[c, n, 2] = (vz - z * along) * inverse
