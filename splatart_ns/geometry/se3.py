"""Rotations and rigid motions: exponentials, logarithms, quaternions (wxyz), adjoints.

Every function takes any batch shape and float32 or float64, and has finite values and gradients everywhere, at angle 0
and pi too. The maths of SO(3) is kornia's, and the tests hold it to a high-precision reference, because releases before
0.9 lose digits and gradients at both ends. kornia's Se3 is not used: it wraps a translation in a Parameter, so whatever
comes out of it asks for gradients.
"""

from __future__ import annotations

import numpy as np
import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix, rotation_matrix_to_quaternion
from kornia.geometry.liegroup import So3
from torch import Tensor


def so3_exp(phi: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of rotation vectors [..., 3], radians."""
    return So3.exp(phi).matrix()


def so3_log(R: Tensor) -> Tensor:
    """Rotation vectors [..., 3], no longer than pi, of rotation matrices [..., 3, 3]; at pi either of the two axes."""
    return So3.from_matrix(R).log()


def se3_exp(xi: Tensor) -> Tensor:
    """Rigid motions [..., 4, 4] of tangents (translation, rotation) [..., 6]."""
    rho, phi = xi[..., :3], xi[..., 3:]
    return from_rotation_translation(so3_exp(phi), (_left_jacobian(phi) @ rho[..., None])[..., 0])


def se3_log(T: Tensor) -> Tensor:
    """Tangents (translation, rotation) [..., 6] of rigid motions [..., 4, 4], the inverse of `se3_exp`."""
    phi = so3_log(T[..., :3, :3])
    return torch.cat([torch.linalg.solve(_left_jacobian(phi), T[..., :3, 3:])[..., 0], phi], -1)


def _left_jacobian(phi: Tensor) -> Tensor:
    """The matrices V [..., 3, 3] with which an exponential's translation is V rho; singular only at 2 pi."""
    return So3.left_jacobian(phi.reshape(-1, 3)).reshape(*phi.shape, 3)


def quat_from_matrix(R: Tensor) -> Tensor:
    """Unit quaternions [..., 4], wxyz with w >= 0, of rotation matrices [..., 3, 3]."""
    q = rotation_matrix_to_quaternion(R)
    return torch.where(q[..., :1] < 0, -q, q)


def matrix_from_quat(q: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4], wxyz, of any non-zero norm."""
    q = q / q.detach().abs().amax(-1, keepdim=True)  # so that squares neither overflow nor underflow
    return quaternion_to_rotation_matrix(q / torch.linalg.vector_norm(q, dim=-1, keepdim=True))


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton products [..., 4], wxyz; the batches broadcast. The rotation of a b applies b first."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def skew(v: Tensor) -> Tensor:
    """Cross product matrices [..., 3, 3] of vectors [..., 3]: skew(a) @ b = a x b."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))


def from_rotation_translation(R: Tensor, t: Tensor) -> Tensor:
    """Rigid motions [..., 4, 4] of rotations [..., 3, 3] and translations [..., 3]; the batches broadcast."""
    batch = np.broadcast_shapes(R.shape[:-2], t.shape[:-1])  # torch's own loads its compiler, for a second
    top = torch.cat([R.expand(*batch, 3, 3), t.expand(*batch, 3)[..., None]], -1)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0]).to(top).expand(*batch, 1, 4)
    return torch.cat([top, bottom], -2)


def translation(t: Tensor) -> Tensor:
    """Motions [..., 4, 4] that turn nothing, by t [..., 3]."""
    return from_rotation_translation(torch.eye(3).to(t), t)


def inverse(T: Tensor) -> Tensor:
    """Inverses of rigid motions [..., 4, 4]."""
    R_t = T[..., :3, :3].mT
    return from_rotation_translation(R_t, -(R_t @ T[..., :3, 3:])[..., 0])


def transform_points(T: Tensor, points: Tensor) -> Tensor:
    """Points [..., N, 3] moved by rigid motions [..., 4, 4]."""
    return points @ T[..., :3, :3].mT + T[..., None, :3, 3]


def adjoint(T: Tensor) -> Tensor:
    """Matrices [..., 6, 6] with T se3_exp(xi) T^-1 = se3_exp(adjoint(T) xi), tangents (translation, rotation)."""
    R = T[..., :3, :3]
    top = torch.cat([R, skew(T[..., :3, 3]) @ R], -1)
    return torch.cat([top, torch.cat([torch.zeros_like(R), R], -1)], -2)
