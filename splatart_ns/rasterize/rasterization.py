"""The one entry to rasterization, with the signature and the results of gsplat's `rasterization`."""

from __future__ import annotations

import functools
import importlib.util
from typing import Any, get_args

import torch
from torch import Tensor

from splatart_ns.choices import Rasterizer
from splatart_ns.errors import InputError
from splatart_ns.geometry.spherical_harmonics import sh_basis
from splatart_ns.rasterize import torch_backend
from splatart_ns.rasterize.arguments import (
    Arguments,
    RasterizeMode,
    RenderMode,
    image_size,
    require_finite,
    require_modes,
)
from splatart_ns.rasterize.projection import project

_chosen: Rasterizer = "auto"


def set_backend(backend: Rasterizer) -> None:
    """Choose what "auto" stands for in this process; "auto" is this machine's best again.

    Raises:
        InputError: The backend cannot run here.
    """
    global _chosen
    if backend not in get_args(Rasterizer):
        raise InputError(f"There is no rasterizer {backend!r}: take one of {', '.join(get_args(Rasterizer))}.")
    if backend == "numba" and not has_numba():
        raise InputError("The numba rasterizer needs numba: pip install 'splatart-ns[cpu]', or take the torch one.")
    if backend == "gsplat" and not torch.cuda.is_available():
        raise InputError("The gsplat rasterizer needs CUDA, which torch does not find: take auto, numba or torch.")
    _chosen = backend


def default_device() -> str:
    """The type of device to work on: "cuda" where there is any and the chosen backend runs there, else "cpu"."""
    return "cuda" if torch.cuda.is_available() and _runs_on(_chosen, "cuda") else "cpu"


def default_backend(device_type: str | None = None) -> Rasterizer:
    """The backend that "auto" stands for on a type of device ("cpu", "cuda", ...), by default `default_device`: the
    chosen one if it runs there, else the best."""
    device_type = device_type or default_device()
    if _chosen != "auto" and _runs_on(_chosen, device_type):
        return _chosen
    if device_type == "cuda":
        return "gsplat"
    return "numba" if device_type == "cpu" and has_numba() else "torch"


def _runs_on(backend: Rasterizer, device_type: str) -> bool:
    return {"numba": "cpu", "gsplat": "cuda"}.get(backend, device_type) == device_type


