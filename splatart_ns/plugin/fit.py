"""All stages in one process, resumable: `splatart fit`."""

from __future__ import annotations

import copy
import json
import platform
import resource
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from splatart_ns.capture.capture import Capture
from splatart_ns.capture.check import require_valid
from splatart_ns.errors import InputError
from splatart_ns.files import write_json
from splatart_ns.method_configs.joint import method as joint_method
from splatart_ns.method_configs.pose import method as pose_method
from splatart_ns.method_configs.semantic import method as semantic_method
from splatart_ns.plugin.compat import seed_everything
from splatart_ns.rasterize.rasterization import default_backend

Quality = Literal["draft", "standard", "high"]


@dataclass(frozen=True)
class Effort:
    """How much work a quality stands for."""

    gaussians: int
    """Gaussians that each state starts from."""
    steps: int
    """Steps on geometry and colour of each state."""
    pose_steps: int
    """Steps on the poses, Gaussians frozen."""
    merge_steps: int
    """Steps on the merged Gaussians of all states."""


EFFORTS: dict[Quality, Effort] = {
    "draft": Effort(gaussians=4000, steps=400, pose_steps=100, merge_steps=150),
    "standard": Effort(gaussians=8000, steps=1000, pose_steps=200, merge_steps=400),
    "high": Effort(gaussians=16000, steps=3000, pose_steps=400, merge_steps=1500),
}


@dataclass(frozen=True)
class Settings:
    """What decides the result of a fit, besides the capture."""

    quality: Quality
    root: str | None
    seed: int


class Report:
    """report.json: which stages have finished, and what they took. Written after each stage."""

    def __init__(self, path: Path, capture: Path, settings: Settings):
        self.path = path
        self.data: dict[str, Any] = {
            "capture": str(capture),
            "settings": asdict(settings),
            "seed": settings.seed,
            "device": "cuda: " + torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu",
            "rasterizer": default_backend(),
            "threads": torch.get_num_threads(),
            "versions": {"python": platform.python_version()}
            | {name: version(name) for name in ("splatart-ns", "nerfstudio", "torch", "gsplat", "numpy")},
            "stages": [],
        }
        if path.exists():
            try:
                earlier = json.loads(path.read_text())
                same = all(earlier[key] == self.data[key] for key in ("capture", "settings"))
                stages = earlier["stages"] if same else []
            except (ValueError, KeyError, TypeError):
                raise InputError(
                    f"{path} is not a report of `splatart fit`; remove it or choose another folder."
                ) from None
            self.data["stages"] = stages

    def finished(self, stage: str) -> bool:
        return any(entry["name"] == stage for entry in self.data["stages"])

    def add(self, **entry: Any) -> None:
        """Note a finished stage."""
        self.data["stages"].append(entry)
        self.data["seconds"] = round(sum(e["seconds"] for e in self.data["stages"]), 2)
        write_json(self.path, self.data)


def fit(
    capture_path: Path, output_dir: Path, quality: Quality = "standard", root: str | None = None, seed: int = 0
) -> Path:
    """Run what is missing of all stages and leave the bundle in `output_dir`.

    Raises:
        InputError: for a capture, a root or a folder that cannot be used.
    """
    capture = require_valid(capture_path)
    if root is not None and root not in capture.parts.values():
        raise InputError(
            f"{capture_path} has no part '{root}'; choose --root from {', '.join(capture.parts.values())}."
        )
    output_dir = output_dir.absolute()
    try:
        (output_dir / "runs").mkdir(parents=True, exist_ok=True)
        probe = output_dir / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"{output_dir} cannot be written ({error.strerror}); choose another --output-dir.") from None

    report = Report(output_dir / "report.json", capture_path.absolute(), Settings(quality, root, seed))
    effort = EFFORTS[quality]
    semantic_runs = []
    with _progress() as progress:
        for index, state in enumerate(capture.states):
            config = _semantic_config(capture, index, effort, seed)
            semantic_runs.append(_run(f"semantic {state.name}", config, output_dir, state.name, report, progress))
        config = _pose_config(capture, semantic_runs, effort, seed)
        pose_run = _run("pose", config, output_dir, "all", report, progress)
        config = _joint_config(capture, pose_run, output_dir, root, seed)
        _run("joint", config, output_dir, "all", report, progress)
    return output_dir


