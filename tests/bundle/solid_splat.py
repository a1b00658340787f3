"""Gaussians on the surface of a solid."""

import math

import numpy as np
import torch
import trimesh

from splatart_ns.geometry.se3 import quat_from_matrix
from splatart_ns.splats.splat import Splat


def splat_on(
    mesh: trimesh.Trimesh, n: int = 3000, opacity: float = 0.7, thickness: float | None = None, inwards: float = 2.0
) -> Splat:
    """Flat Gaussians on a mesh; colour is green where x > 0, else red.

    By default a tenth as thick as wide. Their middles lie so many thicknesses below the surface; fits leave them at 1.5
    to 2.4 (docs/export.md).
    """
    points, face = trimesh.sample.sample_surface(mesh, n, seed=0)
    z = mesh.face_normals[face]
    x = np.cross(z, np.where(np.abs(z[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    sigma = math.sqrt(mesh.area / n)
    thickness = thickness or 0.1 * sigma
    rgb = np.where(points[:, :1] > 0, [[0.0, 1, 0]], [[1.0, 0, 0]])
    return Splat(
        means=torch.from_numpy(points - inwards * thickness * z).float(),
        quats=quat_from_matrix(torch.from_numpy(np.stack([x, np.cross(z, x), z], -1))).float(),
        log_scales=torch.tensor([sigma, sigma, thickness]).log().repeat(n, 1),
        opacity_logits=torch.full((n,), math.log(opacity / (1 - opacity))),
        sh=torch.from_numpy((rgb - 0.5) * 2 * math.sqrt(math.pi)).float()[:, None],
    )
