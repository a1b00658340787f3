"""Turns that may leave a part looking as it did, by how what its Gaussians cover lies about its principal axes."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from splatart_ns.geometry.se3 import matrix_from_quat, so3_exp
from splatart_ns.splats.splat import Splat

SIMILAR_MOMENTS = 0.7
"""Round parts, and square ones, have two principal moments whose ratio is above this."""
STEP = 15
"""Degrees between the turns about an axis across which they are similar: quarter, sixth and eighth turns are such."""
LEAST = 45
"""Least of these; from smaller ones refining finds the way back."""
OVER_STEP = 5
"""Degrees between the axes across it about which it is turned over, as these are not those of its edges."""


def similar_axes(splat: Splat) -> Tensor:
    """The principal axes [K, 3] float64 of a part about which it may be round: the moments across them are similar."""
    axes, similar = _principal_axes(splat)
    return axes[similar]


def symmetric_turns(splat: Splat) -> Tensor:
    """Rotations [K, 3, 3] float64 of a part about its centroid under which it may look alike.

    Half turns about its principal axes; if the moments across one are similar, any turns about that one, of the part as
    it is and turned over.
    """
    axes, similar = _principal_axes(splat)
    turns = [math.pi * axes]
    for k in similar.nonzero()[:, 0].tolist():
        around = torch.arange(LEAST, 360 - LEAST + 1, STEP).to(axes).deg2rad()
        over = torch.arange(0, 180, OVER_STEP).to(axes).deg2rad()[:, None]
        turns += [around[:, None] * axes[k], math.pi * (over.cos() * axes[k - 1] + over.sin() * axes[k - 2])]
    return so3_exp(torch.cat(turns))


def _principal_axes(splat: Splat) -> tuple[Tensor, Tensor]:
    """Unit axes [3, 3] float64, a row each, and across which the moments are similar [3]; none of a single Gaussian."""
    x, weight = splat.means.double(), splat.opacities.double()
    if len(x) < 2:
        return x[:0], torch.zeros(0, dtype=torch.bool, device=x.device)
    x = x - weight @ x / weight.sum()
    # The centres alone tell little of a rod that is a few pixels thick: half of its thickness is the Gaussians' own.
    extents = matrix_from_quat(splat.quats.double()) * splat.scales.double()[:, None]
    spread = x[:, :, None] * x[:, None] + extents @ extents.mT
    moments, axes = torch.linalg.eigh((weight[:, None, None] * spread).sum(0) / weight.sum())
    across = torch.stack([moments[[1, 2]], moments[[0, 2]], moments[[0, 1]]])
    return axes.mT, across[:, 0] > SIMILAR_MOMENTS * across[:, 1]
