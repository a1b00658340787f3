"""From Gaussians to pixels and their loss, each step beside its definition in many digits."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import many_digits as md
import mpmath
import torch
from domains import SCALES, intrinsics, numbers, tensor
from mpmath import mpf
from precision import Case, Operation
from torch import Tensor

from splatart_ns.rasterize import numba_projection, projection, torch_backend
from splatart_ns.rasterize.rasterization import sh_colors
from splatart_ns.rasterize.ssim import l1_ssim_loss
from splatart_ns.rasterize.strategies import compute_relocation

FLOAT = (torch.float32,)
COPIES = 51
"""The most Gaussians that may be put in the place of one."""

QUATERNION = (0.9, 0.2, -0.35, 0.15)


def projected(project: Callable[..., projection.Projection]) -> Callable[..., list[Tensor]]:
    def outputs(mean: Tensor, quat: Tensor, scales: Tensor) -> list[Tensor]:
        result = project(
            *(mean[None], quat[None], scales[None], torch.eye(4).to(mean)[None], intrinsics(mean)[None], 45, 35),
            near_plane=1e-12,
        )
        return [result.means2d, result.conics, result.compensations]

    return outputs


def exact_projection(mean: Sequence[mpf], quat: Sequence[mpf], scales: Sequence[mpf]) -> list[list[mpf]]:
    x, y, z = mean
    J = [[50 / z, mpf(0), -50 * x / z**2], [mpf(0), 48 / z, -48 * y / z**2]]
    A = md.matmul(
        J, md.matmul(md.matrix_of_quaternion(quat), [[s * (i == j) for j in range(3)] for i, s in enumerate(scales)])
    )
    C = md.matmul(A, md.transpose(A))
    eps = mpf(0.3)
    sharp, det = C[0][0] * C[1][1] - C[0][1] ** 2, (C[0][0] + eps) * (C[1][1] + eps) - C[0][1] ** 2
    conic = [(C[1][1] + eps) / det, -C[0][1] / det, (C[0][0] + eps) / det]
    return [[50 * x / z + 22, 48 * y / z + 18], conic, [mpmath.sqrt(sharp / det)]]


def gaussian_before_camera(depth: float, size: float, ratio: float) -> tuple[Tensor, ...]:
    """At a depth, of a size (its longest axis) in shares of the depth, and as many times longer than wide."""
    scales = depth * size * tensor(1.0, 1 / ratio, 1 / ratio)
    return tensor(0.3 * depth, -0.2 * depth, depth), tensor(*QUATERNION), scales


def projections(name: str, project: Callable, dtypes: Sequence[torch.dtype]) -> list[Operation]:
    settings = dict(function=projected(project), reference=exact_projection, differentiated=(0, 1, 2), dtypes=dtypes)
    ratios, sizes = (1, 3, 10, 100, 1000, 1e4, 1e6), (1e-6, 1e-4, 0.01, 0.1, 1, 10)
    return [
        Operation(
            f"covariance to 2D{name}: needles",
            "length / width",
            cases=[Case(r, gaussian_before_camera(2.0, size, r)) for r in ratios for size in (0.02, 0.5)],
            **settings,
        ),
        Operation(
            f"covariance to 2D{name}: size",
            "size / depth",
            cases=[Case(size, gaussian_before_camera(2.0, size, 3)) for size in sizes],
            **settings,
        ),
        Operation(
            f"covariance to 2D{name}: scale of the world, depth",
            "depth",
            cases=[Case(depth, gaussian_before_camera(depth, 0.05, 3)) for depth in SCALES],
            **settings,
        ),
    ]


def stack_cases(layers: Sequence[int], opacity: float | None = None, place: str = "layers") -> list[Case]:
    """One pixel's Gaussians near to far: centres, conics, opacities, colours.

    Opacities are such that the pixel is nearly full behind the last, or all the same.
    """
    cases = []
    for n in layers:
        o = opacity or min(0.9, 1 - 1e-3 ** (1 / n)) + 1.05 / 255
        centres = 0.5 + 0.02 * numbers(2 * n, n)
        conics = tensor(0.5, 0.1, 0.4).repeat(n) * (1 + 0.1 * numbers(n, n + 1).sigmoid().repeat_interleave(3))
        opacities = torch.full((n,), o, dtype=torch.float64)
        probes = [(i, k * w + j) for i, w in ((0, 2), (1, 3), (2, 1), (3, 3)) for k in {0, n // 2} for j in {0, w - 1}]
        cases.append(Case(n if place == "layers" else o, (centres, conics, opacities, numbers(3 * n, n + 2)), probes))
    return cases


def opacity_cases() -> list[Case]:
    """Three layers whose first has an opacity up to 1; alphas end at 0.999."""
    cases = []
    for o in (1.001 / 255, 0.01, 0.5, 0.9, 0.99, 0.998, 0.9995, 1.0):
        centres, conics, opacities, colours = stack_cases([3], 0.5)[0].inputs
        opacities = torch.cat([tensor(o), opacities[1:]])
        centres = torch.full_like(centres, 0.5)
        cases.append(Case(o, (centres, conics, opacities, colours)))
    return cases


def composited(rasterize: Callable) -> Callable[..., list[Tensor]]:
    def outputs(centres: Tensor, conics: Tensor, opacities: Tensor, colours: Tensor) -> list[Tensor]:
        n = len(opacities)
        depths, visible = torch.arange(n).to(centres)[None] + 1, torch.ones(1, n, dtype=torch.bool)
        shaped = centres.reshape(1, n, 2), conics.reshape(1, n, 3), opacities[None], colours.reshape(1, n, 3)
        image, alpha = rasterize(*shaped, depths, visible, 1, 1)
        return [image, alpha]

    return outputs


def exact_composite(
    centres: Sequence[mpf], conics: Sequence[mpf], opacities: Sequence[mpf], colours: Sequence[mpf]
) -> list[list[mpf]]:
    passed, image = mpf(1), [mpf(0)] * 3
    for (x, y), (a, b, c), opacity, colour in zip(
        md.rows(centres, 2), md.rows(conics, 3), opacities, md.rows(colours, 3), strict=True
    ):
        dx, dy = x - 0.5, y - 0.5
        alpha = opacity * mpmath.exp(-(a * dx * dx + c * dy * dy) / 2 - b * dx * dy)
        if alpha < mpf(1) / 255:
            continue
        alpha = min(alpha, mpf("0.999"))
        if passed * (1 - alpha) <= mpf("1e-4"):
            break
        image = [v + passed * alpha * k for v, k in zip(image, colour, strict=True)]
        passed *= 1 - alpha
    return [image, [1 - passed]]


def compositing(name: str, rasterize: Callable, dtypes: Sequence[torch.dtype]) -> list[Operation]:
    settings = dict(
        function=composited(rasterize), reference=exact_composite, differentiated=(0, 1, 2, 3), dtypes=dtypes
    )
    return [
        Operation(
            f"compositing{name}: deep stacks", "layers", cases=stack_cases((1, 3, 10, 30, 100, 300, 1000)), **settings
        ),
        Operation(f"compositing{name}: opacity", "opacity", cases=opacity_cases(), **settings),
    ]


def numba_rasterize(*arguments) -> tuple[Tensor, Tensor]:
    from splatart_ns.rasterize import numba_backend

    return numba_backend.rasterize_to_pixels(*arguments)


def colours_seen(backend: str) -> Callable[..., list[Tensor]]:
    return lambda mean, sh: [sh_colors(mean[None], sh.reshape(1, 16, 3), torch.eye(4).to(mean)[None], 3, backend)]


def exact_colours(mean: Sequence[mpf], sh: Sequence[mpf]) -> list[list[mpf]]:
    length = md.norm(mean)
    basis = md.sh_basis([v / length for v in mean])
    return [[mpf(0.5) + sum(b * c[k] for b, c in zip(basis, md.rows(sh, 3), strict=True)) for k in range(3)]]


def sh_evaluation(name: str, backend: str, dtypes: Sequence[torch.dtype]) -> Operation:
    """Coefficients large in the constant band, so that no colour is cut off at 0."""
    sh = 0.3 * numbers(48, 5)
    sh[:3] = 6
    return Operation(
        f"evaluation of spherical harmonics{name}",
        "distance",
        colours_seen(backend),
        exact_colours,
        [Case(s, (s * tensor(*axis), sh)) for s in SCALES for axis in ((0.36, -0.48, 0.8), (0.0, 0.0, 1.0))],
        differentiated=(0, 1),
        dtypes=dtypes,
    )


def image_pairs() -> list[Case]:
    """Pairs of 12 x 12 images whose contrast shrinks, around grey."""
    cases = []
    for contrast in (1.0, 0.1, 0.01, 1e-3, 1e-4, 0.0):
        image, target = ((0.7 + contrast * 0.2 * numbers(432, seed).tanh()) for seed in (3, 4))
        cases.append(Case(contrast, (image, target), probes=[(0, k) for k in (0, 100, 215, 431)]))
    return cases


def exact_loss(image: Sequence[mpf], target: Sequence[mpf]) -> list[list[mpf]]:
    """0.8 L1 + 0.2 (1 - SSIM) of 12 x 12 images with 3 channels: two places each way for the window."""
    weights = [mpmath.exp(-mpf((t - 5) ** 2) / (2 * mpf(1.5) ** 2)) for t in range(11)]
    total = mpmath.fsum(weights)
    weights = [w / total for w in weights]
    scores = []
    for i in (0, 1):
        for j in (0, 1):
            for channel in range(3):
                pixels = [
                    (weights[r] * weights[c], 36 * (i + r) + 3 * (j + c) + channel)
                    for r in range(11)
                    for c in range(11)
                ]
                mx, my = (mpmath.fsum(w * x[p] for w, p in pixels) for x in (image, target))
                xx = mpmath.fsum(w * (image[p] - mx) ** 2 for w, p in pixels)
                yy = mpmath.fsum(w * (target[p] - my) ** 2 for w, p in pixels)
                xy = mpmath.fsum(w * (image[p] - mx) * (target[p] - my) for w, p in pixels)
                c1, c2 = mpf("1e-4"), mpf("9e-4")
                scores.append((2 * mx * my + c1) * (2 * xy + c2) / ((mx * mx + my * my + c1) * (xx + yy + c2)))
    l1 = mpmath.fsum(abs(a - b) for a, b in zip(image, target, strict=True)) / len(image)
    return [[mpf("0.8") * l1 + mpf("0.2") * (1 - mpmath.fsum(scores) / len(scores))]]


def exact_relocation(opacity: Sequence[mpf], scales: Sequence[mpf]) -> list[list[mpf]]:
    """Equation 9 of Kheradmand et al. 2024 for `COPIES` Gaussians in one place, sum for sum."""
    old, n = opacity[0], COPIES
    new = 1 - (1 - old) ** (mpf(1) / n)
    total = mpf(0)
    for i in range(1, n + 1):
        for k in range(i):
            total += mpmath.binomial(i - 1, k) * (-1) ** k / mpmath.sqrt(k + 1) * new ** (k + 1)
    return [[new], [s * old / total for s in scales]]


def relocated(opacity: Tensor, scales: Tensor) -> list[Tensor]:
    ratios = torch.full_like(opacity, COPIES, dtype=torch.int32)
    return list(compute_relocation(opacity, scales[None], ratios, torch.zeros(51, 51).to(opacity)))


IMAGES = [
    *projections(", torch", projection.project, (torch.float32, torch.float64)),
    *projections(", numba", numba_projection.project, FLOAT),
    *compositing(", torch", torch_backend.rasterize_to_pixels, (torch.float32, torch.float64)),
    *compositing(", numba", numba_rasterize, FLOAT),
    sh_evaluation(", torch", "torch", (torch.float32, torch.float64)),
    sh_evaluation(", numba", "numba", FLOAT),
    Operation(
        "L1 + SSIM loss",
        "contrast",
        lambda image, target: [l1_ssim_loss(image.reshape(12, 12, 3), target.reshape(12, 12, 3))],
        exact_loss,
        image_pairs(),
        differentiated=(0,),
        note="the value, near 0, is a difference to 1; variances are differences of moments, which costs images of "
        "little contrast two digits of the gradient (float32 runs in numba, float64 in torch)",
    ),
    Operation(
        f"relocation of {COPIES} Gaussians",
        "opacity",
        relocated,
        exact_relocation,
        [Case(o, (tensor(o), tensor(0.1, 0.02, 0.3))) for o in (1e-4, 0.005, 0.1, 0.5, 0.9, 0.999, 1 - 1e-6, 1.0)],
        note="by an integral; the sum over 51 terms of changing sign loses all digits at an opacity of 1",
    ),
]
