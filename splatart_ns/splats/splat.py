"""The tensors of one set of Gaussians."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from splatart_ns.geometry.se3 import matrix_from_quat, quat_from_matrix, quat_multiply
from splatart_ns.geometry.spherical_harmonics import SH_C0, rotate_sh


@dataclass
class Splat:
    """N Gaussians. Quantities are stored as they are optimised; the properties give what they mean."""

    means: Tensor
    """Centres [N, 3], length."""
    quats: Tensor
    """Rotations [N, 4], wxyz, of any non-zero norm."""
    log_scales: Tensor
    """Logarithms of the standard deviations along the three axes [N, 3]."""
    opacity_logits: Tensor
    """Logits of the opacities [N]."""
    sh: Tensor
    """Spherical harmonics coefficients [N, (degree + 1)^2, 3], constant band first; colour is max(0, 0.5 + sum)."""
    part_logits: Tensor | None = None
    """Logits over background and parts [N, P + 1]; the column is the part id."""

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def scales(self) -> Tensor:
        """Standard deviations [N, 3], length."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """Opacities [N] in (0, 1)."""
        return self.opacity_logits.sigmoid()

    @property
    def base_colours(self) -> Tensor:
        """Colours [N, 3] in 0..1 without what depends on the view: the constant band's."""
        return (0.5 + SH_C0 * self.sh[:, 0]).clamp(0, 1)

    @property
    def sh_degree(self) -> int:
        return {1: 0, 4: 1, 9: 2, 16: 3}[self.sh.shape[1]]

    @property
    def part_probabilities(self) -> Tensor:
        """Probabilities over background and parts [N, P + 1]."""
        return self._logits().softmax(-1)

    @property
    def part_ids(self) -> Tensor:
        """The most likely part of each Gaussian [N], 0 for background."""
        return self._logits().argmax(-1)

    def ends(self, extent: float) -> Tensor:
        """Where Gaussians end [N, 4, 3]: `extent` standard deviations out, both ways along their two longest axes."""
        lengths, order = self.scales.sort(dim=-1, descending=True)
        axes = matrix_from_quat(self.quats).mT.gather(1, order[..., None].expand(-1, -1, 3))
        along = (extent * lengths[..., None] * axes)[:, :2]
        return torch.cat([self.means[:, None] + along, self.means[:, None] - along], 1)

    def _logits(self) -> Tensor:
        if self.part_logits is None:
            raise ValueError("this splat has no part logits")
        return self.part_logits

    def map(self, function) -> Splat:
        """Apply `function` to every tensor."""
        return replace(self, **{f.name: function(v) for f in fields(self) if (v := getattr(self, f.name)) is not None})

    def to(self, *args) -> Splat:
        return self.map(lambda t: t.to(*args))

    def detach(self) -> Splat:
        return self.map(lambda t: t.detach())

    def select(self, index: Tensor) -> Splat:
        """The Gaussians that a mask or an index tensor picks."""
        return self.map(lambda t: t[index])

    def transformed(self, T: Tensor) -> Splat:
        """Move by rigid transforms `T` ([4, 4] or one per Gaussian [N, 4, 4]); colours turn along."""
        T = T.to(self.means)
        R, t = T[..., :3, :3], T[..., :3, 3]
        return replace(
            self,
            means=(R @ self.means[..., None])[..., 0] + t,
            quats=quat_multiply(quat_from_matrix(R), self.quats),
            sh=rotate_sh(R, self.sh),
        )

    def scaled(self, factor: float) -> Splat:
        """Made larger about the origin."""
        return replace(self, means=factor * self.means, log_scales=self.log_scales + math.log(factor))

    @staticmethod
    def cat(splats: Sequence[Splat]) -> Splat:
        """All Gaussians of several splats with the same parts, at the highest of their SH degrees."""
        values = {}
        for f in fields(Splat):
            tensors = [getattr(s, f.name) for s in splats]
            if f.name == "sh":
                count = max(sh.shape[1] for sh in tensors)
                tensors = [sh if sh.shape[1] == count else F.pad(sh, (0, 0, 0, count - sh.shape[1])) for sh in tensors]
            values[f.name] = None if any(t is None for t in tensors) else torch.cat(tensors)
        return Splat(**values)
