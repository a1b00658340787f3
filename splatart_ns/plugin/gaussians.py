"""Between a Splat and Splatfacto's parameters, and Gaussians to start from."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from splatart_ns.geometry.spherical_harmonics import SH_C0
from splatart_ns.splats.splat import Splat

FLATNESS = 0.3
"""How thick Gaussians on a known surface start, in their widths. On one object .2 and .5 gave equal pictures, and round
ones .3 dB less."""
ALONE = 0.1
"""How wide a Gaussian starts that has no neighbours."""


def gauss_params_from_splat(splat: Splat) -> dict[str, nn.Parameter]:
    """Splatfacto's names and shapes, and `semantics` for the part logits."""
    tensors = {
        "means": splat.means,
        "scales": splat.log_scales,
        "quats": splat.quats,
        "features_dc": splat.sh[:, 0],
        "features_rest": splat.sh[:, 1:],
        "opacities": splat.opacity_logits[:, None],
        "semantics": splat.part_logits,
    }
    return {name: nn.Parameter(tensor.detach().clone().contiguous()) for name, tensor in tensors.items()}


_PREFIX = "_model.gauss_params."

SPLAT_SHAPES: dict[str, tuple[int | str, ...]] = {
    _PREFIX + name: ("Gaussians", *shape)
    for name, shape in {
        **{"means": (3,), "scales": (3,), "quats": (4,), "opacities": (1,), "semantics": ("parts",)},
        **{"features_dc": (3,), "features_rest": ("coefficients", 3)},
    }.items()
}
"""Of what a checkpoint's pipeline state has of a splat."""


def splat_from_state(state: dict[str, Tensor]) -> Splat:
    """The Gaussians in a checkpoint's pipeline state, which has tensors of `SPLAT_SHAPES`."""
    p = {name: state[_PREFIX + name] for name in ("means", "scales", "quats", "opacities", "semantics")}
    return Splat(
        means=p["means"],
        quats=p["quats"],
        log_scales=p["scales"],
        opacity_logits=p["opacities"][:, 0],
        sh=torch.cat([state[_PREFIX + "features_dc"][:, None], state[_PREFIX + "features_rest"]], dim=1),
        part_logits=p["semantics"],
    )


def splat_from_points(xyz: Tensor, rgb: Tensor, normals: Tensor, sh_degree: int, num_parts: int) -> Splat:
    """Gaussians at points [N, 3] with colours [N, 3] in 0..255, as wide as their neighbours are far.

    Round ones, but flat across those of the `normals` [N, 3] that are not 0.
    """
    count = len(xyz)
    distances, _ = cKDTree(xyz.numpy()).query(xyz.numpy(), k=min(4, count))
    spread = torch.from_numpy(distances.reshape(count, -1)[:, 1:]).float().mean(-1, keepdim=True)
    spread = spread.nan_to_num(ALONE).clamp_min(1e-4)
    flat = normals.norm(dim=-1, keepdim=True) > 0
    # The shorter turn of z to the normal is about z x n; where they are opposite, about x.
    x, y, z = normals.float().unbind(-1)
    towards = torch.stack([1 + z, -y, x, torch.zeros(count)], -1)
    towards = torch.where(z[:, None] > -0.9999, towards, torch.tensor([0.0, 1.0, 0.0, 0.0]))
    sh = torch.zeros(count, (sh_degree + 1) ** 2, 3)
    sh[:, 0] = (rgb / 255 - 0.5) / SH_C0
    return Splat(
        means=xyz.float(),
        quats=torch.nn.functional.normalize(torch.where(flat, towards, torch.randn(count, 4)), dim=-1),
        log_scales=(spread * torch.cat([torch.ones(count, 2), torch.where(flat, FLATNESS, 1.0)], -1)).log(),
        opacity_logits=torch.full((count,), 0.1).logit(),
        sh=sh,
        part_logits=torch.zeros(count, num_parts + 1),
    )


def random_splat(count: int, side: float, sh_degree: int, num_parts: int) -> Splat:
    """Grey Gaussians in a cube about the cameras' focus."""
    xyz = (torch.rand(count, 3) - 0.5) * side
    return splat_from_points(xyz, torch.full((count, 3), 127.5), torch.zeros(count, 3), sh_degree, num_parts)
