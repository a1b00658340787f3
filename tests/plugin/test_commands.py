"""The way of a nerfstudio user, by the real commands."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from commands import Commands
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from viewer_client import ViewerClient, free_port

from splatart_ns.bundle import load_bundle

QUICK = ("--vis", "tensorboard", "--pipeline.datamanager.seed-gaussians", 1500)


@pytest.fixture(scope="module")
def commands(capture_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Commands]:
    """Runs commands in a folder that holds the capture `hinge` and will hold outputs/."""
    folder = tmp_path_factory.mktemp("project")
    (folder / "hinge").symlink_to(capture_dir)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "1")
        yield Commands(folder)


def only_run(commands: Commands, method: str, number: int = 0) -> Path:
    """The config.yml, relative to the folder, of a run."""
    runs = sorted((commands.folder / "outputs" / "hinge" / method).glob("*/config.yml"))
    return runs[number].relative_to(commands.folder)


@pytest.fixture(scope="module")
def semantic_run(commands: Commands) -> Path:
    """The run of state 0; there is one of state 1, too."""
    for state, start in ((0, commands.run), (1, commands.fork)):
        steps = ("--max-num-iterations", 80, "--pipeline.model.semantic-start", 60, "--steps-per-eval-image", 40)
        start("ns-train", "splatart-semantic", "--data", "hinge", *QUICK, *steps, "splatart-capture", "--state", state)
    return only_run(commands, "splatart-semantic")


@pytest.fixture(scope="module")
def joint_run(commands: Commands, semantic_run: Path) -> Path:
    steps = ("--max-num-iterations", 40, "--pipeline.model.pose-steps", 20)
    commands.fork("ns-train", "splatart-pose", "--data", "hinge", "--vis", "tensorboard", *steps)
    commands.fork("ns-train", "splatart-joint", "--data", "hinge", "--vis", "tensorboard")
    return only_run(commands, "splatart-joint")


def test_training_is_evaluated_on_the_way(commands: Commands, semantic_run: Path) -> None:
    events = EventAccumulator(str(commands.folder / semantic_run.parent))
    events.Reload()
    psnr = {tag: events.Scalars(tag)[-1].value for tag in events.Tags()["scalars"] if "psnr" in tag.lower()}
    assert len(psnr) == 2  # of the training images and of an evaluation image
    assert min(psnr.values()) > 15


def test_checkpoints_load_by_the_default_of_torch(commands: Commands, semantic_run: Path, joint_run: Path) -> None:
    for run in (semantic_run, joint_run):
        (file,) = (commands.folder / run.parent / "nerfstudio_models").glob("step-*.ckpt")
        assert torch.load(file)["pipeline"]


def test_the_runs_find_each_other_and_end_in_a_bundle(commands: Commands, joint_run: Path, capture_dir: Path) -> None:
    bundle = load_bundle(commands.folder / joint_run.parent / "bundle")
    assert [part.name for part in bundle.parts] == ["base", "lid"]
    (joint,) = bundle.joints
    truth = json.loads((capture_dir / "ground_truth.json").read_text())
    values = truth["joints"][0]["values"]
    assert joint.type == "revolute"
    assert abs(float(joint.values[1])) == pytest.approx(abs(values[1] - values[0]), abs=0.15)


METHODS = ["splatart-semantic", "splatart-pose", "splatart-joint"]


@pytest.mark.parametrize("method", METHODS)
def test_ns_eval_measures(commands: Commands, method: str, joint_run: Path) -> None:
    commands.fork("ns-eval", "--load-config", only_run(commands, method), "--output-path", f"{method}.json")
    results = json.loads((commands.folder / f"{method}.json").read_text())["results"]
    assert 17 < results["psnr"] < 60
    assert 0.6 < results["ssim"] < 1


@pytest.mark.parametrize("method", METHODS)
def test_ns_render_writes_every_output(commands: Commands, method: str, joint_run: Path) -> None:
    names = ["rgb", "depth", "accumulation", "parts", "part_confidence", "rgba"]
    output = commands.folder / f"renders-{method}"
    where = ("--load-config", only_run(commands, method), "--output-path", output, "--image-format", "png")
    commands.fork("ns-render", "dataset", *where, "--split", "test", "--rendered-output-names", *names)
    images = {name: [cv2.imread(str(p), -1) for p in sorted((output / "test" / name).glob("*.png"))] for name in names}
    for name in names:
        assert [image.shape for image in images[name]] == 3 * [(64, 64, 4 if name == "rgba" else 3)]
        assert np.std(images[name]) > 1
    # Colour over alpha on white is what is rendered.
    rgba = np.stack(images["rgba"]) / 255
    over_white = rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]
    assert np.abs(over_white - np.stack(images["rgb"]) / 255).max() < 0.02


def test_ns_export_writes_a_splat(commands: Commands, joint_run: Path) -> None:
    if importlib.util.find_spec("open3d") is None:
        pytest.skip("open3d is not installed")
    try:
        import open3d  # noqa: F401
    except (ImportError, OSError) as error:
        pytest.skip(f"open3d lacks a system library: {error}")
    commands.fork("ns-export", "gaussian-splat", "--load-config", joint_run, "--output-dir", "export")
    assert (commands.folder / "export" / "splat.ply").read_bytes().startswith(b"ply")


@contextmanager
def watched(commands: Commands, *argv: object) -> Iterator[ViewerClient]:
    """A client of the viewer of a command that is ended afterwards."""
    port = free_port()
    viewer = commands.start(*argv, "--viewer.websocket-host", "127.0.0.1", "--viewer.websocket-port", port)
    try:
        client = ViewerClient(port, viewer.is_alive)
        yield client
        client.close()
    finally:
        viewer.terminate()
        viewer.join()
    assert "Traceback" not in commands.printed(viewer)


WATCHED = ("--data", "hinge", "--output-dir", "watched")
LATER = (*WATCHED, "--pipeline.runs-dir", "outputs")


def test_the_semantic_stage_can_be_watched(commands: Commands) -> None:
    steps = ("--max-num-iterations", 30, "--pipeline.model.semantic-start", 20)
    with watched(commands, "ns-train", "splatart-semantic", *WATCHED, *steps) as client:
        assert client.settled_image().std() > 5


def test_the_pose_stage_can_be_watched(commands: Commands, semantic_run: Path) -> None:
    steps = ("--max-num-iterations", 20, "--pipeline.model.pose-steps", 10)
    with watched(commands, "ns-train", "splatart-pose", *LATER, *steps) as client:
        assert client.settled_image().std() > 5


@pytest.mark.parametrize("command", ["ns-viewer", "ns-train"])
def test_a_slider_moves_its_part_in_the_viewer(commands: Commands, command: str, joint_run: Path) -> None:
    what = ("--load-config", joint_run) if command == "ns-viewer" else ("splatart-joint", *LATER)
    with watched(commands, command, *what) as client:
        slider = client.slider("base_to_lid (degree)")
        assert slider["min"] < slider["value"] < slider["max"]
        before = client.settled_image()
        client.move(slider, slider["max"])
        after = client.settled_image()
    assert before.std() > 5, "the object is not in view"
    assert (np.abs(before.astype(int) - after).max(-1) > 30).mean() > 0.005


def test_a_users_mistake_is_told_in_one_sentence(commands: Commands, capture_dir: Path, tmp_path: Path) -> None:
    elsewhere = Commands(tmp_path)
    (tmp_path / "nothing").mkdir()
    (tmp_path / "hinge").symlink_to(capture_dir)
    quiet = ("--vis", "tensorboard")
    printed = elsewhere.run("ns-train", "splatart-pose", "--data", "hinge", *quiet, code=2)
    mistakes = {
        "state 0": printed,
        "splatart-pose": elsewhere.fork("ns-train", "splatart-joint", "--data", "hinge", *quiet, code=2),
        "nothing": elsewhere.fork("ns-train", "splatart-semantic", "--data", "nothing", *quiet, code=2),
    }
    for named, printed in mistakes.items():
        assert "Traceback" not in printed
        (sentence,) = [line for line in printed.splitlines() if line.startswith("error: ")]
        assert named in sentence
