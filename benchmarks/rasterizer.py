"""Times and memory of the rasterizer's CPU backends, forward and backward with binning, beside other formulations.

    OMP_WAIT_POLICY=PASSIVE python benchmarks/rasterizer.py --threads 1 2

The variants take turns in one process; the fastest and the median repetition are printed, in milliseconds, wall and
CPU time of all threads. CPU time hardly depends on what else the machine does; wall time means something only on an
idle one. The scene is a ball and a box that cover about a third of the image.
"""

import argparse
import ctypes
import functools
import gc
import importlib.util
import math
import re
import statistics
import subprocess
import sys
import time
from pathlib import Path

import peers
import torch

from splatart_ns.rasterize import numba_backend, torch_backend
from splatart_ns.rasterize.rasterization import rasterization
from splatart_ns.rasterize.ssim import l1_ssim_loss

SIZES = [(2_000, 128, 3), (10_000, 128, 3), (10_000, 256, 3), (10_000, 256, 12), (50_000, 400, 3)]
LARGE_SIZES = [(50_000, 400, 12), (10_000, 800, 3), (200_000, 800, 3)]
PEER_UP_TO = 10_000
"""Gaussians beyond which gsplat's formulation is left out: it takes seconds."""


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


def rasterizing(function, arguments, width):
    def step():
        image, alpha = function(*arguments, width, width)
        torch.autograd.grad([image, alpha], arguments[:4], [v_image, v_alpha])

    v_image = torch.randn(1, width, width, arguments[3].shape[-1], generator=torch.Generator().manual_seed(2))
    v_alpha = torch.randn(1, width, width, 1, generator=torch.Generator().manual_seed(3))
    return step


def backends(arguments, width, with_peer=False):
    functions = {
        "torch": torch_backend.rasterize_to_pixels,
        "numba": numba_backend.rasterize_to_pixels,
        "numba, absgrad": functools.partial(numba_backend.rasterize_to_pixels, absgrad=True),
    }
    if with_peer and importlib.util.find_spec("gsplat") and importlib.util.find_spec("nerfacc"):
        functions["gsplat's torch formulation"] = peers.gsplat_formulation
    return {name: rasterizing(function, arguments, width) for name, function in functions.items()}


def training_steps(count, width):
    """Projection, spherical harmonics of degree 3, rasterization, 0.8 L1 + 0.2 (1 - SSIM), Adam."""

    def step(backend, parameters, optimizer):
        means, quats, log_scales, logits, sh = parameters
        geometry = means, quats, log_scales.exp(), logits.sigmoid(), sh
        image, _, _ = rasterization(*geometry, viewmats, Ks, width, width, sh_degree=3, absgrad=True, backend=backend)
        l1_ssim_loss(image[0], target).backward()
        optimizer.step()
        optimizer.zero_grad()

    scene = two_part_object(count, width)
    viewmats, Ks = scene["viewmats"], scene["Ks"]
    generator = torch.Generator().manual_seed(4)
    target = torch.rand(width, width, 3, generator=generator)
    sh = 0.3 * torch.randn(count, 16, 3, generator=generator)
    start = scene["means"], scene["quats"], scene["scales"].log(), scene["opacities"].logit(1e-3), sh
    steps = {}
    for backend in ("torch", "numba"):
        parameters = [tensor.clone().requires_grad_() for tensor in start]
        optimizer = torch.optim.Adam(parameters, lr=1e-6, fused=True)
        steps[backend] = functools.partial(step, backend, parameters, optimizer)
    return steps


def losses(width):
    """Steps of 0.8 L1 + 0.2 (1 - SSIM) on one image."""
    target = torch.rand(width, width, 3, generator=torch.Generator().manual_seed(4))
    noise = torch.randn(width, width, 3, generator=torch.Generator().manual_seed(5))
    image = (target + 0.1 * noise).clamp(0, 1).requires_grad_()
    steps = {"ours": lambda: torch.autograd.grad(l1_ssim_loss(image, target), image)}
    if importlib.util.find_spec("pytorch_msssim"):
        from pytorch_msssim import SSIM

        similarity = SSIM(data_range=1.0, size_average=True, channel=3)

        def msssim():
            x, y = image.movedim(-1, 0)[None], target.movedim(-1, 0)[None]
            loss = 0.8 * (image - target).abs().mean() + 0.2 * (1 - similarity(x, y))
            torch.autograd.grad(loss, image)

        steps["pytorch_msssim"] = msssim
    return steps


def take_turns(steps: dict, seconds: float) -> dict[str, tuple[float, float, float]]:
    """Fastest and median wall time and least CPU time of each step, ms."""
    wall, cpu = {name: [] for name in steps}, {name: [] for name in steps}
    for step in steps.values():
        step()
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or min(map(len, wall.values())) < 5:
        for name, step in steps.items():
            step()  # so that what the others leave in caches and in the allocator does not count
            begin, begin_cpu = time.perf_counter(), time.process_time()
            step()
            cpu[name].append(1e3 * (time.process_time() - begin_cpu))
            wall[name].append(1e3 * (time.perf_counter() - begin))
    return {name: (min(wall[name]), statistics.median(wall[name]), min(cpu[name])) for name in steps}


def report(what, steps, settings):
    for threads in settings.threads:
        torch.set_num_threads(threads)
        for variant, times in take_turns(steps, settings.seconds).items():
            fastest, median, cpu = (f"{t:9.2f}" for t in times)
            print(f"{what:34} {threads:7}   {variant:27} {fastest} {median} {cpu}", flush=True)


def print_memory(count, width, channels, variant):
    """What forward and backward add to the memory of a process that has compiled all it needs (Linux)."""

    def resident(which):
        return int(re.search(which + r":\s+(\d+) kB", Path("/proc/self/status").read_text())[1]) / 1024

    torch.set_num_threads(1)
    backends(projected(100, 64, channels), 64, True)[variant]()
    step = backends(projected(count, width, channels), width, True)[variant]
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # so that memory that is kept for reuse does not hide what the step needs
    before = resident("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    step()
    peak = resident("VmHWM") - before
    print(f"{count} Gaussians, {width}^2, {channels} channels: {variant:27} {peak:7.1f} MiB", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--seconds", type=float, default=4, help="per line of the table")
    parser.add_argument("--large", action="store_true", help="also the sizes that take long in torch")
    parser.add_argument("--memory-of", help=argparse.SUPPRESS)
    settings = parser.parse_args()
    if settings.memory_of:
        return print_memory(10_000, 256, 3, settings.memory_of)

    header = f"{'fastest':>9} {'median':>9} {'CPU':>9}"
    print(f"{'what':34} {'threads':>7}   {'variant':27} {header}  ms, forward + backward")
    for count, width, channels in SIZES + LARGE_SIZES * settings.large:
        steps = backends(projected(count, width, channels), width, count <= PEER_UP_TO)
        report(f"{count} Gaussians, {width}^2, {channels} channels", steps, settings)
    report("whole step, 10000 Gaussians, 256^2", training_steps(10_000, 256), settings)
    for width in (128, 256, 400):
        report(f"L1 + SSIM, {width}^2", losses(width), settings)
    print("\nPeak memory above that before, one process each", flush=True)
    for variant in backends(projected(100, 64, 3), 64, True):
        subprocess.run([sys.executable, __file__, "--memory-of", variant], check=True)


if __name__ == "__main__":
    main()
