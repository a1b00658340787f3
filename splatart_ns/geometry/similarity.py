"""Similarities as matrices T = [[s R, t], [0, 1]]: rigid motions with a scale s > 0."""

from __future__ import annotations

import torch
from torch import Tensor


def similarity(scale: Tensor | float, R: Tensor, t: Tensor) -> Tensor:
    """The matrix [4, 4] of x -> scale R x + t, float64."""
    T = torch.eye(4, dtype=torch.float64, device=R.device)
    T[:3, :3], T[:3, 3] = scale * R.double(), t.double()
    return T


def scale_of(T: Tensor) -> Tensor:
    """The scales [...] of similarities [..., 4, 4]."""
    return torch.linalg.vector_norm(T[..., :3, :3], dim=-2).mean(-1)


def rigid_of(T: Tensor) -> Tensor:
    """The rigid motions [..., 4, 4] that similarities do after scaling about the origin: T = rigid_of(T) @ scale."""
    out = T.clone()
    out[..., :3, :3] /= scale_of(T)[..., None, None]
    return out


def inverse_similarity(T: Tensor) -> Tensor:
    """Inverses of similarities [..., 4, 4]."""
    R_t = T[..., :3, :3].mT / scale_of(T)[..., None, None].square()
    out = T.clone()
    out[..., :3, :3], out[..., :3, 3:] = R_t, -R_t @ T[..., :3, 3:]
    return out


def view_of_moved(viewmat: Tensor, T: Tensor) -> Tensor:
    """World-to-camera matrices [..., 4, 4] that see the world as `viewmat` sees it after the similarities T.

    A camera sees no scale: it stands so much nearer, or farther, instead.
    """
    out = viewmat @ T
    out[..., :3, :] /= scale_of(T)[..., None, None]
    return out
