import copy
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer_elements import ViewerSlider
from torch import Tensor

from splatart_ns.capture.capture import Normalization
from splatart_ns.errors import InputError
from splatart_ns.geometry.se3 import adjoint, se3_exp, se3_log
from splatart_ns.method_configs.joint import method as joint_method
from splatart_ns.plugin.joint import (
    JointModel,
    JointModelConfig,
    JointPipeline,
    covariances_to_world,
    other_parent_note,
    splat_to_world,
    surface_points,
)
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.articulate import Joint, KinematicTree
from splatart_ns.stages.joint_fit import JointFit

NORMALIZATION = Normalization(np.array([0.5, -1.0, 2.0]), 4.0)
DOOR, DRAWER = 0.6, 0.25
"""Radian and metre from state 0 to state 1."""
HINGE = torch.tensor([0.4, -0.9, 2.1], dtype=torch.float64)
"""A point on the door's axis in the capture's world."""


def splat_of_parts(*parts: int, spread: float = 0.3) -> Splat:
    generator = torch.Generator().manual_seed(0)
    count = 20 * len(parts)
    ids = torch.tensor(parts).repeat_interleave(20)
    return Splat(
        means=spread * torch.randn(count, 3, generator=generator),
        quats=torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1),
        log_scales=torch.full((count, 3), -3.0),
        opacity_logits=torch.linspace(-3, 3, count),
        sh=torch.randn(count, 4, 3, generator=generator),
        part_logits=5 * torch.nn.functional.one_hot(ids, 4).float(),
    )


def translation(x: float, y: float, z: float) -> Tensor:
    T = torch.eye(4, dtype=torch.float64)
    T[:3, 3] = torch.tensor([x, y, z])
    return T


def new_model(state: int = 0) -> JointModel:
    metadata = {
        "part_names": ["background", "body", "door", "drawer"],
        "state": state,
        "length_unit": "metre",
        "normalization": NORMALIZATION,
        "frames": [type("Frame", (), {"T_world_camera": translation(0, 0, 5).numpy()})],
    }
    config = JointModelConfig(num_random=10, sh_degree=1)
    return config.setup(scene_box=None, num_train_data=1, metadata=metadata, device="cpu", grad_scaler=None).eval()


def started_model(state: int = 0) -> tuple[JointModel, Splat, Tensor]:
    """A model of a body with a door that turns and a drawer that slides; the splat, and the motions in the world."""
    door_at = translation(*HINGE) @ se3_exp(torch.tensor([0, 0, 0, 0, 0, DOOR]).double()) @ translation(*-HINGE)
    motions = torch.eye(4, dtype=torch.float64).repeat(2, 3, 1, 1)
    motions[1, 1], motions[1, 2] = door_at, translation(DRAWER, 0, 0)
    z, x, zero = torch.tensor([0.0, 0, 1]).double(), torch.tensor([1.0, 0, 0]).double(), torch.zeros(3).double()
    door = JointFit("revolute", z, HINGE, 0.0, torch.tensor([0.0, DOOR]).double(), residual=0.0)
    drawer = JointFit("prismatic", x, zero, 0.0, torch.tensor([0.0, DRAWER]).double(), residual=0.0)
    tree = KinematicTree([1, 2, 3], 1, [Joint(1, 2, door), Joint(1, 3, drawer)])
    splat = splat_of_parts(1, 2, 3)
    model = new_model(state)
    model.start(splat, tree, motions, NORMALIZATION)
    return model, splat, motions


def world(x: Tensor) -> Tensor:
    """Points of the normalised world in the capture's."""
    return x.double() / NORMALIZATION.scale + torch.from_numpy(NORMALIZATION.centre)


def test_one_slider_a_joint_with_its_unit() -> None:
    model, _, _ = started_model(state=1)
    door, drawer = (slider for _, slider in sorted(parse_object(model, ViewerSlider, ""), key=lambda found: found[0]))
    assert door.name == "body_to_door (degree)" and drawer.name == "body_to_drawer (metre)"
    assert door.value == pytest.approx(math.degrees(DOOR)) and drawer.value == pytest.approx(DRAWER)
    assert door.min < -0.4 * math.degrees(DOOR) and door.max > 1.4 * math.degrees(DOOR)


def test_a_round_part_whose_turns_nothing_tells_can_be_turned_all_round() -> None:
    knob = JointFit("revolute", torch.eye(3).double()[2], HINGE, 0.0, torch.zeros(2).double(), residual=0.0)
    model = new_model()
    tree = KinematicTree([1, 2], 1, [Joint(1, 2, knob)])
    model.start(splat_of_parts(1, 2, 3), tree, torch.eye(4).double().repeat(2, 3, 1, 1), NORMALIZATION)
    assert model.joint_00.value == 0 and model.joint_00.min <= -180 and model.joint_00.max >= 180