@functools.cache
def has_numba() -> bool:
    """Whether kernels can be compiled."""
    return importlib.util.find_spec("numba") is not None


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = False,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: RasterizeMode = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    covars: Tensor | None = None,
    backend: Rasterizer = "auto",
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians into C pinhole images. Arguments are those of gsplat 1.4.0, plus `backend`.

    Args:
        means: Centres [N, 3], world.
        quats: Rotations [N, 4], wxyz, of any norm.
        scales: Standard deviations [N, 3].
        opacities: [N] in [0, 1].
        colors: Channels [N, D] or [C, N, D] as they are; with `sh_degree`, spherical harmonics coefficients
            [N, K, 3] or [C, N, K, 3], of which the first (sh_degree + 1)^2 count; the colour is max(0, 0.5 + sum).
        viewmats: World-to-camera transforms [C, 4, 4], OpenCV axes. Differentiable.
        Ks: Intrinsics [C, 3, 3], pixels.
        width, height: Image size.
        near_plane, far_plane, radius_clip, eps2d: See `project`.
        backgrounds: What shows through [C, D]; black when not given. The background's depth is 0.
        render_mode: Channels of the image: "RGB" the colours, "D" accumulated depth, "ED" expected depth
            (accumulated over alpha), or colours then depth.
        absgrad: Let backward set `info["means2d"].absgrad`.
        rasterize_mode: "antialiased" keeps the mass of Gaussians that `eps2d` blurs (Mip-Splatting).
        packed, sparse_grad, channel_chunk: Ignored; results are never packed.
        tile_size: Only passed on to `info`; the backends have tiles of their own.
        distributed, camera_model, covars: Only gsplat's defaults are supported.
        backend: "gsplat" (CUDA), "numba" (CPU, float32), "torch" (any device), or "auto": what `set_backend` chose or
            the first of these for the device of `means`; torch for anything but float32.

    Returns:
        The image [C, H, W, D], [C, H, W, 1] or [C, H, W, D + 1]; its alpha [C, H, W, 1]; and `info`, the intermediate
        results under gsplat's names: means2d (a tensor of the graph), radii (0 = culled), depths, conics, opacities
        (compensated), camera_ids and gaussian_ids (None), width, height, n_cameras, tile_size, tile_width, tile_height.

    Raises:
        NotImplementedError: For a camera model but pinhole, distributed rendering or given covariances.
        ValueError: A tensor has another shape, or holds NaN or infinity; a mode or the backend is unknown, or the
            backend is not for these tensors.
    """
    for name, is_default in (
        (f"camera_model={camera_model!r}", camera_model == "pinhole"),
        ("distributed=True", not distributed),
        ("covars", covars is None),
    ):
        if not is_default:
            raise NotImplementedError(f"rasterization: {name} is not supported")
    require_modes(render_mode=render_mode, rasterize_mode=rasterize_mode)
    width, height = image_size(width, height)
    with_depth, with_color = render_mode.endswith("D"), render_mode.startswith("RGB")
    arguments = _gaussians(means, quats, scales, opacities, viewmats)
    arguments.require(Ks=(Ks, ("C", 3, 3)))
    if sh_degree is None:
        arguments.require_colors(colors)
    else:
        arguments.require_harmonics("colors", colors, sh_degree)
    if backgrounds is not None and with_color:
        arguments.require(backgrounds=(backgrounds, ("C", colors.shape[-1])))
    backend = _resolve(backend, means)
    tensors = dict(means=means, quats=quats, scales=scales, opacities=opacities, colors=colors)
    require_finite(**tensors, viewmats=viewmats, Ks=Ks, backgrounds=backgrounds)
    if backend == "gsplat":
        import gsplat

        return gsplat.rasterization(
            *(means, quats, scales, opacities, colors, viewmats, Ks, width, height),
            near_plane=near_plane,
            far_plane=far_plane,
            radius_clip=radius_clip,
            eps2d=eps2d,
            sh_degree=sh_degree,
            packed=False,
            backgrounds=backgrounds,
            render_mode=render_mode,
            absgrad=absgrad,
            rasterize_mode=rasterize_mode,
        )

    C, N = len(viewmats), len(means)
    project_, composite = _steps(backend)
    radii, means2d, depths, conics, compensations = project_(
        *(means, quats, scales, viewmats, Ks, width, height, eps2d, near_plane, far_plane, radius_clip)
    )
    opacities = opacities.expand(C, N)
    if rasterize_mode == "antialiased":
        opacities = opacities * compensations
    if sh_degree is not None:
        colors = _sh_colors(means, colors, viewmats, sh_degree, backend)

    channels = [colors.expand(C, -1, -1)] if with_color else []
    if with_depth:
        channels.append(depths[..., None])
    image, alphas = composite(
        *(means2d, conics, opacities, torch.cat(channels, -1), depths, radii > 0, width, height, absgrad)
    )
    if render_mode.endswith("ED"):
        depth = image[..., -1:] / alphas.clamp_min(1e-10)
        image = torch.cat([image[..., :-1], depth], -1)
    if backgrounds is not None and with_color:
        behind = (1 - alphas) * backgrounds[:, None, None]
        image = image + (torch.nn.functional.pad(behind, (0, 1)) if with_depth else behind)
    info = {
        "camera_ids": None,
        "gaussian_ids": None,
        "radii": radii,
        "means2d": means2d,
        "depths": depths,
        "conics": conics,
        "opacities": opacities,
        "width": width,
        "height": height,
        "n_cameras": C,
        "tile_size": tile_size,
        "tile_width": -(-width // tile_size),
        "tile_height": -(-height // tile_size),
    }
    return image, alphas, info


@torch.no_grad()
def rasterize_neighbours(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    K: Tensor,
    width: int,
    height: int,
    eps2d: float = 0.3,
    backend: Rasterizer = "auto",
) -> Tensor:
    """Images of a camera and of others so near it that they may differ from its image to first order alone.

    For derivatives: that takes half the time of as many images. Backends but numba render every image.

    Args:
        colors: As they are seen from each camera [C, N, 3].
        viewmats: World-to-camera transforms [C, 4, 4], of which the first is the one the others are near.
        K: Intrinsics of all [3, 3], pixels.
        means, quats, scales, opacities, width, height, eps2d, backend: See `rasterization`.

    Returns:
        Colours over black and accumulation [C, H, W, 4], without gradients.
    """
    width, height = image_size(width, height)
    shapes = dict(K=(K, (3, 3)), colors=(colors, ("C", "N", 3)))
    _gaussians(means, quats, scales, opacities, viewmats).require(**shapes)
    backend = _resolve(backend, means)
    Ks = K.expand(len(viewmats), 3, 3)
    if backend != "numba":
        # Accumulation is what a channel shows that is one everywhere.
        channels = torch.cat([colors, torch.ones_like(colors[..., :1])], -1)
        camera = viewmats, Ks, width, height
        return rasterization(means, quats, scales, opacities, channels, *camera, eps2d=eps2d, backend=backend)[0]
    from splatart_ns.rasterize import numba_backend, numba_projection

    require_finite(means=means, quats=quats, scales=scales, opacities=opacities, colors=colors, viewmats=viewmats, Ks=K)
    radii, means2d, depths, conics, _ = numba_projection.project(
        means, quats, scales, viewmats, Ks, width, height, eps2d
    )
    return numba_backend.rasterize_neighbours(means2d, conics, opacities, colors, depths, radii > 0, width, height)


def sh_colors(means: Tensor, sh: Tensor, viewmats: Tensor, degree: int, backend: Rasterizer = "auto") -> Tensor:
    """Colours [C, N, 3] seen from the cameras `viewmats` [C, 4, 4] of Gaussians with coefficients `sh`.

    `sh` is [N, K, 3] or [C, N, K, 3], K >= (degree + 1)^2. `backend` as in `rasterization`.
    """
    Arguments(means, viewmats).require_harmonics("sh", sh, degree)
    require_finite(means=means, sh=sh, viewmats=viewmats)
    return _sh_colors(means, sh, viewmats, degree, _resolve(backend, means))


def _sh_colors(means: Tensor, sh: Tensor, viewmats: Tensor, degree: int, backend: Rasterizer) -> Tensor:
    if backend == "numba":
        from splatart_ns.rasterize import numba_spherical_harmonics

        return numba_spherical_harmonics.sh_colors(means, sh, viewmats, degree)
    R, t = viewmats[:, :3, :3], viewmats[:, :3, 3:]
    offsets = (means.T + R.mT @ t).mT  # means - camera centre [C, N, 3], components contiguous
    norm2 = offsets.square().sum(-1, keepdim=True)
    basis = sh_basis(offsets * norm2.clamp_min(1e-24).rsqrt(), degree)
    # Sum over the bands by matrix products: reducing [..., K, 3] over K is several times slower, as is a product with 3
    # columns instead of 16.
    K = basis.shape[-1]
    bands, channels = (torch.eye(*size, dtype=sh.dtype, device=sh.device) for size in ((K, K), (3, 16)))
    terms = (basis @ bands.repeat_interleave(3, dim=1)) * sh[..., :K, :].flatten(-2)
    return ((terms @ channels.repeat(K, 1))[..., :3] + 0.5).clamp_min(0)


def _resolve(backend: Rasterizer, means: Tensor) -> Rasterizer:
    """The backend to use for Gaussians at `means`."""
    if backend == "auto":
        return default_backend(means.device.type) if means.dtype == torch.float32 else "torch"
    if backend not in get_args(Rasterizer):
        raise ValueError(f"unknown rasterization backend {backend!r}: use {', '.join(get_args(Rasterizer))}")
    if backend == "numba" and (means.dtype, means.device.type) != (torch.float32, "cpu"):
        raise ValueError(f"the numba backend takes float32 on the CPU, not {means.dtype} on {means.device}: use torch")
    if backend == "gsplat" and (means.dtype, means.device.type) != (torch.float32, "cuda"):
        raise ValueError(f"the gsplat backend takes float32 on CUDA, not {means.dtype} on {means.device}: use torch")
    return backend


def _gaussians(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, viewmats: Tensor) -> Arguments:
    arguments = Arguments(means, viewmats)
    arguments.require(quats=(quats, ("N", 4)), scales=(scales, ("N", 3)), opacities=(opacities, ("N",)))
    return arguments


def _steps(backend: Rasterizer):
    """The functions that project and composite."""
    if backend == "numba":
        from splatart_ns.rasterize import numba_backend, numba_projection

        return numba_projection.project, numba_backend.rasterize_to_pixels
    return project, torch_backend.rasterize_to_pixels
