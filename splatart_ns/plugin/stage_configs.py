"""The stages of a fit as nerfstudio's trainer takes them."""

from __future__ import annotations

import copy
from dataclasses import asdict
from pathlib import Path

from nerfstudio.engine.trainer import TrainerConfig

from splatart_ns.capture.capture import Capture
from splatart_ns.method_configs.joint import method as joint_method
from splatart_ns.method_configs.pose import method as pose_method
from splatart_ns.method_configs.semantic import method as semantic_method
from splatart_ns.plugin.settings import EFFORTS, Settings
from splatart_ns.rasterize.rasterization import default_device


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
    config.pipeline.datamanager.camera_res_scale_factor = 1 / settings.downscale
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


def _config_file(config: TrainerConfig) -> Path:
    return config.get_base_dir() / "config.yml"
