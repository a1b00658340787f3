"""All stages, resumable: `splatart fit`."""

from __future__ import annotations

import copy
import platform
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from splatart_ns.bundle import load_bundle
from splatart_ns.bundle.folder import ARTICULATION, remove_bundle
from splatart_ns.capture.capture import Capture, Problem, Worlds
from splatart_ns.capture.check import require_valid
from splatart_ns.capture.digest import capture_digest
from splatart_ns.capture.values import is_inside
from splatart_ns.capture.worlds import require_one_place
from splatart_ns.errors import InputError
from splatart_ns.files import write_json
from splatart_ns.machine import num_cores
from splatart_ns.method_configs.joint import method as joint_method
from splatart_ns.method_configs.pose import method as pose_method
from splatart_ns.method_configs.semantic import method as semantic_method
from splatart_ns.plugin.companion import Companions, Outcome
from splatart_ns.plugin.semantic import RefineCameras
from splatart_ns.plugin.stage_run import num_processes, run_side_by_side, run_stage
from splatart_ns.rasterize.rasterization import Backend, default_backend, default_device, set_backend
from splatart_ns.shape import NUMBER, has_shape, parse
from splatart_ns.stages.joint_constraint import parse_constraints
from splatart_ns.threads import kernel_threads

Quality = Literal["draft", "standard", "high"]


@dataclass(frozen=True)
class Effort:
    """How much work a quality stands for."""

    gaussians: int
    """Gaussians that each state starts from."""
    steps: int
    """Steps on geometry and colour of each state."""
    part_steps: int
    """Steps on the parts of each state, which start from the labels' votes."""
    merge_steps: int
    """Steps on the merged Gaussians of all states."""
    downscale: int = 1
    """How many times smaller than they are images are looked at, where `SMALLEST` are left."""


EFFORTS: dict[Quality, Effort] = {
    "draft": Effort(gaussians=4000, steps=450, part_steps=30, merge_steps=100, downscale=2),
    "standard": Effort(gaussians=8000, steps=1000, part_steps=100, merge_steps=400),
    "high": Effort(gaussians=16000, steps=3000, part_steps=100, merge_steps=1500),
}
SMALLEST = 128
"""Along the shorter side of images that are made smaller."""
MOST_WARNINGS = 3
"""So many of the capture are said before a fit."""


_REPORT = {"stages": [{"name": str, "seconds": NUMBER}], "settings": dict, "versions": dict}
TRAINED_ON = ("device", "rasterizer")
"""What the report says of the machine that trained; the one that finds the joints may be another, without a GPU."""


@dataclass(frozen=True)
class Settings:
    """What decides the result of a fit, besides the capture."""

    quality: Quality
    root: str | None
    seed: int
    rasterizer: Backend = "auto"
    joints: list[str] = field(default_factory=list)
    worlds: Worlds | None = None
    refine_cameras: RefineCameras = "auto"

    def of(self, capture: Capture) -> Settings:
        """With what the capture says where nothing else was asked for."""
        return replace(self, worlds=self.worlds or capture.worlds)


def report_head(capture: Capture, settings: Settings) -> dict[str, Any]:
    """What was fitted, how, and by what."""
    return {
        "capture": str(capture.path.resolve()),
        "capture_sha256": capture_digest(capture),
        "settings": asdict(settings.of(capture)),
        "seed": settings.seed,
        "device": "cuda: " + torch.cuda.get_device_name() if default_device() == "cuda" else "cpu",
        "rasterizer": default_backend(),
        "threads": num_cores(),
        "versions": {"python": platform.python_version()}
        | {name: version(name) for name in ("splatart-ns", "nerfstudio", "torch", "gsplat", "numpy")},
    }


