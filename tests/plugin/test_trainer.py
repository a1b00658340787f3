"""What the trainers of all stages share."""

import copy

import pytest
import torch
from nerfstudio.engine.trainer import Trainer

from splatart_ns.errors import InputError
from splatart_ns.method_configs.joint import method as joint_method
from splatart_ns.method_configs.pose import method as pose_method
from splatart_ns.method_configs.semantic import method as semantic_method


@pytest.mark.parametrize("option", ["load_dir", "load_checkpoint"])
@pytest.mark.parametrize("method", [semantic_method, pose_method, joint_method], ids=lambda m: m.config.method_name)
def test_a_checkpoint_to_go_on_from_is_refused_before_a_config_is_written(tmp_path, method, option):
    config = copy.deepcopy(method.config)
    config.output_dir, config.timestamp = tmp_path / "outputs", "run"
    config.pipeline.datamanager.data = tmp_path
    setattr(config, option, tmp_path)
    with pytest.raises(InputError, match="leave --load-dir and --load-checkpoint out"):
        config.save_config()
    assert list(tmp_path.iterdir()) == []


def test_a_run_without_a_capture_is_refused_before_its_folder_is_made(tmp_path):
    config = copy.deepcopy(semantic_method.config)
    config.output_dir, config.timestamp = tmp_path / "outputs", "run"
    with pytest.raises(InputError, match="give its folder by --data"):
        config.save_config()
    assert list(tmp_path.iterdir()) == []
    config.pipeline.datamanager.dataparser.data = tmp_path
    config.save_config()


@pytest.mark.parametrize("method", [pose_method, joint_method], ids=lambda m: m.config.method_name)
@pytest.mark.parametrize("named", [False, True])
def test_earlier_runs_are_looked_for_in_the_output_folder_unless_another_is_named(tmp_path, method, named):
    config = copy.deepcopy(method.config)
    config.output_dir, config.pipeline.runs_dir = tmp_path / "outs", tmp_path if named else None
    config.setup()
    assert config.pipeline.runs_dir == (tmp_path if named else tmp_path / "outs")


def test_a_checkpoint_takes_the_place_of_older_ones_when_all_of_it_is_written(
    capture_dir, semantic_trainer, monkeypatch
):
    trainer = semantic_trainer(capture_dir)
    trainer.save_checkpoint(3)
    save, seen = torch.save, []

    def save_and_look(*arguments):
        save(*arguments)
        seen.extend(path.name for path in trainer.config.get_checkpoint_dir().glob("*.ckpt"))

    monkeypatch.setattr(torch, "save", save_and_look)
    trainer.save_checkpoint(7)
    assert seen == ["step-000000003.ckpt"]
    assert [path.name for path in trainer.checkpoint_dir.iterdir()] == ["step-000000007.ckpt"]


def test_a_checkpoint_that_finds_no_room_leaves_the_older_one(capture_dir, semantic_trainer, monkeypatch, small_files):
    trainer = semantic_trainer(capture_dir)
    trainer.save_checkpoint(3)

    def train(self):
        with small_files():
            self.save_checkpoint(7)

    monkeypatch.setattr(Trainer, "train", train)
    with pytest.raises(InputError, match="nerfstudio_models: cannot be written"):
        trainer.train()
    assert [path.name for path in trainer.checkpoint_dir.iterdir()] == ["step-000000003.ckpt"]
