"""All stages, resumable: `splatart fit`."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from splatart_ns.bundle import load_bundle
from splatart_ns.bundle.description import describe
from splatart_ns.capture.capture import Problem
from splatart_ns.capture.values import is_inside
from splatart_ns.choices import Quality, Rasterizer, RefineCameras, Worlds
from splatart_ns.errors import InputError
from splatart_ns.machine import num_cores
from splatart_ns.plugin.companion import Companions
from splatart_ns.plugin.fit_lock import alone_in
from splatart_ns.plugin.report import Report
from splatart_ns.plugin.settings import Settings, require_fittable
from splatart_ns.plugin.stage_configs import stage_configs
from splatart_ns.plugin.stage_run import num_processes, run_side_by_side, run_stage
from splatart_ns.rasterize.rasterization import set_backend
from splatart_ns.threads import kernel_threads

MOST_WARNINGS = 3
"""So many of the capture are said before a fit."""


def fit(
    capture_path: Path,
    output_dir: Path,
    quality: Quality = "standard",
    root: str | None = None,
    seed: int = 0,
    rasterizer: Rasterizer = "auto",
    joints: tuple[str, ...] = (),
    worlds: Worlds | None = None,
    refine_cameras: RefineCameras = "auto",
    downscale: int | None = None,
    companions: Companions | None = None,
) -> Path:
    """Run what is missing of all stages, leave the bundle in `output_dir` and say what it holds.

    `companions` may have been started before this module was imported, which takes them as long as this process.

    Raises:
        InputError: for a capture, a root, a joint, a folder or a rasterizer that cannot be used.
    """
    set_backend(rasterizer)
    settings = Settings(quality, root, seed, rasterizer, list(joints), worlds, refine_cameras, downscale)
    warnings: list[Problem] = []
    capture = require_fittable(capture_path, settings, warnings.append)
    folders = {capture_path / s.name for s in capture.states}
    folders |= {frame.image.parent for s in capture.states for frame in s.frames} - {capture_path}
    if is_inside(output_dir, capture_path) or any(is_inside(folder, output_dir) for folder in folders):
        raise InputError(f"{output_dir} holds the capture's files; choose another --output-dir, beside it.")
    output_dir = output_dir.absolute()
    with alone_in(output_dir):
        report = Report(output_dir / "report.json", capture, settings)
        (output_dir / "runs").mkdir(exist_ok=True)
        for warning in warnings[:MOST_WARNINGS]:
            CONSOLE.log(f"Warning: {warning}.", markup=False)
        if more := len(warnings[MOST_WARNINGS:]):
            CONSOLE.log(f"And {more} more warnings, see `splatart check {capture_path}`.", markup=False)
        if downscale is None and (chosen := settings.of(capture).downscale) > 1:
            CONSOLE.log(f"Images are looked at at 1/{chosen} of their size; --downscale 1 takes all their pixels.")
        configs = stage_configs(capture, output_dir, settings)
        pose, joint = (configs.pop(name) for name in ("pose", "joint"))
        with kernel_threads(num_cores()), _progress() as progress:
            _train(configs, rasterizer, report, progress, companions)
            _train({"pose": pose}, rasterizer, report, progress)
            _train({"joint": joint}, rasterizer, report, progress, whole=_is_whole(output_dir))
    _tell(output_dir, report, joint)
    return output_dir


def _tell(bundle: Path, report: Report, run: TrainerConfig) -> None:
    """Say what was found, how well, and where it is."""
    told = [*describe(load_bundle(bundle)), report.summary]
    told += [f"Bundle: {bundle}", f"Config: {run.get_base_dir() / 'config.yml'}"]
    CONSOLE.print("\n".join(told), markup=False, highlight=False, soft_wrap=True)


def _is_whole(bundle: Path) -> bool:
    try:
        load_bundle(bundle)
    except InputError:
        return False
    return True


def _train(
    stages: dict[str, TrainerConfig],
    rasterizer: Rasterizer,
    report: Report,
    progress: Progress,
    companions: Companions | None = None,
    whole: bool = True,
) -> None:
    """Train stages that do not need each other, but those that are done and whose results are `whole`."""
    missing: dict[str, TrainerConfig] = {}
    tasks = []
    for name, config in stages.items():
        run = config.get_base_dir()
        task = progress.add_task(name, total=config.max_num_iterations)
        if report.resume(name, whole and any(run.glob("nerfstudio_models/step-*.ckpt"))):
            progress.update(task, completed=config.max_num_iterations)
        else:
            shutil.rmtree(run, ignore_errors=True)
            missing[name] = config
            tasks.append(task)

    def on_step(index: int, steps: int) -> None:
        progress.update(tasks[index], completed=steps)

    runs = list(missing.values())
    # Of all stages: a fit that goes on has the results of one that was not ended.
    processes = num_processes(len(stages))
    outcomes = (
        (run_stage(config, partial(on_step, index)) for index, config in enumerate(runs))
        if processes == 1
        else run_side_by_side(runs, processes, rasterizer, on_step, companions or Companions())
    )
    for name, outcome in zip(missing, outcomes, strict=True):
        for note in outcome["notes"]:
            progress.console.print(note, markup=False, soft_wrap=True)
        report.add(name, outcome)


@contextmanager
def _progress() -> Iterator[Progress]:
    """One progress bar a stage; nerfstudio's own messages are kept quiet meanwhile."""
    quiet, CONSOLE.quiet = CONSOLE.quiet, True
    try:
        with Progress(
            SpinnerColumn(),
            TextColumn("{task.description:<24}", markup=False),
            BarColumn(),
            TextColumn("{task.completed:.0f}/{task.total:.0f}"),
            TimeElapsedColumn(),
        ) as progress:
            yield progress
    finally:
        CONSOLE.quiet = quiet
