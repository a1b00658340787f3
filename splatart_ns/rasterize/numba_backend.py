"""Compositing of projected Gaussians on the CPU, compiled by numba; several times faster than `torch_backend`.

Where this departs from the usual tile rasterizer (Kerbl et al. 2023, "3D Gaussian Splatting"): 8x8 tiles hold only
Gaussians that reach alpha 1/255 there, and the gradient needs no division: behind a Gaussian lies the colour B, updated
back to front by B <- B + alpha (c - B), and dL/d ln(alpha) = alpha T (c - B) . dL/dcolor.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatart_ns.rasterize.numba_binning import bin_gaussians
from splatart_ns.rasterize.numba_compositing import (
    GROUP,
    composite,
    composite_backward,
    composite_neighbours,
    gather_gradients,
)
from splatart_ns.rasterize.numba_runtime import balanced_bounds, even_bounds, run
from splatart_ns.threads import num_threads


def rasterize_to_pixels(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    colors: Tensor,
    depths: Tensor,
    visible: Tensor,
    width: int,
    height: int,
    absgrad: bool = False,
) -> tuple[Tensor, Tensor]:
    """Composite projected Gaussians front to back over black.

    Arguments and results are those of `torch_backend.rasterize_to_pixels`, float32 and on the CPU. Results
    do not depend on `num_threads`, to the last bit.
    """
    return _Rasterize.apply(means2d, conics, opacities, colors, depths, visible, width, height, absgrad)


def rasterize_neighbours(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    colors: Tensor,
    depths: Tensor,
    visible: Tensor,
    width: int,
    height: int,
) -> Tensor:
    """Colours over black and accumulation [C, H, W, 4] of C cameras, all to first order about the first one's.

    Arguments are those of `rasterize_to_pixels`, but opacities are [N] and colors [C, N, 3]. No gradients.
    """
    means_, conics_, colors_, visible_ = (_array(t) for t in (means2d, conics, colors, visible))
    bins = bin_gaussians(means_[0], conics_[0], _array(opacities), _array(depths[0]), visible_[0], 1, width, height)
    images = np.empty((len(colors), height, width, 4), np.float32)
    bounds = balanced_bounds(bins.tile_offsets, num_threads())
    run(composite_neighbours, bounds, bins, means_, conics_, colors_, visible_, images)
    return torch.from_numpy(images)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means2d, conics, opacities, colors, depths, visible, width, height, absgrad):
        C, N, D = colors.shape
        means_, conics_, colors_ = (_array(t).reshape(C * N, t.shape[-1]) for t in (means2d, conics, colors))
        opacities_, depths_, visible_ = (_array(t).ravel() for t in (opacities, depths, visible))
        bins = bin_gaussians(means_, conics_, opacities_, depths_, visible_, C, width, height)
        padding = -D % GROUP if D else GROUP
        if padding:
            colors_ = np.pad(colors_, ((0, 0), (0, padding)))
        render = np.empty((C, height, width, D), np.float32)
        alphas = np.empty((C, height, width, 1), np.float32)
        used = np.empty(len(bins.tile_offsets) - 1, np.int64)
        bounds = balanced_bounds(bins.tile_offsets, num_threads())
        run(composite, bounds, bins, colors_, render, alphas, used)
        ctx.means2d = means2d if absgrad else None
        ctx.state = bins, colors_, used, (C, N, D)
        return torch.from_numpy(render), torch.from_numpy(alphas)

    @staticmethod
    @once_differentiable
    def backward(ctx, v_render, v_alphas):
        bins, colors, used, (C, N, D) = ctx.state
        needs = ctx.needs_input_grad[:4]
        wants = any(needs[:3]), ctx.means2d is not None, needs[3]
        drawn = np.empty(len(bins.pairs), bool)
        moments = np.empty((len(bins.pairs) if wants[0] else 0, 8 if wants[1] else 6), np.float32)
        pair_colors = np.empty((len(bins.pairs) if wants[2] else 0, colors.shape[1]), np.float32)
        bounds = balanced_bounds(np.concatenate([[0], np.cumsum(used)]), num_threads())
        run(
            composite_backward,
            bounds,
            bins,
            used,
            colors,
            _array(v_render),
            _array(v_alphas),
            wants,
            drawn,
            moments,
            pair_colors,
        )

        widths = (2, 3, 1, D if wants[2] else 0, 2 if wants[1] else 0)
        gradients = [np.zeros((C * N, width), np.float32) for width in widths]
        bounds = even_bounds(len(bins.order), num_threads())
        run(gather_gradients, bounds, bins, drawn, moments, pair_colors, wants, *gradients)
        *gradients, absolute = (torch.from_numpy(gradient).unflatten(0, (C, N)) for gradient in gradients)
        if wants[1]:
            ctx.means2d.absgrad = absolute
        gradients[2] = gradients[2][..., 0]
        return *(g if need else None for g, need in zip(gradients, needs, strict=True)), None, None, None, None, None


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()
