"""A built-in object at two states in small images."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest
import torch
from nerfstudio.engine.trainer import Trainer, TrainerConfig

from splatart_ns.capture.procedural import synthesize_object
from splatart_ns.capture.synthesis_options import SynthesisOptions
from splatart_ns.method_configs.semantic import method as semantic_method


@pytest.fixture(scope="session")
def capture_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hinge in RGBA images of 64 x 64; half of its training frames have labels. Not to be changed."""
    options = SynthesisOptions(train_views=10, test_views=3, resolution=64, labelled_fraction=0.5)
    return synthesize_object("hinge", tmp_path_factory.mktemp("captures") / "hinge", options)


@pytest.fixture(scope="session")
def depth_capture_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hinge in images of 64 x 64 with depth. Not to be changed."""
    options = SynthesisOptions(train_views=10, test_views=2, resolution=64, depth=True)
    return synthesize_object("hinge", tmp_path_factory.mktemp("captures") / "depth", options)


@pytest.fixture(scope="session")
def opaque_capture_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same without alpha and silhouettes, in front of grey."""
    path = tmp_path_factory.mktemp("captures") / "opaque"
    synthesize_object("hinge", path, SynthesisOptions(train_views=10, test_views=3, resolution=32))
    for state in path.glob("state_*"):
        meta = json.loads((state / "transforms.json").read_text())
        for frame in meta["frames"]:
            frame.pop("object_mask_path", None)
            image = cv2.imread(str(state / frame["file_path"]), cv2.IMREAD_UNCHANGED).astype(float)
            alpha = image[..., 3:] / 255
            cv2.imwrite(str(state / frame["file_path"]), image[..., :3] * alpha + 90 * (1 - alpha))
        (state / "transforms.json").write_text(json.dumps(meta))
    return path


SemanticTrainer = Callable[..., Trainer]


@pytest.fixture
def semantic_trainer(tmp_path: Path) -> SemanticTrainer:
    """Makes a Trainer of splatart-semantic that is set up and has not begun."""

    def make(capture: Path, steps: int = 12, semantic_start: int = 8) -> Trainer:
        config: TrainerConfig = copy.deepcopy(semantic_method.config)
        config.output_dir, config.vis, config.timestamp = tmp_path / "outputs", "tensorboard", "run"
        config.logging.local_writer.enable = False
        config.data = config.pipeline.datamanager.data = capture
        config.max_num_iterations, config.pipeline.model.semantic_start = steps, semantic_start
        config.pipeline.datamanager.seed_gaussians = config.pipeline.model.num_random = 300
        torch.manual_seed(0)
        config.machine.device_type = "cpu"  # what tests compare with lies there
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        return trainer

    return make
