"""Render a Splat: colour, depth, accumulation and features from one pass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from splatart_ns.choices import Rasterizer
from splatart_ns.rasterize.rasterization import rasterization, sh_colors
from splatart_ns.splats.splat import Splat

PIXEL_VARIANCE = 1 / 12
"""By how much Gaussians are blurred in an image, pixels^2: as much as a square pixel blurs what it shows. The customary
0.3 makes every edge nearly twice as soft."""


@dataclass
class Rendering:
    """Images of C cameras."""

    rgb: Tensor
    """Colours over black [C, H, W, 3]; add (1 - accumulation) * background for another background."""
    depth: Tensor | None
    """Expected depth along the optical axis [C, H, W, 1], length; 0 where nothing is seen."""
    accumulation: Tensor
    """Opacity [C, H, W, 1]."""
    features: Tensor | None
    """Accumulated features [C, H, W, F], not divided by the accumulation."""
    info: dict[str, Any]
    """The intermediate results of `rasterization`."""


def render(
    splat: Splat,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    features: Tensor | None = None,
    with_depth: bool = True,
    sh_degree: int | None = None,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    backend: Rasterizer = "auto",
) -> Rendering:
    """Render `splat` into C pinhole cameras.

    Args:
        viewmats: World-to-camera transforms [C, 4, 4], OpenCV axes.
        Ks: Intrinsics [C, 3, 3], pixels.
        width, height: Image size.
        features: Any channels per Gaussian [N, F] to composite like colours, say part probabilities.
        with_depth: Whether to render depth.
        sh_degree: Evaluate only the bands up to this degree; all by default.
        absgrad, rasterize_mode, backend: See `rasterization`.
    """
    degree = splat.sh_degree if sh_degree is None else min(sh_degree, splat.sh_degree)
    colors = splat.sh
    if features is not None:
        colors = sh_colors(splat.means, splat.sh, viewmats, degree, backend)
        colors = torch.cat([colors, features.expand(len(viewmats), -1, -1)], -1)
    image, accumulation, info = rasterization(
        splat.means,
        splat.quats,
        splat.scales,
        splat.opacities,
        colors,
        viewmats,
        Ks,
        width,
        height,
        eps2d=PIXEL_VARIANCE,
        sh_degree=degree if features is None else None,
        render_mode="RGB+ED" if with_depth else "RGB",
        absgrad=absgrad,
        rasterize_mode=rasterize_mode,
        backend=backend,
    )
    depth = image[..., -1:] if with_depth else None
    last = -1 if with_depth else None
    return Rendering(
        rgb=image[..., :3],
        depth=depth,
        accumulation=accumulation,
        features=None if features is None else image[..., 3:last],
        info=info,
    )