@pytest.mark.parametrize("state", [0, 1])
def test_at_first_the_state_is_shown(state: int) -> None:
    model, splat, motions = started_model(state)
    posed = world(model.posed_splat().means)
    for part in (1, 2, 3):
        own = splat.part_ids == part
        T = motions[state, part - 1]
        assert torch.allclose(posed[own], world(splat.means[own]) @ T[:3, :3].T + T[:3, 3], atol=1e-5)


@pytest.mark.parametrize(
    ("kind", "values", "pitch"),
    [
        ("screw", [0.0, 0.9], 0.05),
        ("cylindrical", [[0.0, 0.0], [0.2, 0.9]], 0.0),
        ("free", [[0.0] * 6, [0.3, 0.5, -0.1, 0.4, -0.2, 0.3]], 0.0),
    ],
)
def test_joints_of_more_than_a_turn_or_a_slide_show_the_state_at_first(kind: str, values: list, pitch: float) -> None:
    fit = JointFit(kind, torch.eye(3).double()[2], HINGE, pitch, torch.tensor(values).double(), residual=0.0)
    motions = torch.eye(4).double().repeat(2, 3, 1, 1)
    motions[:, 1] = fit.motion(fit.values)
    model, splat = new_model(state=1), splat_of_parts(1, 2, 3)
    model.start(splat, KinematicTree([1, 2, 3], 1, [Joint(1, 2, fit)]), motions, NORMALIZATION)
    own, T = splat.part_ids == 2, motions[1, 1]
    expected = world(splat.means[own]) @ T[:3, :3].T + T[:3, 3]
    assert torch.allclose(world(model.posed_splat().means[own]), expected, atol=1e-4)


def test_a_slider_moves_its_part_and_no_other() -> None:
    model, splat, _ = started_model()
    model.joint_00.default_value = math.degrees(2 * DOOR)
    posed, before, part = world(model.posed_splat().means), world(splat.means), splat.part_ids
    assert torch.allclose(posed[part != 2], before[part != 2], atol=1e-5)
    turned, arm = posed[part == 2] - HINGE, before[part == 2] - HINGE
    c, s = math.cos(2 * DOOR), math.sin(2 * DOOR)
    assert torch.allclose(turned[:, :2], arm[:, :2] @ torch.tensor([[c, s], [-s, c]]).double(), atol=1e-5)

    model.joint_00.default_value, model.joint_01.default_value = 0.0, -0.1
    moved = world(model.posed_splat().means) - before
    assert torch.allclose(moved[part == 3], torch.tensor([-0.1, 0, 0]).double(), atol=1e-5)


def test_a_checkpoint_brings_joints_and_sliders_back() -> None:
    model, _, _ = started_model(state=1)
    loaded = new_model(state=1)
    loaded.load_state_dict(model.state_dict())
    assert loaded.joint_01.name == "body_to_drawer (metre)"
    assert torch.equal(loaded.posed_splat().means, model.posed_splat().means)
    assert loaded.tree.root == 1 and [j.fit.type for j in loaded.tree.joints] == ["revolute", "prismatic"]


def test_a_model_shows_all_bands_of_colour_whether_it_was_just_made_or_loaded() -> None:
    model, _, _ = started_model()
    loaded = new_model()
    loaded.load_state_dict(model.state_dict())
    camera = Cameras(translation(0, 0, 3)[None, :3].float(), fx=40.0, fy=40.0, cx=16.0, cy=16.0, width=32, height=32)
    with torch.no_grad():
        live, again = (m.get_outputs(camera)["rgb"] for m in (model, loaded))
        loaded.gauss_params["features_rest"].zero_()
        assert torch.equal(live, again) and not torch.allclose(live, loaded.get_outputs(camera)["rgb"], atol=0.05)


def test_an_object_without_joints_has_no_sliders() -> None:
    model, splat = new_model(), splat_of_parts(1, 2, 3)
    model.start(splat, KinematicTree([1, 2, 3], 1, []), torch.eye(4).double().repeat(2, 3, 1, 1), NORMALIZATION)
    assert parse_object(model, ViewerSlider, "") == []
    assert torch.allclose(model.posed_splat().means, splat.means, atol=1e-6)


def test_a_splat_in_the_world_has_its_size_and_place() -> None:
    splat = splat_of_parts(1)
    out = splat_to_world(splat, NORMALIZATION)
    assert torch.allclose(out.means.double(), world(splat.means), atol=1e-6)
    assert torch.allclose(out.log_scales.exp() * NORMALIZATION.scale, splat.log_scales.exp())


