"""Between a Splat and Splatfacto's parameters, and Gaussians to start from."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from splatart_ns.geometry.spherical_harmonics import SH_C0
from splatart_ns.splats.splat import Splat


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


SPLAT_SHAPES: dict[str, tuple[int | str, ...]] = {
    f"_model.gauss_params.{name}": ("Gaussians", *shape)
    for name, shape in {
        **{"means": (3,), "scales": (3,), "quats": (4,), "opacities": (1,), "semantics": ("parts",)},
        **{"features_dc": (3,), "features_rest": ("coefficients", 3)},
    }.items()
}
"""Of what a checkpoint's pipeline state has of a splat."""


def splat_from_state(state: dict[str, Tensor], prefix: str = "_model.gauss_params.") -> Splat:
    """The Gaussians in a checkpoint's pipeline state, which has tensors of `SPLAT_SHAPES`."""
    p = {name: state[prefix + name] for name in ("means", "scales", "quats", "opacities", "semantics")}
    return Splat(
        means=p["means"],
        quats=p["quats"],
        log_scales=p["scales"],
        opacity_logits=p["opacities"][:, 0],
        sh=torch.cat([state[prefix + "features_dc"][:, None], state[prefix + "features_rest"]], dim=1),
        part_logits=p["semantics"],
    )


def splat_from_points(xyz: Tensor, rgb: Tensor, sh_degree: int, num_parts: int) -> Splat:
    """Round Gaussians at points [N, 3] with colours [N, 3] in 0..255, as wide as their neighbours are far."""
    count = len(xyz)
    distances, _ = cKDTree(xyz.numpy()).query(xyz.numpy(), k=min(4, count))
    spread = torch.from_numpy(distances[:, 1:]).float().mean(-1, keepdim=True).clamp_min(1e-4)
    sh = torch.zeros(count, (sh_degree + 1) ** 2, 3)
    sh[:, 0] = (rgb / 255 - 0.5) / SH_C0
    return Splat(
        means=xyz.float(),
        quats=torch.nn.functional.normalize(torch.randn(count, 4), dim=-1),
        log_scales=spread.log().repeat(1, 3),
        opacity_logits=torch.full((count,), 0.1).logit(),
        sh=sh,
        part_logits=torch.zeros(count, num_parts + 1),
    )


def random_splat(count: int, side: float, sh_degree: int, num_parts: int) -> Splat:
    """Grey Gaussians in a cube about the cameras' focus."""
    return splat_from_points((torch.rand(count, 3) - 0.5) * side, torch.full((count, 3), 127.5), sh_degree, num_parts)