class Report:
    """report.json: which stages have finished, and what they took. Written before and after each stage.

    A stage's `seconds` are its own, its `wall_seconds` what it added to the whole: less for states fitted side by side.
    """

    def __init__(self, path: Path, capture: Capture, settings: Settings):
        self.path = path
        self.data = report_head(capture, settings) | {"stages": [], "seconds": 0.0}
        self._here = {key: self.data[key] for key in TRAINED_ON}
        self._earlier = self._read_stages() if path.exists() else []
        self._last = time.perf_counter()

    def _read_stages(self) -> list[dict[str, Any]]:
        """What an earlier run has finished, when it was of the same capture, settings and version."""
        earlier = parse(self.path.read_bytes() if self.path.is_file() else None, _REPORT) or {"stages": None}
        # Versions before had seconds alone.
        stages = [{"wall_seconds": entry["seconds"], **entry} for entry in earlier["stages"] or ()]
        if earlier["stages"] is None or not has_shape(stages, [{"wall_seconds": NUMBER}]):
            raise InputError(
                f"{self.path} is not a report of `splatart fit`; remove it or choose another --output-dir."
            )
        had, wanted = earlier["settings"], self.data["settings"]
        same = all(earlier.get(key) == self.data[key] for key in ("capture", "capture_sha256"))
        last = ("root", "joints") if wanted["worlds"] == "shared" else ("joints",)  # the last stage alone asks
        same = same and {k: v for k, v in had.items() if k not in last} == {
            k: v for k, v in wanted.items() if k not in last
        }
        if any(had.get(k) != wanted[k] for k in last):
            stages = [stage for stage in stages if stage["name"] != "joint"]
        version_had, version_here = (of["versions"].get("splatart-ns") for of in (earlier, self.data))
        if same and version_had == version_here:
            self.data |= {key: earlier[key] for key in TRAINED_ON if key in earlier}
            return stages
        other = f"by splatart-ns {version_had}" if same else "of another capture or with other settings"
        CONSOLE.print(f"{self.path.parent} holds a fit {other}; starting over.", markup=False)
        return []

    def resume(self, stage: str, whole: bool) -> bool:
        """Whether a stage needs no work: it and all before it were finished, and its files are still `whole`."""
        if whole and self._earlier and self._earlier[0]["name"] == stage:
            self.data["stages"].append(self._earlier.pop(0))
            self._last = time.perf_counter()
            return True
        self._earlier.clear()
        # Before the stage's files change, lest a killed run leaves them with another run's results and report.
        _remove_results(self.path)
        self._write()
        return False

    def add(self, stage: str, outcome: Outcome) -> None:
        """Note a finished stage."""
        now = time.perf_counter()
        self.data |= self._here if stage != "joint" else {}
        self.data["stages"].append({"name": stage, "wall_seconds": round(now - self._last, 2), **outcome})
        self._last = now
        self._write()

    def _write(self) -> None:
        self.data["seconds"] = round(sum(entry["wall_seconds"] for entry in self.data["stages"]), 2)
        write_json(self.path, self.data)


def _remove_results(report: Path) -> None:
    """Remove the bundle beside a report, where there is one or the other, and what was made of it."""
    bundle = report.parent
    if not report.exists() and not (bundle / ARTICULATION).exists():
        return  # whatever lies there is no fit's
    remove_bundle(bundle)
    if (bundle / "export").is_dir():
        from splatart_ns.bundle.export.folder import remove_exports  # which loads the libraries of all formats

        remove_exports(bundle / "export")


def fit(
    capture_path: Path,
    output_dir: Path,
    quality: Quality = "standard",
    root: str | None = None,
    seed: int = 0,
    rasterizer: Backend = "auto",
    joints: tuple[str, ...] = (),
    worlds: Worlds | None = None,
    refine_cameras: RefineCameras = "auto",
    companions: Companions | None = None,
) -> Path:
    """Run what is missing of all stages and leave the bundle in `output_dir`.

    `companions` may have been started before this module was imported, which takes them as long as this process.

    Raises:
        InputError: for a capture, a root, a joint, a folder or a rasterizer that cannot be used.
    """
    set_backend(rasterizer)
    settings = Settings(quality, root, seed, rasterizer, list(joints), worlds, refine_cameras)
    warnings: list[Problem] = []
    capture = require_fittable(capture_path, settings, warnings.append)
    folders = {capture_path / s.name for s in capture.states}
    folders |= {frame.image.parent for s in capture.states for frame in s.frames} - {capture_path}
    if is_inside(output_dir, capture_path) or any(is_inside(folder, output_dir) for folder in folders):
        raise InputError(f"{output_dir} holds the capture's files; choose another --output-dir, beside it.")
    output_dir = output_dir.absolute()
    report = Report(output_dir / "report.json", capture, settings)
    try:
        (output_dir / "runs").mkdir(parents=True, exist_ok=True)
        probe = output_dir / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"{output_dir} cannot be written ({error.strerror}); choose another --output-dir.") from None

    for warning in warnings[:MOST_WARNINGS]:
        CONSOLE.log(f"Warning: {warning}.", markup=False)
    if more := len(warnings[MOST_WARNINGS:]):
        CONSOLE.log(f"And {more} more warnings, see `splatart check {capture_path}`.", markup=False)
    configs = stage_configs(capture, output_dir, settings)
    pose, joint = (configs.pop(name) for name in ("pose", "joint"))
    with kernel_threads(num_cores()), _progress() as progress:
        _train(configs, rasterizer, report, progress, companions)
        _train({"pose": pose}, rasterizer, report, progress)
        _train({"joint": joint}, rasterizer, report, progress, whole=_is_whole(output_dir))
    return output_dir


def require_fittable(capture_path: Path, settings: Settings, warn: Callable[[Problem], None] | None = None) -> Capture:
    """Load and check a capture, and the settings that are about it; `warn` as in `require_valid`.

    Raises:
        InputError: for a capture, a root, a joint or a seed that cannot be used.
    """
    capture, root = require_valid(capture_path, warn), settings.root
    if settings.worlds is None:
        require_one_place(capture)
    if root is not None and root not in capture.parts.values():
        raise InputError(
            f"{capture_path} has no part '{root}'; choose --root from {', '.join(capture.parts.values())}."
        )
    number = next((p for p, name in capture.parts.items() if name == root), None)
    parse_constraints(settings.joints, capture.parts, number)
    if not 0 <= settings.seed < 2**32:
        raise InputError(f"--seed is {settings.seed}; give 0 to {2**32 - 1}.")
    return capture


