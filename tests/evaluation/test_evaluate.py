import io
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from rich.console import Console
from small_capture import give_another_world

from splatart_ns.bundle import save_bundle
from splatart_ns.capture.digest import capture_identity
from splatart_ns.capture.formats import load_capture, load_novel
from splatart_ns.errors import InputError
from splatart_ns.evaluation import evaluate, format_tables


@pytest.fixture
def folder(bundle, tmp_path):
    save_bundle(bundle, tmp_path / "out")
    return tmp_path / "out"


def printed(metrics, width: int = 200) -> str:
    console = Console(width=width, record=True, file=io.StringIO())
    for item in format_tables(metrics):
        console.print(item)
    return console.export_text()


def test_a_perfect_estimate_scores_perfectly(folder, capture):
    (folder / "report.json").write_text('{"stages": {"semantic": {"seconds": 1.5}}}')
    metrics = evaluate(folder, capture)
    keys = ["joints", "joints_mean", "structure", "parts", "geometry", "images", "held_out", "speed", "notes"]
    assert list(metrics) == keys
    assert metrics["structure"] == {"tree_exact": True, "edges_precision": 1.0, "edges_recall": 1.0}
    for kind in ("revolute", "prismatic"):
        assert metrics["joints_mean"][kind]["displacement"] == pytest.approx(0, abs=1e-6)
    assert metrics["parts"][0]["part_rotation"] == pytest.approx(0, abs=1e-5)
    assert set(metrics["geometry"]["mesh"]) == {"CD-s", "CD-m", "CD-w", "parts", "last"}
    assert metrics["geometry"]["centres"]["CD-w"] == pytest.approx(0, abs=1e-6)
    assert list(metrics["images"]) == ["state_00", "state_01", "novel_00"]
    for scores in metrics["images"].values():
        assert scores["psnr"] > 45
        assert scores["ssim"] > 0.995
        assert scores["lpips"] is None
        assert scores["accumulation_l1"] < 0.005
        assert scores["part_iou"] > 0.98
    assert metrics["speed"] == {"stages": {"semantic": {"seconds": 1.5}}}
    assert json.loads((folder / "metrics.json").read_text())["joints"] == metrics["joints"]


def test_meshes_may_be_left_out(folder, capture):
    metrics = evaluate(folder, capture, meshes=False)
    assert metrics["geometry"]["mesh"] is None and metrics["geometry"]["centres"]["CD-w"] is not None
    assert "CD-w" in printed(metrics)


def test_another_capture_than_the_fitted_one_is_told(folder, capture, tmp_path):
    """Its parts and states may be called alike, and what it shows be another configuration."""
    fitted = capture_identity(load_capture(capture))
    moved, other = (Path(shutil.copytree(capture, tmp_path / name)) for name in ("moved", "other"))
    shutil.copy(other / "state_01/images/0.png", other / "state_00/images/0.png")
    (folder / "report.json").write_text(json.dumps(fitted))
    assert not [note for data in (capture, moved) for note in evaluate(folder, data)["notes"] if "fitted" in note]
    note = f"{other}: is not the capture that was fitted, {capture}; its states may be others"
    assert evaluate(folder, other)["notes"][0] == note


def test_a_long_name_is_broken_and_no_figure_cut_short(folder, capture):
    metrics = evaluate(folder, capture)
    metrics["joints"] = [
        {**joint, "child": "right_front_outer_knuckle", "axis_angle": 1 / 8091} for joint in metrics["joints"]
    ]
    lines = printed(metrics, 80).splitlines()
    assert max(map(len, lines)) <= 80
    assert not any("…" in line for line in lines)
    assert sum("0.000124" in line for line in lines) == len(metrics["joints"])


def test_figures_within_the_rendered_silhouette_are_marked_in_their_row(folder, capture):
    metrics = evaluate(folder, capture)
    assert "rendered silhouette" not in printed(metrics)
    metrics["images"]["state_01"]["silhouette"] = "rendered"
    assert "state_01 (rendered silhouette)" in printed(metrics)


def test_a_wrong_motion_shows_in_the_images_of_its_state(bundle, folder, capture):
    bundle.parts[2].motion[1, :3, 3] += 0.3
    save_bundle(bundle, folder)
    images = evaluate(folder, capture)["images"]
    assert images["state_00"]["psnr"] > 45 and images["novel_00"]["psnr"] > 45
    assert images["state_01"]["psnr"] < 30
    assert images["state_01"]["part_iou"] < 0.9


def test_without_ground_truth_there_are_image_scores_alone(folder, capture, tmp_path):
    plain = shutil.copytree(capture, tmp_path / "plain")
    (plain / "ground_truth.json").unlink()
    metrics = evaluate(folder, plain)
    assert metrics["joints"] == [] and metrics["structure"] == {}
    assert list(metrics["images"]) == ["state_00", "state_01"]
    assert any("no ground_truth.json" in note for note in metrics["notes"])
    assert any("novel_00" in note for note in metrics["notes"])
    assert "PSNR" in printed(metrics) and "Joints" not in printed(metrics)


