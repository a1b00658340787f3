"""A bundle as browsers see it: images from where they look."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from splatart_ns.bundle.animation import bundle_colours
from splatart_ns.bundle.articulated_splat import ArticulatedSplat
from splatart_ns.bundle.camera import Camera
from splatart_ns.bundle.posing import JointValue
from splatart_ns.capture.capture import Normalization
from splatart_ns.geometry.se3 import matrix_from_quat
from splatart_ns.geometry.spherical_harmonics import SH_C0
from splatart_ns.splats.splat import Splat

_OWN_COLOUR = 0.7
"""The share of a part's colour that does not depend on how bright its Gaussians are."""


@dataclass(frozen=True)
class Eye:
    """Where a browser looks from: viser's camera, OpenCV axes, in the scene's world."""

    wxyz: np.ndarray
    position: np.ndarray
    fov: float
    """Vertical field of view, radian."""
    aspect: float
    """Width over height."""

    def camera(self, height: int, scene: Normalization) -> Camera:
        """The camera in the bundle's world, where `scene` brings that to the scene's."""
        width = max(1, round(height * self.aspect))
        T = torch.eye(4, dtype=torch.float64)
        T[:3, :3] = matrix_from_quat(torch.from_numpy(self.wxyz).double()) * torch.tensor([1, -1, -1])
        T[:3, 3] = torch.from_numpy(self.position / scene.scale + scene.centre)
        focal = height / 2 / np.tan(self.fov / 2)
        return Camera(T, (focal, focal, width / 2, height / 2), width, height)


class Renderer:
    """Renders a bundle as the panel says."""

    def __init__(self, splat: ArticulatedSplat):
        self._splat = splat

    def image(
        self,
        q: Mapping[str, JointValue],
        eye: Eye,
        height: int,
        hidden: Collection[str] = (),
        by_part: bool = False,
    ) -> np.ndarray:
        """What the eye sees of the configuration `q` on white, uint8 [height, W, 3] RGB.

        Args:
            hidden: Parts that are left out.
            by_part: Show the parts in the colours of `bundle_colours`, shaded by their own.
        """
        camera, splat = eye.camera(height, self._splat.normalization), self._coloured if by_part else self._splat
        picture = splat.render(camera, q, parts=self._shown(hidden), depth=False, labels=False)
        return (255 * picture.over(torch.ones(3))).round().byte().cpu().numpy()

    def _shown(self, hidden: Collection[str]) -> list[str]:
        return [name for name in self._splat.part_names if name not in hidden]

    @cached_property
    def _coloured(self) -> ArticulatedSplat:
        """The object in part colours."""
        bundle = self._splat.bundle
        coloured = zip(bundle.parts, bundle_colours(bundle), strict=True)
        parts = [replace(part, splat=_in_colour(part.splat, colour)) for part, colour in coloured]
        return ArticulatedSplat(replace(bundle, parts=parts), self._splat.device)


def _in_colour(splat: Splat, colour: Tensor) -> Splat:
    own = (0.5 + SH_C0 * splat.sh[:, :1]).clamp(0, 1)
    shaded = colour * (_OWN_COLOUR + (1 - _OWN_COLOUR) * own.mean(-1, keepdim=True))
    return replace(splat, sh=(shaded - 0.5) / SH_C0)
