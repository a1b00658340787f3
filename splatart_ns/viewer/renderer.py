"""Images of a bundle for cameras that move: what does not depend on the configuration is made once."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from splatart_ns.bundle.animation import bundle_colours
from splatart_ns.bundle.bundle import Bundle
from splatart_ns.bundle.posing import normalized
from splatart_ns.capture.capture import Normalization
from splatart_ns.geometry.se3 import inverse, matrix_from_quat
from splatart_ns.geometry.spherical_harmonics import SH_C0
from splatart_ns.rasterize.render import render
from splatart_ns.splats.splat import Splat

_OWN_COLOUR = 0.7
"""The share of a part's colour that does not depend on how bright its Gaussians are."""


@dataclass(frozen=True)
class Eye:
    """Where a browser looks from: viser's camera, OpenCV axes, in the normalised world."""

    wxyz: np.ndarray
    position: np.ndarray
    fov: float
    """Vertical field of view, radian."""
    aspect: float
    """Width over height."""


class Renderer:
    """Renders a bundle's parts, each in its own place."""

    def __init__(self, bundle: Bundle, normalization: Normalization, device: torch.device | str):
        """`normalization` brings the object to a radius of about 1 about the origin."""
        splats = {part.name: normalized(part.splat, normalization).to(device) for part in bundle.parts}
        width = max(splat.sh.shape[1] for splat in splats.values())
        self._splats = {
            name: replace(splat, sh=pad(splat.sh, (0, 0, 0, width - splat.sh.shape[1])))
            for name, splat in splats.items()
        }
        colours = dict(zip(bundle.part_names, bundle_colours(bundle).to(device), strict=True))
        self._coloured = {name: _in_colour(splat, colours[name]) for name, splat in splats.items()}

    @torch.no_grad()
    def image(
        self,
        motions: Mapping[str, Tensor],
        eye: Eye,
        height: int,
        hidden: Collection[str] = (),
        by_part: bool = False,
    ) -> np.ndarray:
        """What the eye sees on white, uint8 [height, W, 3] RGB.

        Args:
            motions: T[part] [4, 4] of the normalised world.
            hidden: Parts that are left out.
            by_part: Show the parts in the colours of `bundle_colours`, shaded by their own.
        """
        width = max(1, round(height * eye.aspect))
        splats = self._coloured if by_part else self._splats
        shown = [splat.transformed(motions[name]) for name, splat in splats.items() if name not in hidden]
        if not shown:
            return np.full((height, width, 3), 255, np.uint8)
        splat = Splat.cat(shown)
        T = torch.eye(4, dtype=torch.float64)
        T[:3, :3] = matrix_from_quat(torch.from_numpy(eye.wxyz).double())
        T[:3, 3] = torch.from_numpy(eye.position)
        focal = height / 2 / np.tan(eye.fov / 2)
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]).to(splat.means)
        seen = render(splat, inverse(T)[None].to(splat.means), K[None], width, height, with_depth=False)
        image = (seen.rgb + 1 - seen.accumulation)[0].clamp(0, 1)
        return (255 * image).round().byte().cpu().numpy()


def _in_colour(splat: Splat, colour: Tensor) -> Splat:
    own = (0.5 + SH_C0 * splat.sh[:, :1]).clamp(0, 1)
    shaded = colour * (_OWN_COLOUR + (1 - _OWN_COLOUR) * own.mean(-1, keepdim=True))
    return replace(splat, sh=(shaded - 0.5) / SH_C0)