def test_a_held_out_configuration_scores_the_model_without_ground_truth(bundle, folder, capture, tmp_path):
    plain = shutil.copytree(capture, tmp_path / "plain")
    (plain / "ground_truth.json").unlink()
    metrics = evaluate(folder, plain)
    right = metrics["held_out"]["novel_00"]
    assert right["values"] == pytest.approx({"hinge": 0.2, "slide": 0.1}, abs=0.01)
    assert right["converged"] and right["unseen"] == []
    assert right["psnr"] > 40 and right["part_iou"] > 0.95
    assert right["residual"] < 3 * right["fitted_residual"]
    assert "Held-out configurations" in printed(metrics)

    bundle.joints[0].axis = torch.tensor([1.0, 0, 0], dtype=torch.float64)
    save_bundle(bundle, folder)
    wrong = evaluate(folder, plain)["held_out"]["novel_00"]
    assert wrong["residual"] > 1.2 * right["residual"], (right, wrong)
    assert wrong["psnr"] < right["psnr"] - 5


def test_a_missing_part_counts_against_the_part_iou(bundle, folder, capture):
    bundle.parts.pop(2)
    bundle.joints.pop(1)
    save_bundle(bundle, folder)
    metrics = evaluate(folder, capture)
    assert metrics["images"]["state_00"]["part_iou"] < 0.7
    assert metrics["joints"][1]["axis_angle"] is None
    assert metrics["structure"]["edges_recall"] == 0.5
    assert any("slide" in note for note in metrics["notes"])


def test_a_bundle_of_another_capture_is_refused(bundle, folder, capture):
    for part in bundle.parts:
        part.motion, part.motion_covariance = part.motion[:1], part.motion_covariance[:1]
    for joint in bundle.joints:
        joint.values = joint.values[:1]
    bundle.states = ["state_00"]
    save_bundle(bundle, folder)
    with pytest.raises(InputError, match="1 states"):
        evaluate(folder, capture)


def test_the_truth_of_other_states_is_refused(folder, capture, tmp_path):
    copy = Path(shutil.copytree(capture, tmp_path / "capture"))
    truth = json.loads((copy / "ground_truth.json").read_text())
    for record in (truth, *truth["joints"]):
        states = record["states" if record is truth else "values"]
        states.append(states[1])
    (copy / "ground_truth.json").write_text(json.dumps(truth))
    with pytest.raises(InputError, match="has 3 states but the capture has 2; give the truth of the same states"):
        evaluate(folder, copy)


def test_states_with_worlds_of_their_own_are_scored_in_the_bundles(bundle, folder, capture, tmp_path):
    copy = Path(shutil.copytree(capture, tmp_path / "capture"))
    (copy / "ground_truth.json").unlink()
    shutil.rmtree(copy / "eval")
    world = give_another_world(copy / "state_01")
    bundle.provenance["worlds"] = [np.eye(4).tolist(), np.linalg.inv(world).tolist()]
    save_bundle(bundle, folder)
    assert min(scores["psnr"] for scores in evaluate(folder, copy)["images"].values()) > 45


def test_the_tables_show_every_joint_and_configuration(folder, capture):
    text = printed(evaluate(folder, capture))
    for word in (
        "axis pos",
        "deg|len",
        "door",
        "latch",
        "state_01",
        "novel_00",
        "tree_exact: yes",
        "note: speed",
    ):
        assert word in text


def test_names_are_not_read_as_markup(bundle, folder, capture):
    metrics = evaluate(folder, capture)
    metrics["joints"][0] |= {"child": "[red]door", "parent_correct": False, "type_correct": False}
    metrics["notes"] = ["[bold]x"]
    text = printed(metrics)
    assert "[red]door (wrong parent)" in text and "(wrong)" in text and "[bold]x" in text


def test_joints_of_parts_without_geometry_are_shown_as_not_comparable_and_not_as_wrong(folder, capture):
    metrics = evaluate(folder, capture)
    metrics["joints"][0] |= {"child": "cap", "parent_correct": None, "type_correct": None}
    text = printed(metrics)
    assert "cap (not comparable)" in text and "wrong" not in text


def test_images_that_are_not_of_the_test_are_not_scored(folder, capture, tmp_path):
    copy = Path(shutil.copytree(capture, tmp_path / "capture"))
    states = [*load_capture(copy).states, *load_novel(copy)]
    others = [frame.image for state in states for frame in state.frames if frame.split != "test"]
    assert {file.parts[-3] for file in others} == {"state_00", "state_01", "novel_00"}
    for file in others:
        assert cv2.imwrite(str(file), 255 - cv2.imread(str(file), cv2.IMREAD_UNCHANGED))
    metrics = evaluate(folder, copy)
    assert min(scores["psnr"] for scores in metrics["images"].values()) > 40
    assert metrics["held_out"]["novel_00"]["psnr"] > 40
