"""Real spherical harmonics up to degree 3, with the signs of 3D Gaussian splatting, and their rotation."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from splatart_ns.geometry.directions import golden_spiral

SH_C0 = 0.5 / math.sqrt(math.pi)
"""The constant band; a colour is 0.5 + SH_C0 x its coefficient."""
_C1 = math.sqrt(3 / (4 * math.pi))
_C2 = math.sqrt(15 / (4 * math.pi))
_C3 = (math.sqrt(35 / (32 * math.pi)), math.sqrt(105 / (4 * math.pi)), math.sqrt(21 / (32 * math.pi)))


def sh_basis(dirs: Tensor, degree: int) -> Tensor:
    """Values [..., (degree + 1)^2] of the basis at unit directions [..., 3].

    Order and signs are those of the 3DGS PLY format (INRIA, gsplat): bands one after another, odd orders negated.
    """
    if not 0 <= degree <= 3:
        raise ValueError(f"spherical harmonics of degree {degree}: only 0 to 3 are supported")
    return torch.cat([_band(dirs, order) for order in range(degree + 1)]).movedim(0, -1)


def _band(dirs: Tensor, order: int) -> Tensor:
    """Values [2 order + 1, ...] of one band: stacking in front is several times faster."""
    x, y, z = dirs.unbind(-1)
    if order == 0:
        values = [torch.full_like(x, SH_C0)]
    elif order == 1:
        values = [-_C1 * y, _C1 * z, -_C1 * x]
    elif order == 2:
        values = [
            _C2 * x * y,
            -_C2 * y * z,
            _C2 / math.sqrt(12) * (2 * z * z - x * x - y * y),
            -_C2 * x * z,
            _C2 / 2 * (x * x - y * y),
        ]
    else:
        a, b, c = _C3
        values = [
            -a * y * (3 * x * x - y * y),
            b * x * y * z,
            -c * y * (4 * z * z - x * x - y * y),
            b / math.sqrt(60) * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -c * x * (4 * z * z - x * x - y * y),
            b / 2 * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return torch.stack(values)


# Band 3 has 7 functions; a few more directions make the system well conditioned. They are on half a sphere: opposite
# ones would add no information about a band.
_DIRECTIONS = golden_spiral((torch.arange(10, dtype=torch.float64) + 0.5) / 10)
_FROM_VALUES = [torch.linalg.pinv(_band(_DIRECTIONS, order).T) for order in range(4)]


def rotate_sh(R: Tensor, sh: Tensor) -> Tensor:
    """Coefficients [N, K, C] of colours that turn with their Gaussians, K = (degree + 1)^2.

    `R` is one rotation [3, 3] or one per Gaussian [N, 3, 3]. A band is closed under rotation, so its new coefficients
    follow exactly from its values at a few directions: basis(R d) . rotate_sh(R, c) = basis(d) . c for every d.
    """
    bands = [sh[..., :1, :]]
    dirs = _DIRECTIONS.to(R) @ R  # rows are R^T d
    for order in range(1, math.isqrt(sh.shape[-2])):
        turned = (_FROM_VALUES[order].to(R) @ _band(dirs, order).movedim(0, -1)).to(sh)
        bands.append(turned @ sh[..., order**2 : (order + 1) ** 2, :])
    return torch.cat(bands, -2)