def test_covariances_follow_the_change_of_world() -> None:
    generator = torch.Generator().manual_seed(1)
    T = se3_exp(0.5 * torch.randn(6, generator=generator).double())
    steps = 1e-5 * torch.randn(400, 6, generator=generator).double()

    def to_world(motion: Tensor) -> Tensor:
        return torch.from_numpy(NORMALIZATION.motion_to_world(motion.numpy()))

    in_world = se3_log(to_world(se3_exp(steps) @ T) @ torch.linalg.inv(to_world(T)))
    expected = in_world.T @ in_world
    assert torch.allclose(covariances_to_world(steps.T @ steps, NORMALIZATION), expected, rtol=1e-3, atol=1e-14)


def test_faint_parts_keep_points() -> None:
    splat = splat_of_parts(1)
    assert len(surface_points(splat)) > 10
    splat.opacity_logits = torch.full((20,), -4.0)
    assert len(surface_points(splat)) == 20


def pose_state(merged: bool = True) -> dict[str, Tensor]:
    """What a pose run on two states and two parts leaves."""
    splat = splat_of_parts(1, 2)
    base = torch.eye(4, dtype=torch.float64).repeat(2, 2, 1, 1)
    base[1, 1] = se3_exp(torch.tensor([0, 0, 0, 0, 0, DOOR]).double())
    state = {
        "means": splat.means,
        "scales": splat.log_scales,
        "quats": splat.quats,
        "opacities": splat.opacity_logits[:, None],
        "features_dc": splat.sh[:, 0],
        "features_rest": splat.sh[:, 1:],
        "semantics": splat.part_logits[:, :3],
    }
    covariance = 1e-8 * torch.eye(6, dtype=torch.float64).repeat(2, 2, 1, 1)
    return {f"_model.gauss_params.{name}": value for name, value in state.items()} | {
        "_model.poses.base": base,
        "_model.covariance": covariance,
        "_model.held_ratio": torch.full((2, 2), torch.nan),
        "_model.alike": torch.zeros(2, dtype=torch.bool),
        "_model.merged": torch.tensor(merged),
        "_model.worlds": torch.eye(4).double().repeat(len(base), 1, 1),
    }


def joint_pipeline(folder: Path, capture: Path, state: dict[str, Tensor], **settings) -> JointPipeline:
    (folder / "nerfstudio_models").mkdir()
    torch.save({"pipeline": state}, folder / "nerfstudio_models" / "step-000000001.ckpt")
    config = copy.deepcopy(joint_method.config.pipeline)
    config.datamanager.data, config.pose_run = capture, folder / "config.yml"
    for name, value in settings.items():
        setattr(config, name, value)
    return config.setup(device="cpu", test_mode="val")


def test_poses_become_a_joint_a_bundle_and_a_slider(tmp_path: Path, capture_dir: Path) -> None:
    pipeline = joint_pipeline(tmp_path, capture_dir, pose_state(), root="lid")
    (joint,) = pipeline.bundle.joints
    assert (joint.type, joint.parent, joint.child) == ("revolute", "lid", "base")
    assert not joint.ambiguous
    assert float(joint.values[1].abs()) == pytest.approx(DOOR, abs=1e-3)
    assert torch.allclose(joint.axis.abs(), torch.tensor([0.0, 0, 1]).double(), atol=1e-3)
    (slider,) = (slider for _, slider in parse_object(pipeline, ViewerSlider, ""))
    assert slider.name == "lid_to_base (degree)"
    # The bundle is in the capture's unit.
    normal = splat_of_parts(1, 2)
    centre = normal.means[normal.part_ids == 1].double().mean(0) / pipeline.datamanager.capture.normalization.scale
    expected = centre + torch.from_numpy(pipeline.datamanager.capture.normalization.centre)
    assert torch.allclose(pipeline.bundle.parts[0].splat.means.double().mean(0), expected, atol=1e-5)


