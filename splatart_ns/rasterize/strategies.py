"""What gsplat's densification strategies take from its CUDA code, in torch: for any device."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from splatart_ns.geometry.se3 import matrix_from_quat


def compute_relocation(opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor) -> tuple[Tensor, Tensor]:
    """What n Gaussians in one place must be to look together like the one that they replace.

    Equation 9 of Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo", with its double sum as an
    integral.

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
    new = -torch.expm1(torch.log1p(-old) / n)
    # The sum over k of -(-o)^k C(n, k) / sqrt(k) loses all digits to its signs. With 1 / sqrt(k) as the integral of
    # 2 exp(-k u^2) / sqrt(pi) it is that of 1 - (1 - o exp(-u^2))^n, which is smooth and positive: by trapezoids.
    step = 0.1
    u = torch.arange(0, 7, step, dtype=torch.float64, device=n.device)
    heights = -torch.expm1(n[:, None] * torch.log1p(-new[:, None] * torch.exp(-u * u)))
    total = 2 / math.sqrt(math.pi) * step * (heights.sum(-1) - heights[:, 0] / 2)
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
