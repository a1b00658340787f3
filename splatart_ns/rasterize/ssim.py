"""Structural similarity of images, and the loss of Gaussian splatting made of it.

Wang et al. 2004, "Image quality assessment: from error visibility to structural similarity": local means, variances
and covariance under a Gaussian window (11 taps, sigma 1.5), only where the window lies inside the image.
"""

from __future__ import annotations

from functools import cache

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatart_ns.rasterize.rasterization import has_numba

_TAPS, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity, a scalar, of images [H, W, 3] with values in [0, 1].

    Differentiable in `image` only. Along a side shorter than the window, the window has the largest odd size that fits.
    """
    return _Similarity.apply(image, target, 0.0, 1.0)


def l1_ssim_loss(image: Tensor, target: Tensor, ssim_weight: float = 0.2) -> Tensor:
    """(1 - w) mean |image - target| + w (1 - ssim), a scalar, of images [H, W, 3] with values in [0, 1].

    The loss of Kerbl et al. 2023. Differentiable in `image` only.
    """
    return ssim_weight + _Similarity.apply(image, target, 1 - ssim_weight, -ssim_weight)


class _Similarity(torch.autograd.Function):
    """l1_factor mean |image - target| + ssim_factor ssim; its gradient is made along with the value."""

    @staticmethod
    def forward(ctx, image, target, l1_factor, ssim_factor):
        if image.shape != target.shape or image.ndim != 3 or image.shape[2] != 3:
            found = f"image has the shape {list(image.shape)} and target {list(target.shape)}"
            raise ValueError(f"ssim: {found}; give [H, W, 3] of both")
        function = _value_and_gradient
        if has_numba() and image.device.type == "cpu" and image.dtype == torch.float32:
            function = _value_and_gradient_numba
        with_gradient = ctx.needs_input_grad[0]
        value, gradient = function(image.detach(), target.detach().to(image), l1_factor, ssim_factor, with_gradient)
        if with_gradient:
            ctx.save_for_backward(gradient)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx, v_value):
        (gradient,) = ctx.saved_tensors
        return gradient * v_value, None, None, None


def _value_and_gradient_numba(image, target, l1_factor, ssim_factor, with_gradient):
    from splatart_ns.rasterize.numba_ssim import ssim_and_gradient

    windows = tuple(_window(size).float().numpy() for size in image.shape[:2])
    factors = (ssim_factor, l1_factor) if with_gradient else None
    value, gradient = ssim_and_gradient(image.contiguous().numpy(), target.contiguous().numpy(), windows, factors)
    value = torch.tensor(ssim_factor * value)
    if l1_factor:
        value += l1_factor * (image - target).abs().mean()
    return value, None if gradient is None else torch.from_numpy(gradient)


def _value_and_gradient(image, target, l1_factor, ssim_factor, with_gradient):
    windows = [_window(size).to(image) for size in image.shape[:2]]
    moments = torch.cat([image, target, image * image, target * target, image * target], -1)
    x, y, xx, yy, xy = _filtered(moments, windows).split(3, -1)
    level = x * x + y * y + _C1
    spread = (xx - x * x) + (yy - y * y) + _C2
    alike = (2 * x * y + _C1) / level
    structure = (2 * (xy - x * y) + _C2) / spread
    similarity = alike * structure
    error = image - target
    value = l1_factor * error.abs().mean() + ssim_factor * similarity.mean()
    if not with_gradient:
        return value, None
    by_xx = -similarity / spread
    by_xy = 2 * alike / spread
    by_x = 2 * structure * (y - x * alike) / level - 2 * x * by_xx - y * by_xy
    slopes = _filtered(torch.cat([by_x, by_xx, by_xy], -1), windows, spread_out=True)
    by_x, by_xx, by_xy = (slopes * (ssim_factor / similarity.numel())).split(3, -1)
    gradient = by_x + 2 * image * by_xx + target * by_xy
    return value, gradient.add_(error.sign(), alpha=l1_factor / error.numel())


def _filtered(channels: Tensor, windows: list[Tensor], spread_out: bool = False) -> Tensor:
    """Channels [H, W, D] under the windows along their sides; `spread_out`: the transposed operation."""
    planes = channels.permute(2, 0, 1)[None]  # a view that torch takes for channels-last, which is the fastest
    kernels = windows[0][:, None], windows[1][None]
    with torch.backends.cudnn.flags(enabled=False):  # cuDNN rounds float32 to ten bits
        for kernel in kernels:
            padding = [(n - 1) * spread_out for n in kernel.shape]
            kernel = kernel.expand(planes.shape[1], 1, *kernel.shape)
            planes = F.conv2d(planes, kernel, padding=padding, groups=len(kernel))
    return planes[0].permute(1, 2, 0)


@cache
def _window(size: int) -> Tensor:
    """Taps of the window along a side of `size` pixels, float64."""
    taps = min(_TAPS, size - (size + 1) % 2)
    weights = torch.exp(-0.5 * ((torch.arange(taps, dtype=torch.float64) - taps // 2) / _SIGMA) ** 2)
    return weights / weights.sum()
