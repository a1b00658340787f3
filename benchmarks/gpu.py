"""What a GPU gives: how the rasterizer's backends agree on it, their times and memory, and a training step's.

    python benchmarks/gpu.py --capture CAPTURE --output gpu.json

CAPTURE is any capture; its first state is trained on for the last part, beside nerfstudio's own splatfacto. Times of
the rasterizer are medians by CUDA events, of whole steps wall time of many; the variants take turns.
"""

from __future__ import annotations

import argparse
import copy
import functools
import gc
import json
import statistics
import tempfile
import time
from pathlib import Path
from unittest import mock

import torch
from rasterizer import two_part_object

from splatart_ns.rasterize.rasterization import rasterization
from splatart_ns.rasterize.ssim import l1_ssim_loss

SIZES = [(10_000, 256, 3), (10_000, 256, 12), (50_000, 400, 3), (200_000, 800, 3)]
LEAVES = ("means", "quats", "scales", "opacities", "colors", "viewmats")
WHOLE = 0.35
"""Up to this opacity alpha is below 1/255, so that nobody draws it, where gsplat's Gaussians end, at 3 deviations."""


def scene(count: int, width: int, channels: int = 3, opacity: float = 1.0) -> dict:
    """Arguments of `rasterization`, on CUDA."""
    given = two_part_object(count, width) | {"width": width, "height": width}
    given["opacities"] = given["opacities"] * opacity
    given["colors"] = torch.rand(count, channels, generator=torch.Generator().manual_seed(1))
    return {name: x.cuda() if torch.is_tensor(x) else x for name, x in given.items()}


def outcome(given: dict, backend: str, dtype: torch.dtype = torch.float32) -> dict[str, torch.Tensor]:
    """Image with accumulation and depth, and all gradients of a random functional of it, float64 on the CPU."""
    given = {name: x.to(dtype) if torch.is_tensor(x) else x for name, x in given.items()}
    for name in LEAVES:
        given[name] = given[name].clone().requires_grad_()
    image = torch.cat(rasterization(**given, render_mode="RGB+D", backend=backend)[:2], -1)
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(2)).to(image)
    gradients = torch.autograd.grad(image, [given[name] for name in LEAVES], weights)
    return {name: x.detach().cpu().double() for name, x in zip(("image", *LEAVES), (image, *gradients), strict=True)}


def agreement() -> dict[str, dict[str, float]]:
    """Relative L2 distances to the torch backend in float64 on the CPU."""
    found = {}
    for what, opacity in (("opacities to 1", 1.0), (f"to {WHOLE}", WHOLE)):
        given = scene(10_000, 256, opacity=opacity)
        on_cpu = {name: x.cpu() if torch.is_tensor(x) else x for name, x in given.items()}
        truth = outcome(on_cpu, "torch", torch.float64)
        variants = {
            "gsplat": outcome(given, "gsplat"),
            "torch on CUDA": outcome(given, "torch"),
            "torch on CUDA, float64": outcome(given, "torch", torch.float64),
            "torch on the CPU": outcome(on_cpu, "torch"),
        }
        for variant, values in variants.items():
            line = {name: float((x - truth[name]).norm() / truth[name].norm()) for name, x in values.items()}
            found[f"{variant}, {what}"] = line
            print(f"{variant + ', ' + what:38}", *(f"{name} {x:.1e}" for name, x in line.items()), flush=True)
    return found


def by_events(steps: dict, repetitions: int) -> dict[str, float]:
    """Median ms of each step, in turns."""
    times: dict[str, list[float]] = {name: [] for name in steps}
    for turn in range(repetitions + 3):
        for name, step in steps.items():
            start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            start.record()
            step()
            end.record()
            end.synchronize()
            if turn >= 3:
                times[name].append(start.elapsed_time(end))
    return {name: statistics.median(values) for name, values in times.items()}


def rasterizing(given: dict, backend: str):
    def step():
        image, alpha, _ = rasterization(**given, backend=backend)
        torch.autograd.grad([image, alpha], [given[name] for name in LEAVES[:-1]], [v_image, v_alpha])

    given = {name: x.clone().requires_grad_() if name in LEAVES[:-1] else x for name, x in given.items()}
    size = (1, given["height"], given["width"])
    v_image, v_alpha = (torch.randn(*size, c, device="cuda") for c in (given["colors"].shape[-1], 1))
    return step


def times() -> list[dict]:
    """Of forward and backward, projection and binning with it, in ms, and what it adds to the memory in MiB."""
    rows = []
    for count, width, channels in SIZES:
        steps = {name: rasterizing(scene(count, width, channels), name) for name in ("gsplat", "torch")}
        row = {"gaussians": count, "width": width, "channels": channels, "ms": by_events(steps, 15), "mib": {}}
        for name, step in steps.items():
            gc.collect()
            torch.cuda.reset_peak_memory_stats()
            before = torch.cuda.memory_allocated()
            step()
            row["mib"][name] = (torch.cuda.max_memory_allocated() - before) / 2**20
        rows.append(row)
        print(row, flush=True)
    return rows


