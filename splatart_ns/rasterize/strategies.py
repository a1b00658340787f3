"""What gsplat's densification strategies take from its CUDA code, in torch: for any device."""

from __future__ import annotations

import torch
from torch import Tensor

from splatart_ns.geometry.se3 import matrix_from_quat


def compute_relocation(opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor) -> tuple[Tensor, Tensor]:
    """What n Gaussians in one place must be to look together like the one that they replace.

    Equation 9 of Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo", with the sum of binomial
    coefficients over i in closed form.

    Args:
        opacities: The Gaussian's opacity o [N].
        scales: Its standard deviations [N, 3].
        ratios: The number n of Gaussians in its place [N]; clamped to 1 .. n_max.
        binoms: Binomial coefficients; only the shape [n_max, n_max] counts.

    Returns:
        Opacities 1 - (1 - o)^(1/n) [N] and scales [N, 3].
    """
    n = ratios.clamp(1, len(binoms)).double()
    old = opacities.double()
    new = 1 - (1 - old) ** (1 / n)
    k = torch.arange(1, len(binoms) + 1, dtype=torch.float64, device=n.device)
    # C(n, k) o^k alternate in sign and reach 1e14: float64, and 0 beyond k = n.
    ways = (torch.lgamma(n + 1)[:, None] - torch.lgamma(k + 1) - torch.lgamma((n[:, None] - k).clamp_min(0) + 1)).exp()
    signs = 1 - 2 * ((k - 1) % 2)
    terms = signs * ways.round() * new[:, None] ** k / k.sqrt()
    total = terms.where(k <= n[:, None], 0.0).sum(-1)
    return new.to(opacities), scales * (old / total.where(total != 0, 1.0)).to(scales)[:, None]


def quat_scale_to_covar_preci(
    quats: Tensor,
    scales: Tensor,
    compute_covar: bool = True,
    compute_preci: bool = True,
    triu: bool = False,
) -> tuple[Tensor | None, Tensor | None]:
    """Covariances and their inverses [N, 3, 3] (None if not asked for), or with `triu` their upper triangles [N, 6].

    quats [N, 4] are wxyz of any norm, scales [N, 3].
    """
    R = matrix_from_quat(quats)

    def matrices(deviations: Tensor) -> Tensor:
        half = R * deviations[..., None, :]
        full = half @ half.mT
        return full.flatten(-2)[..., [0, 1, 2, 4, 5, 8]] if triu else full

    return matrices(scales) if compute_covar else None, matrices(1 / scales) if compute_preci else None


def enable_gsplat_strategies() -> None:
    """Let gsplat's DefaultStrategy and MCMCStrategy run in this process where there is no CUDA."""
    from gsplat.strategy import ops

    ops.compute_relocation = compute_relocation
    ops.quat_scale_to_covar_preci = quat_scale_to_covar_preci