def _semantic_config(capture: Capture, state: int, effort: Effort, seed: int) -> TrainerConfig:
    config = copy.deepcopy(semantic_method.config)
    part_steps = config.max_num_iterations - config.pipeline.model.semantic_start
    config.max_num_iterations = effort.steps + part_steps
    config.pipeline.model.semantic_start = effort.steps
    for optimizer in config.optimizers.values():
        if optimizer["scheduler"] is not None:
            optimizer["scheduler"].max_steps = effort.steps
    config.pipeline.datamanager.seed_gaussians = effort.gaussians
    config.pipeline.datamanager.seed = seed
    return _with_data(config, capture, state, seed)


def _pose_config(capture: Capture, semantic_runs: list[Path], effort: Effort, seed: int) -> TrainerConfig:
    config = copy.deepcopy(pose_method.config)
    config.pipeline.semantic_runs = tuple(semantic_runs)
    config.pipeline.model.pose_steps = effort.pose_steps
    config.max_num_iterations = effort.pose_steps + effort.merge_steps
    return _with_data(config, capture, 0, seed)


def _joint_config(capture: Capture, pose_run: Path, bundle: Path, root: str | None, seed: int) -> TrainerConfig:
    config = copy.deepcopy(joint_method.config)
    config.bundle_dir = bundle
    config.pipeline.pose_run = pose_run
    config.pipeline.root = root
    return _with_data(config, capture, 0, seed)


def _with_data(config: TrainerConfig, capture: Capture, state: int, seed: int) -> TrainerConfig:
    config.data = capture.path.absolute()
    config.pipeline.datamanager.data = config.data
    config.pipeline.datamanager.dataparser.data = config.data
    config.pipeline.datamanager.dataparser.state = state
    config.machine.seed = seed
    return config


def _run(
    stage: str, config: TrainerConfig, output_dir: Path, experiment: str, report: Report, progress: Progress
) -> Path:
    """Train one stage, unless the report says that it is done; returns the run's config.yml."""
    config.output_dir = output_dir / "runs"
    config.experiment_name = experiment
    config.timestamp = "fit"
    config.vis = "tensorboard"  # any but the viewer, whose server would outlive the stage
    config.logging.local_writer.enable = False
    config.logging.steps_per_log = 100
    config.steps_per_eval_batch = config.steps_per_eval_image = config.steps_per_eval_all_images = 0
    config.steps_per_save = config.max_num_iterations + 1  # at the end only: a stage is repeated as a whole
    run = config.get_base_dir()
    task = progress.add_task(stage, total=config.max_num_iterations)
    if report.finished(stage):
        progress.update(task, completed=config.max_num_iterations)
        return run / "config.yml"
    shutil.rmtree(run, ignore_errors=True)
    seed_everything(config.machine.seed)
    start = time.perf_counter()
    config.save_config()
    trainer: Trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.callbacks.append(
        TrainingCallback(
            [TrainingCallbackLocation.AFTER_TRAIN_ITERATION], lambda step: progress.update(task, completed=step + 1)
        )
    )
    trainer.train()
    progress.update(task, completed=config.max_num_iterations)
    report.add(
        name=stage,
        seconds=round(time.perf_counter() - start, 2),
        iterations=config.max_num_iterations,
        gaussians=trainer.pipeline.model.num_points,
        peak_memory_mb=_peak_memory_mb(),
    )
    return run / "config.yml"


def _peak_memory_mb() -> int:
    """Of the GPU where there is one, else of this process so far."""
    if torch.cuda.is_available():
        return torch.cuda.max_memory_allocated() // 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak // (2**20 if sys.platform == "darwin" else 2**10)


@contextmanager
def _progress() -> Iterator[Progress]:
    """One progress bar a stage; nerfstudio's own messages are kept quiet meanwhile."""
    quiet, CONSOLE.quiet = CONSOLE.quiet, True
    try:
        with Progress(
            TextColumn("{task.description:<24}"),
            BarColumn(),
            TextColumn("{task.completed:.0f}/{task.total:.0f}"),
            TimeElapsedColumn(),
        ) as progress:
            yield progress
    finally:
        CONSOLE.quiet = quiet