def loss_times() -> list[dict]:
    """Of L1 and SSIM with their gradient, in ms."""
    from pytorch_msssim import SSIM

    def theirs(image, target, similarity):
        x, y = (a.movedim(-1, 0)[None] for a in (image, target))
        torch.autograd.grad(0.8 * (image - target).abs().mean() + 0.2 * (1 - similarity(x, y)), image)

    def ours(image, target):
        torch.autograd.grad(l1_ssim_loss(image, target), image)

    rows = []
    for width in (256, 800):
        target = torch.rand(width, width, 3, device="cuda")
        image = (target + 0.1 * torch.randn_like(target)).clamp(0, 1).requires_grad_()
        similarity = SSIM(data_range=1.0, size_average=True, channel=3).cuda()
        steps = {
            "ours": functools.partial(ours, image, target),
            "pytorch_msssim": functools.partial(theirs, image, target, similarity),
        }
        rows.append({"width": width, "ms": by_events(steps, 30)})
        print(rows[-1], flush=True)
    return rows


def trainers(capture: Path, folder: Path) -> dict:
    """Set-up trainers of stage 1 and of splatfacto on the first state, with the same Gaussians."""
    from nerfstudio.configs.method_configs import method_configs
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
    from torch import nn
    from torchmetrics.image import lpip

    from splatart_ns.capture.formats import load_capture
    from splatart_ns.method_configs.semantic import method

    state = load_capture(capture).states[0].name
    configs = {"splatfacto": method_configs["splatfacto"], "splatart": method.config, "splatart, SH 3": method.config}
    configs = {name: copy.deepcopy(config) for name, config in configs.items()}
    configs["splatfacto"].pipeline.datamanager.dataparser = NerfstudioDataParserConfig(
        data=capture / state, load_3D_points=False, eval_mode="all"
    )
    configs["splatart, SH 3"].pipeline.model.sh_degree = 3
    for name in ("splatart", "splatart, SH 3"):
        configs[name].pipeline.datamanager.dataparser.data = capture
    ready = {}
    with mock.patch.object(lpip, "LearnedPerceptualImagePatchSimilarity", lambda **_: nn.Identity()):
        for name, config in configs.items():
            config.output_dir, config.experiment_name, config.timestamp = folder, name.replace(", ", "_"), "run"
            config.vis, config.machine.device_type = "tensorboard", "cuda"
            config.pipeline.model.num_downscales = 0
            config.pipeline.model.background_color = "random"
            ready[name] = config.setup(local_rank=0, world_size=1)
            ready[name].setup()
    donor = ready["splatart, SH 3"].pipeline.model.gauss_params
    for trainer in ready.values():
        model, optimizers = trainer.pipeline.model, trainer.optimizers.optimizers
        for name, old in list(model.gauss_params.items()):
            new = donor[name].detach().clone()
            new = nn.Parameter(new[:, : old.shape[1]].contiguous() if name == "features_rest" else new)
            model.gauss_params[name] = new
            optimizers[name].param_groups[0]["params"] = [new]
        model.optimizers, model.config.sh_degree_interval = optimizers, 100
    return ready


def step_times(capture: Path) -> dict:
    """Wall ms of a training step without densification, and peak MiB of the process's tensors."""
    with tempfile.TemporaryDirectory() as folder:
        ready = trainers(capture, Path(folder))
        walls: dict[str, list[float]] = {name: [] for name in ready}
        for turn in range(6):
            for name, trainer in ready.items():
                torch.cuda.synchronize()
                start = time.perf_counter()
                for step in range(900, 950):  # of 1000 on colours, with all bands of spherical harmonics
                    trainer.pipeline.model.step = step
                    trainer.train_iteration(step)
                torch.cuda.synchronize()
                if turn > 0:
                    walls[name].append((time.perf_counter() - start) / 50 * 1e3)
        count = ready["splatart"].pipeline.model.num_points
    found = {"gaussians": count, "ms": {name: statistics.median(values) for name, values in walls.items()}}
    print(found, flush=True)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--output", type=Path)
    settings = parser.parse_args()
    if not torch.cuda.is_available():
        raise SystemExit("There is no CUDA here.")
    print(torch.cuda.get_device_name())
    found = {"device": torch.cuda.get_device_name(), "agreement": agreement(), "times": times(), "loss": loss_times()}
    if settings.capture:
        found["step"] = step_times(settings.capture)
    if settings.output:
        settings.output.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
