"""Times of the rasterizer's CPU backends and of the image loss, forward and backward.

    python benchmarks/rasterizer.py --threads 1 2

The variants take turns in one process; the fastest and the median repetition are printed, in milliseconds. For numbers
that mean something with more than one thread, set OMP_WAIT_POLICY=PASSIVE and let nothing else run.
"""

import argparse
import math
import statistics
import time

import torch
from pytorch_msssim import SSIM

from splatart_ns.rasterize import numba_backend, torch_backend
from splatart_ns.rasterize.rasterization import rasterization
from splatart_ns.rasterize.ssim import l1_ssim_loss

SIZES = [(2_000, 128, 3), (10_000, 128, 3), (10_000, 256, 3), (10_000, 256, 12), (20_000, 256, 3), (50_000, 400, 3)]
LARGE_SIZES = [(50_000, 400, 12), (10_000, 800, 3), (200_000, 800, 3)]


def two_part_object(count: int, width: int) -> dict:
    """Surface Gaussians of a ball and a flat box before one camera; they cover about a third of the image."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape, low=0.0, high=1.0):
        return torch.rand(*shape, generator=generator) * (high - low) + low

    ball = torch.nn.functional.normalize(torch.randn(count // 2, 3, generator=generator), dim=-1)
    box = uniform(count - count // 2, 3, low=-1.0)
    side = torch.randint(3, (len(box),), generator=generator)
    box_normals = torch.nn.functional.one_hot(side, 3) * box.sign()
    box = box.where(box_normals == 0, box_normals)
    means = torch.cat([0.42 * ball + torch.tensor([-0.42, 0, 0]), 0.4 * box + torch.tensor([0.45, 0.05, 0])])
    normals = torch.cat([ball, box_normals])
    z = torch.tensor([0.0, 0.0, 1.0]).expand_as(normals)
    quats = torch.cat([1 + normals[:, 2:] + 1e-3, torch.linalg.cross(z, normals)], -1)
    tangent = uniform(count, 2, low=math.log(0.005), high=math.log(0.015)).exp() * 2
    scales = torch.cat([tangent, uniform(count, 1, low=0.004, high=0.008)], -1)
    opacities = uniform(count) ** (1 / 1.5)
    viewmats = torch.eye(4)[None].clone()
    viewmats[:, 2, 3] = 3.2
    focal = 1.05 * width
    Ks = torch.tensor([[[focal, 0, width / 2], [0, focal, width / 2], [0, 0, 1]]])
    return dict(means=means, quats=quats, scales=scales, opacities=opacities, viewmats=viewmats, Ks=Ks)


def projected(count: int, width: int, channels: int) -> list[torch.Tensor]:
    """means2d, conics, opacities, colors (to be differentiated), depths and visible."""
    colors = torch.rand(count, channels, generator=torch.Generator().manual_seed(1))
    scene = two_part_object(count, width)
    _, _, info = rasterization(**scene, colors=colors, width=width, height=width, backend="torch")
    leaves = [info["means2d"], info["conics"], info["opacities"], colors[None]]
    leaves = [t.detach().contiguous().requires_grad_() for t in leaves]
    return [*leaves, info["depths"].detach().contiguous(), info["radii"] > 0]


def rasterizing(backend, arguments, width, absgrad=False):
    def step():
        image, alpha = backend.rasterize_to_pixels(*arguments, width, width, absgrad)
        torch.autograd.grad([image, alpha], arguments[:4], [v_image, v_alpha])

    v_image = torch.randn(1, width, width, arguments[3].shape[-1], generator=torch.Generator().manual_seed(2))
    v_alpha = torch.randn(1, width, width, 1, generator=torch.Generator().manual_seed(3))
    return step


def losses(width):
    """Steps of 0.8 L1 + 0.2 (1 - SSIM) on one image."""
    target = torch.rand(width, width, 3, generator=torch.Generator().manual_seed(4))
    noise = torch.randn(width, width, 3, generator=torch.Generator().manual_seed(5))
    image = (target + 0.1 * noise).clamp(0, 1).requires_grad_()
    similarity = SSIM(data_range=1.0, size_average=True, channel=3)

    def msssim():
        x, y = image.movedim(-1, 0)[None], target.movedim(-1, 0)[None]
        loss = 0.8 * (image - target).abs().mean() + 0.2 * (1 - similarity(x, y))
        torch.autograd.grad(loss, image)

    def ours():
        torch.autograd.grad(l1_ssim_loss(image, target), image)

    return {"pytorch_msssim": msssim, "ours": ours}


def take_turns(steps: dict, seconds: float) -> dict[str, tuple[float, float]]:
    """Fastest and median time of each step, ms."""
    times = {name: [] for name in steps}
    for step in steps.values():
        step()
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or min(map(len, times.values())) < 5:
        for name, step in steps.items():
            begin = time.perf_counter()
            step()
            times[name].append(1e3 * (time.perf_counter() - begin))
    return {name: (min(t), statistics.median(t)) for name, t in times.items()}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--seconds", type=float, default=4, help="per line of the table")
    parser.add_argument("--large", action="store_true", help="also the sizes that take long in torch")
    settings = parser.parse_args()

    print(f"{'what':34} {'threads':>7}   {'variant':16} {'fastest':>8} {'median':>8}  ms, forward + backward")
    for count, width, channels in SIZES + LARGE_SIZES * settings.large:
        arguments = projected(count, width, channels)
        steps = {
            "torch": rasterizing(torch_backend, arguments, width),
            "numba": rasterizing(numba_backend, arguments, width),
            "numba, absgrad": rasterizing(numba_backend, arguments, width, absgrad=True),
        }
        report(f"{count} Gaussians, {width}^2, {channels} channels", steps, settings)
    for width in (128, 256, 400):
        report(f"L1 + SSIM, {width}^2", losses(width), settings)


def report(what, steps, settings):
    for threads in settings.threads:
        torch.set_num_threads(threads)
        for variant, (fastest, median) in take_turns(steps, settings.seconds).items():
            print(f"{what:34} {threads:7}   {variant:16} {fastest:8.2f} {median:8.2f}", flush=True)


if __name__ == "__main__":
    main()
