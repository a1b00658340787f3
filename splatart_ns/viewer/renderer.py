"""A bundle as browsers see it: images from where they look."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

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
_FADE = 0.75
"""How much white the parts beside a selected one are mixed with."""
_PICK_ROWS = 1024
"""Of the image whose pixel tells what was clicked at."""


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
        self._look = lru_cache(maxsize=4)(self._make_look)

    def image(
        self,
        q: Mapping[str, JointValue],
        eye: Eye,
        height: int,
        hidden: Collection[str] = (),
        by_part: bool = False,
        selected: str | None = None,
    ) -> np.ndarray:
        """What the eye sees of the configuration `q` on white, uint8 [height, W, 3] RGB.

        Args:
            hidden: Parts that are left out.
            by_part: Show the parts in the colours of `bundle_colours`, shaded by their own.
            selected: The part that stands out: the others fade to white.
        """
        camera = eye.camera(height, self._splat.normalization)
        look = self._look(by_part, selected)
        picture = look.render(camera, q, parts=self._shown(hidden), depth=False, labels=False)
        return (255 * picture.over(torch.ones(3))).round().byte().cpu().numpy()

    def part_at(
        self, q: Mapping[str, JointValue], eye: Eye, place: tuple[float, float], hidden: Collection[str] = ()
    ) -> str | None:
        """The part at a place of the image, (0, 0) its upper left and (1, 1) its lower right; None for background."""
        whole = eye.camera(_PICK_ROWS, self._splat.normalization)
        K = whole.K.clone()
        K[:2, 2] -= torch.tensor(place) * torch.tensor([whole.width, whole.height]) - 0.5
        pixel = self._splat.render(Camera(whole.T_world_camera, K, 1, 1), q, parts=self._shown(hidden), depth=False)
        found = int(pixel.part_ids)
        return next((part.name for part in self._splat.bundle.parts if part.id == found), None)

    def _shown(self, hidden: Collection[str]) -> list[str]:
        return [name for name in self._splat.part_names if name not in hidden]

    def _make_look(self, by_part: bool, selected: str | None) -> ArticulatedSplat:
        if not by_part and selected is None:
            return self._splat
        bundle, parts = self._splat.bundle, []
        for part, colour in zip(bundle.parts, bundle_colours(bundle), strict=True):
            splat = _in_colour(part.splat, colour) if by_part else part.splat
            parts.append(replace(part, splat=splat if selected in (None, part.name) else _faded(splat)))
        return ArticulatedSplat(replace(bundle, parts=parts), self._splat.device)


def _in_colour(splat: Splat, colour: Tensor) -> Splat:
    shaded = colour * (_OWN_COLOUR + (1 - _OWN_COLOUR) * splat.base_colours.mean(-1, keepdim=True))
    return replace(splat, sh=((shaded - 0.5) / SH_C0)[:, None])


def _faded(splat: Splat) -> Splat:
    """Mixed with white: colours are linear in their harmonics, 0.5 + SH_C0 times the first and the others."""
    sh = (1 - _FADE) * splat.sh
    sh[:, 0] += 0.5 * _FADE / SH_C0
    return replace(splat, sh=sh)
