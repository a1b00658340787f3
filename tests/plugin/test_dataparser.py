import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro
from nerfstudio.cameras.cameras import Cameras

from splatart_ns.capture.formats import load_capture
from splatart_ns.errors import InputError
from splatart_ns.plugin.dataparser import SplatartDataParserConfig


def parse(capture: Path, state: int = 0, split: str = "train"):
    return SplatartDataParserConfig(data=capture, state=state).setup().get_dataparser_outputs(split)


def test_a_split_of_a_state_has_its_frames(capture_dir: Path) -> None:
    capture = load_capture(capture_dir)
    for state in (0, 1):
        for split in ("train", "test"):
            outputs = parse(capture_dir, state, split)
            assert outputs.image_filenames == [f.image for f in capture.states[state].split(split)]
            assert len(outputs.cameras) == len(outputs.image_filenames) > 0


def test_a_capture_that_was_checked_is_not_checked_again(capture_dir: Path, tmp_path: Path) -> None:
    capture = shutil.copytree(capture_dir, tmp_path / "capture")
    broken = parse(capture).image_filenames[0]
    broken.write_bytes(broken.read_bytes()[:100])
    with pytest.raises(InputError, match=broken.name):
        parse(capture)
    config = SplatartDataParserConfig(data=capture, checked=True)
    assert broken in config.setup().get_dataparser_outputs("train").image_filenames


def test_states_share_one_normalised_world(capture_dir: Path) -> None:
    capture = load_capture(capture_dir)
    for state in (0, 1):
        outputs = parse(capture_dir, state)
        T = np.stack([f.T_world_camera for f in capture.states[state].split("train")])
        expected = capture.normalization.camera_to_normal(T)[:, :3]
        assert np.allclose(outputs.cameras.camera_to_worlds.numpy(), expected, atol=1e-5)
        # What nerfstudio is told of it agrees: first the transform, then the scale.
        moved = outputs.dataparser_transform.numpy() @ T
        moved[:, :, 3] *= outputs.dataparser_scale
        assert np.allclose(moved, expected, atol=1e-5)


def test_an_object_has_a_radius_of_about_one(capture_dir: Path) -> None:
    cameras = parse(capture_dir).cameras
    distance = cameras.camera_to_worlds[:, :, 3].norm(dim=-1)
    half_width = distance * cameras.width[:, 0] / (2 * cameras.fx[:, 0])
    assert torch.allclose(half_width.median(), torch.tensor(1.0), atol=0.1)


def test_each_camera_takes_metadata_of_its_own_as_ns_export_gives_it(capture_dir: Path) -> None:
    cameras = parse(capture_dir).cameras
    alone = [cameras[i : i + 1] for i in range(2)]
    for i, camera in enumerate(alone):
        camera.metadata["cam_idx"] = i
    assert [camera.metadata for camera in (*alone, cameras)] == [{"cam_idx": 0}, {"cam_idx": 1}, {}]


def test_without_validation_views_the_test_views_are_evaluated(capture_dir: Path) -> None:
    assert parse(capture_dir, split="val").image_filenames == parse(capture_dir, split="test").image_filenames


def test_a_state_out_of_range_is_told(capture_dir: Path) -> None:
    for state in (-1, 2):
        with pytest.raises(InputError, match=rf"has no state {state}; choose --state between 0 and 1"):
            parse(capture_dir, state)


def test_what_is_no_capture_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no capture"):
        parse(tmp_path)


def test_splatfacto_reads_a_state_too(capture_dir: Path) -> None:
    from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

    arguments = ["splatfacto", "--data", str(capture_dir), "splatart-capture", "--state", "1"]
    config = tyro.cli(AnnotatedBaseConfigUnion, args=arguments)
    config.pipeline.datamanager.data = config.data
    camera, batch = config.pipeline.datamanager.setup(device="cpu", test_mode="val").next_train(0)
    assert isinstance(camera, Cameras)
    assert batch["image"].shape == (64, 64, 4)
