"""What lies within all silhouettes of a part, and which surfaces are outer ones, at its border."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage
from torch import Tensor

_OUTER = 0.06
"""How deep within all silhouettes a surface is wholly an outer one, where the part's radius is 1; at twice this it is
none. The insides of hollows lie right, or too far out."""
_FACING = 4.0
"""An outer surface is wholly seen as one from directions within 76 degrees of its normal: the cosine times this."""


@dataclass(frozen=True)
class Outside:
    """Where N points lie to the nearest place at which all silhouettes end."""

    nearness: Tensor
    """1 near it down to 0 deep inside [N]."""
    direction: Tensor
    """Towards it [N, 3], unit vectors."""

    def share(self, towards: Tensor) -> Tensor:
        """To what share [N], 0 to 1, a surface that is seen from the directions `towards` [N, 3] is an outer one."""
        return self.nearness * (_FACING * (self.direction * towards).sum(-1)).clamp(0, 1)


@dataclass(frozen=True)
class Hull:
    """What lies within all silhouettes: a grid of signed distances to its border."""

    origin: np.ndarray
    spacing: float
    depths: np.ndarray
    """How deep inside nodes are [I, J, K], in the unit of points, negative outside."""

    @classmethod
    def of(cls, inside: np.ndarray, origin: np.ndarray, spacing: float) -> Hull:
        """Of whether the nodes [I, J, K] bool of a grid lie inside; the first is at `origin` [3]."""
        inside = np.pad(inside, 1)
        depths = ndimage.distance_transform_edt(inside) - ndimage.distance_transform_edt(~inside)
        smooth = ndimage.gaussian_filter(depths[1:-1, 1:-1, 1:-1].astype(np.float32), 1.0)
        return cls(origin, spacing, spacing * smooth)

    def outside(self, points: Tensor) -> Outside:
        """For points [N, 3]."""
        at = ((points.numpy() - self.origin) / self.spacing).T
        depth, *inwards = (
            torch.from_numpy(ndimage.map_coordinates(x, at, order=1, mode="nearest"))
            for x in (self.depths, *np.gradient(self.depths))
        )
        return Outside((2 - depth / _OUTER).clamp(0, 1), -F.normalize(torch.stack(inwards, -1), dim=-1))