def stage_configs(capture: Capture, bundle: Path, settings: Settings) -> dict[str, TrainerConfig]:
    """Every stage by its name, in order: `semantic STATE` of each state, `pose`, `joint`; runs are below the bundle."""
    runs, settings = bundle / "runs", settings.of(capture)
    semantic = [_semantic_config(capture, index, runs, settings) for index in range(len(capture.states))]
    pose = _pose_config(capture, [_config_file(config) for config in semantic], runs, settings)
    joint = _joint_config(capture, _config_file(pose), runs, settings)
    return {f"semantic {c.experiment_name}": c for c in semantic} | {"pose": pose, "joint": joint}


def _semantic_config(capture: Capture, state: int, runs: Path, settings: Settings) -> TrainerConfig:
    config = copy.deepcopy(semantic_method.config)
    effort = EFFORTS[settings.quality]
    config.max_num_iterations = effort.steps + effort.part_steps
    config.pipeline.model.semantic_start = effort.steps
    config.pipeline.model.refine_cameras = settings.refine_cameras
    config.pipeline.model.stop_split_at = 7 * effort.steps // 10
    config.pipeline.model.max_gaussians = 3 * effort.gaussians // 2
    for optimizer in config.optimizers.values():
        if optimizer["scheduler"] is not None:
            optimizer["scheduler"].max_steps = effort.steps
    config.pipeline.datamanager.seed_gaussians = effort.gaussians
    config.pipeline.datamanager.seed = settings.seed
    return _placed(config, capture, state, runs, capture.states[state].name, settings)


def _pose_config(capture: Capture, semantic_runs: list[Path], runs: Path, settings: Settings) -> TrainerConfig:
    config = copy.deepcopy(pose_method.config)
    config.pipeline.semantic_runs = tuple(semantic_runs)
    config.pipeline.seed = settings.seed
    merge_steps = EFFORTS[settings.quality].merge_steps
    config.max_num_iterations = config.pipeline.model.pose_steps + merge_steps
    for group, optimizer in config.optimizers.items():
        if group != "part_poses":
            optimizer["scheduler"].max_steps = merge_steps
    if settings.worlds != "shared":
        config.pipeline.root = settings.root
    return _placed(config, capture, 0, runs, "all", settings)


def _joint_config(capture: Capture, pose_run: Path, runs: Path, settings: Settings) -> TrainerConfig:
    config = copy.deepcopy(joint_method.config)
    config.bundle_dir = runs.parent
    config.pipeline.pose_run = pose_run
    config.pipeline.root = settings.root
    config.pipeline.joints = tuple(settings.joints)
    config.pipeline.seed = settings.seed
    config.pipeline.settings = asdict(settings)
    return _placed(config, capture, 0, runs, "all", settings)


def _placed(
    config: TrainerConfig, capture: Capture, state: int, runs: Path, experiment: str, settings: Settings
) -> TrainerConfig:
    """With its capture, its run folder, and none of what `ns-train` shows and saves meanwhile."""
    config.data = capture.path.absolute()
    config.pipeline.datamanager.data = config.data
    config.pipeline.datamanager.camera_res_scale_factor = 1 / image_downscale(capture, settings.quality)
    config.pipeline.datamanager.dataparser.data = config.data
    config.pipeline.datamanager.dataparser.state = state
    config.pipeline.datamanager.dataparser.worlds = settings.worlds
    config.pipeline.datamanager.dataparser.checked = True
    config.machine.seed = settings.seed
    config.machine.device_type = default_device()
    config.output_dir = runs
    config.experiment_name = experiment
    config.timestamp = "fit"
    config.vis = "tensorboard"  # any but the viewer, whose server would outlive the stage
    config.logging.local_writer.enable = False
    config.logging.steps_per_log = 100
    config.steps_per_eval_batch = config.steps_per_eval_image = config.steps_per_eval_all_images = 0
    config.steps_per_save = config.max_num_iterations + 1  # at the end only: a stage is repeated as a whole
    return config


def image_downscale(capture: Capture, quality: Quality) -> int:
    """How many times smaller than they are the images of all states are looked at."""
    cameras = [frame.camera for state in capture.states for frame in state.frames]
    least = min(min(camera.width, camera.height) for camera in cameras)
    return max(1, min(EFFORTS[quality].downscale, least // SMALLEST))


def _config_file(config: TrainerConfig) -> Path:
    return config.get_base_dir() / "config.yml"


def _is_whole(bundle: Path) -> bool:
    try:
        load_bundle(bundle)
    except InputError:
        return False
    return True


def _train(
    stages: dict[str, TrainerConfig],
    rasterizer: Backend,
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