def test_joints_are_as_sure_where_the_worlds_origin_is_far_away(tmp_path: Path, capture_dir: Path) -> None:
    far = shutil.copytree(capture_dir, tmp_path / "far")
    for file in far.glob("state_*/transforms.json"):
        meta = json.loads(file.read_text())
        for frame in meta["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] += 1e5
        file.write_text(json.dumps(meta))
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
    near, away = (
        joint_pipeline(tmp_path / folder, capture, pose_state(), root="lid").bundle.joints[0]
        for folder, capture in (("a", capture_dir), ("b", far))
    )
    assert (away.type, away.parent) == (near.type, near.parent)
    torch.testing.assert_close(away.values, near.values, atol=1e-6, rtol=0)
    torch.testing.assert_close(away.origin - 1e5, near.origin, atol=1e-5, rtol=0)
    torch.testing.assert_close(away.covariance["values"], near.covariance["values"], rtol=1e-3, atol=0)


def test_a_part_that_state_0_hides_is_put_where_another_state_has_it(tmp_path: Path, capture_dir: Path) -> None:
    state = pose_state()
    state["_model.covariance"][0, 1] = torch.nan
    pipeline = joint_pipeline(tmp_path, capture_dir, state, root="base")
    splat, T = splat_of_parts(1, 2), state["_model.poses.base"][1, 1]
    moved = splat.means[splat.part_ids == 2].double() @ T[:3, :3].T + T[:3, 3]
    normalization = pipeline.datamanager.capture.normalization
    expected = moved / normalization.scale + torch.from_numpy(normalization.centre)
    assert torch.allclose(pipeline.bundle.parts[1].splat.means.double(), expected, atol=1e-5)


@pytest.mark.parametrize(("parent", "child", "kind"), [(0, 1, "prismatic"), (1, 0, "revolute")])
def test_a_child_slides_if_its_images_fit_as_well_unturned_against_the_parent(
    tmp_path: Path, capture_dir: Path, parent: int, child: int, kind: str
) -> None:
    state = pose_state()
    state["_model.poses.base"][1, 1] = se3_exp(torch.tensor([0.3, 0, 0, 0, 0, 0.03]).double())
    state["_model.held_ratio"][0, 1] = state["_model.held_ratio"][1, 0] = 9.0
    state["_model.held_ratio"][parent, child] = 1.0
    (joint,) = joint_pipeline(tmp_path, capture_dir, state, root="base").bundle.joints
    assert (joint.type, joint.child) == (kind, "lid")


def test_joints_of_a_part_that_may_have_turned_otherwise_are_ambiguous(tmp_path: Path, capture_dir: Path) -> None:
    state = pose_state() | {"_model.alike": torch.tensor([False, True])}
    (joint,) = joint_pipeline(tmp_path, capture_dir, state).bundle.joints
    assert joint.ambiguous


def test_of_a_part_that_may_hang_on_another_the_report_tells_how_to_decide() -> None:
    fit = JointFit("revolute", HINGE, HINGE, 0.0, torch.zeros(2), residual=0.0)
    note = other_parent_note(Joint(1, 3, fit, other=Joint(2, 3, fit)), {1: "base", 2: "lid", 3: "knob"})
    assert note.startswith("knob hangs on base, but may as well hang on lid: --joint 'knob:lid' says so")


def test_a_type_that_the_user_told_against_the_motions_is_kept_and_noted(tmp_path: Path, capture_dir: Path) -> None:
    pipeline = joint_pipeline(tmp_path, capture_dir, pose_state(), root="lid", joints=("base:lid=prismatic",))
    assert [joint.type for joint in pipeline.bundle.joints] == ["prismatic"]
    (note,) = pipeline.notes
    assert note.startswith("--joint 'base:lid=prismatic' leaves ") and "; revolute would leave 0" in note


def test_an_unfinished_or_foreign_pose_run_is_refused(tmp_path: Path, capture_dir: Path) -> None:
    foreign = pose_state() | {"_model.poses.base": torch.eye(4).double().repeat(2, 3, 1, 1)}
    stage_1 = {name: value for name, value in pose_state().items() if "gauss_params" in name}
    for number, state in enumerate((pose_state(merged=False), foreign, stage_1)):
        folder = tmp_path / str(number)
        folder.mkdir()
        with pytest.raises(InputError, match="no finished splatart-pose run"):
            joint_pipeline(folder, capture_dir, state)


def test_a_root_that_is_no_part_is_told(tmp_path: Path, capture_dir: Path) -> None:
    with pytest.raises(InputError, match="no part 'door'"):
        joint_pipeline(tmp_path, capture_dir, pose_state(), root="door")


def test_an_option_of_training_on_images_is_refused(tmp_path: Path, capture_dir: Path, monkeypatch) -> None:
    monkeypatch.setattr(joint_method.config.pipeline.model, "ssim_lambda", 0.3)
    with pytest.raises(InputError, match="ssim-lambda is 0.3, but splatart-joint does not read it"):
        joint_pipeline(tmp_path, capture_dir, pose_state())


def test_the_adjoint_of_the_world_is_the_covariances_map() -> None:
    # A rigid change of world (scale 1) is the adjoint of a translation.
    rigid = Normalization(NORMALIZATION.centre, 1.0)
    A = adjoint(translation(*rigid.centre))
    C = torch.diag(torch.arange(1.0, 7.0)).double()
    assert torch.allclose(covariances_to_world(C, rigid), A @ C @ A.T)
