"""Screws: every rigid motion is a turn about a line and a slide along it (Chasles)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from splatart_ns.geometry.se3 import from_rotation_translation, so3_exp, so3_log


@dataclass(frozen=True)
class Screw:
    """Turns about lines and slides along them, any batch shape."""

    axis: Tensor
    """Unit directions [..., 3]."""
    point: Tensor
    """Points on the lines [..., 3]."""
    angle: Tensor
    """Turns [...] about the axes, radians."""
    slide: Tensor
    """Translations [...] along the axes, length."""

    def motion(self) -> Tensor:
        """The rigid motions [..., 4, 4]."""
        angle = self.angle[..., None]
        # (1 - R) point by Rodrigues' formula: the line of a small turn is far away, and point - R point would cancel.
        once = torch.linalg.cross(self.axis, self.point)
        twice = torch.linalg.cross(self.axis, once)
        t = self.slide[..., None] * self.axis - angle.sin() * once - 2 * (angle / 2).sin().square() * twice
        return from_rotation_translation(so3_exp(angle * self.axis), t)


def screw_from_motion(T: Tensor, reference: Tensor) -> Screw:
    """The screws of rigid motions [..., 4, 4], the points those nearest to `reference` [..., 3]; angles in [0, pi].

    A motion whose angle is lost in rounding is a slide along its translation, through the reference; the identity is
    a slide of length 0 along z. The line of a small turn is as uncertain as the rotation: an angle of 1e-6 in float64
    leaves ten digits of it, an angle of 1e-4 in float32 three.
    """
    R, t = T[..., :3, :3], T[..., :3, 3]
    reference = reference.expand_as(t)
    phi = so3_log(R)
    moved = t + (R @ reference[..., None])[..., 0] - reference
    tiny = torch.finfo(T.dtype).eps ** 0.75
    phi2, moved2 = (phi * phi).sum(-1), (moved * moved).sum(-1)
    turns, slides = phi2 > tiny**2, moved2 > 0

    angle = torch.where(turns, phi2, 1.0).sqrt()
    length = torch.where(slides, moved2, 1.0).sqrt()
    up = torch.tensor([0.0, 0.0, 1.0]).to(t)
    direction = torch.where(slides[..., None], moved / length[..., None], up)
    axis = torch.where(turns[..., None], phi / angle[..., None], direction)

    slide = (axis * moved).sum(-1)
    across = moved - slide[..., None] * axis
    # In the plane across the axis the displacement is (R - 1) u, u from the line to the reference; this inverts it.
    half_cot = torch.where(turns, 0.5 * (angle / 2).cos() / (angle / 2).sin(), 0.0)
    offset = across / 2 + half_cot[..., None] * torch.linalg.cross(axis, across)
    point = reference + torch.where(turns[..., None], offset, 0.0)
    return Screw(axis, point, torch.where(turns, angle, 0.0), slide)
