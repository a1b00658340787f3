"""What the rasterizer takes: compiled kernels do not look, and with a wrong shape read and write where nothing is."""

from __future__ import annotations

import math
import operator
from typing import Literal, get_args

import torch
from torch import Tensor

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
RasterizeMode = Literal["classic", "antialiased"]
Shape = tuple[int | str, ...]

_CHOICES = {"render_mode": get_args(RenderMode), "rasterize_mode": get_args(RasterizeMode)}
_MAX_DEGREE = 3
_HALVES = torch.float16, torch.bfloat16


class Arguments:
    """Of N Gaussians at `means` [N, 3] before C cameras `viewmats` [C, 4, 4], which say what shapes the others have.

    Everything raises ValueError for a tensor of another shape or type, on another device or of half precision, and
    TypeError for what is no tensor. It takes microseconds.
    """

    def __init__(self, means: Tensor, viewmats: Tensor) -> None:
        self._device, self._dtype = getattr(means, "device", None), getattr(means, "dtype", None)
        self._sizes: dict[int | str, int] = {}
        for name, tensor, size, rest in (("means", means, "N", (3,)), ("viewmats", viewmats, "C", (4, 4))):
            self._require_tensor(name, tensor)
            if tensor.ndim == 0 or tensor.shape[1:] != rest:
                raise self._wrong(name, tensor, (size, *rest))
            self._sizes[size] = len(tensor)

    def require(self, **tensors: tuple[Tensor, Shape]) -> None:
        """Each has its shape, in which N and C stand for the numbers of Gaussians and cameras."""
        for name, (tensor, shape) in tensors.items():
            self._require_tensor(name, tensor)
            if tensor.shape != tuple(self._sizes.get(size, size) for size in shape):
                raise self._wrong(name, tensor, shape)

    def require_colors(self, colors: Tensor) -> None:
        """[N, D] or [C, N, D], any D."""
        self._require_tensor("colors", colors)
        if colors.ndim < 2 or colors.shape[:-1] not in self._rows():
            raise self._wrong("colors", colors, ("N", "D"), ("C", "N", "D"))

    def require_harmonics(self, name: str, sh: Tensor, degree: int) -> None:
        """[N, K, 3] or [C, N, K, 3], K >= (degree + 1)^2, of a degree that there is."""
        if not _is_whole(degree) or not 0 <= degree <= _MAX_DEGREE:
            raise ValueError(f"rasterization: sh_degree is {degree!r}; give 0 to {_MAX_DEGREE}")
        self._require_tensor(name, sh)
        least = (degree + 1) ** 2
        if sh.ndim < 3 or sh.shape[:-2] not in self._rows() or sh.shape[-2] < least or sh.shape[-1] != 3:
            K = f"K >= {least}"
            raise self._wrong(name, sh, ("N", K, 3), ("C", "N", K, 3))

    def _rows(self) -> tuple[tuple[int, ...], ...]:
        N, C = self._sizes["N"], self._sizes["C"]
        return (N,), (C, N)

    def _require_tensor(self, name: str, tensor: Tensor) -> None:
        if not isinstance(tensor, Tensor):
            raise TypeError(f"rasterization: {name} is of type {type(tensor).__name__}; give a tensor")
        if tensor.device != self._device:
            raise ValueError(f"rasterization: {name} is on {tensor.device} but means on {self._device}; bring it there")
        if tensor.dtype in _HALVES:
            raise ValueError(f"rasterization: {name} is {tensor.dtype}; give float32")
        if tensor.dtype != self._dtype:
            raise ValueError(f"rasterization: {name} is {tensor.dtype} but means {self._dtype}; convert either")

    def _wrong(self, name: str, tensor: Tensor, *shapes: Shape) -> ValueError:
        wanted = " or ".join(f"[{', '.join(map(str, shape))}]" for shape in shapes)
        known = ", ".join(f"{size} = {number}" for size, number in self._sizes.items())
        found = f"rasterization: {name} has the shape {list(tensor.shape)}; give {wanted}"
        return ValueError(f"{found}, with {known}" if known else found)


def image_size(width: int, height: int) -> tuple[int, int]:
    """Both as Python's integers. Raises ValueError for what is no number of pixels."""
    for name, size in (("width", width), ("height", height)):
        if not _is_whole(size) or size < 1:
            raise ValueError(f"rasterization: {name} is {size!r}; give a whole number of pixels, 1 or more")
    return operator.index(width), operator.index(height)


def require_modes(**given: str) -> None:
    """Raise ValueError for a `render_mode` or `rasterize_mode` that there is not."""
    for name, value in given.items():
        if value not in _CHOICES[name]:
            raise ValueError(f"rasterization: {name} is {value!r}; give one of {', '.join(_CHOICES[name])}")


def require_finite(**tensors: Tensor | None) -> None:
    """Raise ValueError for a tensor that holds NaN or infinity."""
    tensors = {name: tensor.detach() for name, tensor in tensors.items() if tensor is not None}
    # A sum is the fastest look at every value, and is not finite unless all are; one transfer fetches all sums.
    sums = torch.stack([tensor.sum() for tensor in tensors.values()]).tolist()
    for (name, tensor), total in zip(tensors.items(), sums, strict=True):
        if not math.isfinite(total):
            bad = (~tensor.isfinite()).nonzero()
            if len(bad):
                where = ", ".join(map(str, bad[0].tolist()))
                raise ValueError(
                    f"rasterization: {name}[{where}] is {tensor[tuple(bad[0])]}, one of {len(bad)} not finite"
                )


def _is_whole(number: object) -> bool:
    try:
        operator.index(number)
    except TypeError:
        return False
    return not isinstance(number, bool)
