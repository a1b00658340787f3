import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from splatart_ns.capture.formats import load_capture, load_novel
from splatart_ns.capture.scene import camera_poses
from splatart_ns.capture.synthesis import synthesize
from splatart_ns.capture.synthesis_options import SynthesisOptions
from splatart_ns.capture.view import load_views
from splatart_ns.errors import InputError

URDF = """<robot name="toy">
  <link name="world"/>
  <link name="base"><visual><geometry><box size="0.4 0.4 0.1"/></geometry></visual></link>
  <link name="arm"><visual><origin xyz="0 0 0.2"/><geometry><box size="0.1 0.1 0.4"/></geometry></visual></link>
  <link name="knuckle"/>
  <link name="finger">
    <visual><origin xyz="0.15 0 0"/><geometry><cylinder radius="0.04" length="0.2"/></geometry></visual>
  </link>
  <joint name="mount" type="fixed"><parent link="world"/><child link="base"/></joint>
  <joint name="lift" type="prismatic">
    <parent link="base"/><child link="arm"/><origin xyz="0.05 0 0.05" rpy="0.2 0 0.4"/>
    <axis xyz="0 0 1"/><limit lower="0" upper="0.3"/>
  </joint>
  <joint name="bend" type="revolute">
    <parent link="arm"/><child link="knuckle"/><origin xyz="0 0 0.3"/><axis xyz="0 1 1"/><limit lower="-1" upper="1"/>
  </joint>
  <joint name="roll" type="continuous"><parent link="knuckle"/><child link="finger"/><axis xyz="1 0 0"/></joint>
</robot>"""
SMALL = SynthesisOptions(train_views=6, test_views=2, resolution=48, samples=1)


@pytest.fixture(scope="module")
def urdf(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "toy.urdf"
    path.write_text(URDF)
    return path


@pytest.fixture(scope="module")
def capture(urdf):
    return synthesize(urdf, urdf.parent / "capture", replace(SMALL, labelled_fraction=0.5))


def read(folder, name="transforms.json"):
    return json.loads((folder / name).read_text())


def files(folder):
    return {p.relative_to(folder): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def joint_motion(joint, value):
    """The motion in the world of a joint that goes from its value at state 0 to another."""
    T, step = np.eye(4), value - joint["values"][0]
    axis, origin = np.array(joint["axis"]), np.array(joint["origin"])
    if joint["type"] == "prismatic":
        T[:3, 3] = step * axis
    else:
        T[:3, :3] = Rotation.from_rotvec(step * axis).as_matrix()
        T[:3, 3] = origin - T[:3, :3] @ origin
    return T


def test_axes_origins_and_values_of_the_joints_rebuild_the_motions(capture):
    truth = read(capture, "ground_truth.json")
    for state in (*truth["states"], *truth["novel"]):
        motion = {truth["parts"][0]["name"]: np.eye(4)}
        for joint in truth["joints"]:
            motion[joint["child"]] = motion[joint["parent"]] @ joint_motion(joint, state["joint_values"][joint["name"]])
        for part, T in state["motion_from_state_0"].items():
            assert motion[part] == pytest.approx(np.array(T), abs=1e-7)


def test_every_joint_moves_between_the_states_and_stays_within_its_limits(capture):
    for joint in read(capture, "ground_truth.json")["joints"]:
        first, second = joint["values"]
        low, high = joint["limits"] or (-np.pi, np.pi)
        assert low <= min(first, second) and max(first, second) <= high
        assert abs(first - second) > 0.1 * min(high - low, 1.75)


def test_ground_truth_points_project_into_the_silhouettes_and_cover_them(capture):
    frames = read(capture / "state_00")["frames"]
    transforms = read(capture / "state_00")
    parts = read(capture, "ground_truth.json")["segmentation"]["part_ids"]
    assert parts == {"1": "base", "2": "arm", "3": "finger"}
    points = {i: trimesh.load(capture / "ground_truth_points" / f"part_{i}.ply").vertices for i in parts}
    assert all(len(p) == 10_000 for p in points.values())
    for frame in frames:
        mask = cv2.imread(str(capture / "state_00" / frame["object_mask_path"]), cv2.IMREAD_UNCHANGED) > 0
        near = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3))) > 0
        seen = np.zeros_like(mask)
        T = np.linalg.inv(np.array(frame["transform_matrix"]))
        for p in points.values():
            x, y, z = (p @ T[:3, :3].T + T[:3, 3]).T
            u = (transforms["fl_x"] * x / -z + transforms["cx"]).astype(int)
            v = (transforms["fl_y"] * -y / -z + transforms["cy"]).astype(int)
            assert near[v, u].all()
            seen[v, u] = True
        assert (seen & mask).sum() > 0.97 * mask.sum()


def test_labels_agree_with_silhouettes_and_only_some_training_frames_have_them(capture):
    for k in (0, 1):
        folder = capture / f"state_{k:02d}"
        transforms = read(folder)
        labelled = [f for f in transforms["frames"] if "semantics_path" in f]
        train = [f for f in labelled if f["file_path"] in transforms["train_filenames"]]
        assert len(train) == 3 and len(labelled) == 5
        assert len(list((folder / "semantics").iterdir())) == 5
        for frame in labelled:
            ids = cv2.imread(str(folder / frame["semantics_path"]), cv2.IMREAD_UNCHANGED)
            mask = cv2.imread(str(folder / frame["object_mask_path"]), cv2.IMREAD_UNCHANGED)
            image = cv2.imread(str(folder / frame["file_path"]), cv2.IMREAD_UNCHANGED)
            assert ids.dtype == np.uint8 and ids.shape == (48, 48)
            assert ((ids > 0) == (mask == 255)).all()
            assert image.shape == (48, 48, 4)
            assert set(np.unique(ids)) <= {0, 1, 2, 3}


def test_all_views_hold_the_whole_object(capture):
    for image in capture.rglob("images/*.png"):
        alpha = cv2.imread(str(image), cv2.IMREAD_UNCHANGED)[..., 3]
        assert alpha.max() == 255
        assert max(alpha[0].max(), alpha[-1].max(), alpha[:, 0].max(), alpha[:, -1].max()) == 0


def test_a_link_without_shape_keeps_its_place_in_the_tree(capture):
    truth = read(capture, "ground_truth.json")
    knuckle = truth["parts"][2]
    assert (knuckle["name"], knuckle["has_geometry"], knuckle["id"]) == ("knuckle", False, None)
    assert [(j["parent"], j["child"], j["child_id"]) for j in truth["joints"]] == [
        ("base", "arm", 2),
        ("arm", "knuckle", None),
        ("knuckle", "finger", 3),
    ]
    assert truth["parts"][0]["frame_link"] == "world"
    assert read(capture / "state_00")["semantic_classes"] == ["background", "base", "arm", "finger"]


def test_the_novel_configuration_lies_half_way_and_has_test_views_only(capture):
    truth = read(capture, "ground_truth.json")
    values = truth["novel"][0]["joint_values"]
    for joint in truth["joints"]:
        assert values[joint["name"]] == pytest.approx(np.mean(joint["values"]))
    transforms = read(capture / "eval" / "novel_00")
    assert transforms["train_filenames"] == []
    assert len(transforms["test_filenames"]) == len(transforms["frames"]) == 2


def test_the_same_seed_writes_the_same_bytes_and_another_one_does_not(urdf, tmp_path, capture):
    options = replace(SMALL, labelled_fraction=0.5)
    assert files(synthesize(urdf, tmp_path / "again", options)) == files(capture)
    other = files(synthesize(urdf, tmp_path / "other", replace(options, seed=1)))
    truth = next(p for p in other if p.name == "ground_truth.json")
    assert other[truth] != files(capture)[truth]


def test_depth_is_that_of_the_surface(urdf, tmp_path):
    folder = synthesize(urdf, tmp_path / "c", replace(SMALL, depth=True))
    capture = load_capture(folder)
    points = trimesh.load(folder / "ground_truth_points/part_1.ply").vertices
    points = np.concatenate([points, trimesh.load(folder / "ground_truth_points/part_2.ply").vertices])
    scale, centre = capture.normalization.scale, capture.normalization.centre
    for view in load_views(capture, 0, "test"):
        row, column = (view.depth > 0).nonzero().T.numpy()
        assert set(map(tuple, view.labels.nonzero().tolist())) == set(zip(row, column, strict=True))
        K, T = view.K.double().numpy(), np.linalg.inv(view.viewmat.double().numpy())
        z = view.depth[row, column].double().numpy()
        x = np.stack([(column + 0.5 - K[0, 2]) / K[0, 0] * z, (row + 0.5 - K[1, 2]) / K[1, 1] * z, z, np.ones_like(z)])
        world = (T @ x)[:3].T / scale + centre
        known = np.isin(view.labels[row, column].numpy(), (1, 2))
        assert known.sum() > 50
        away = np.linalg.norm(world[known, None] - points, axis=-1).min(1)
        assert np.median(away) < 0.004  # of 10,000 points on each


def test_given_joint_values_are_used(urdf, tmp_path):
    options = replace(SMALL, joint_values=("lift=0.1, bend=-0.5", "lift=0.2", "roll=3"), train_views=1, test_views=0)
    truth = read(synthesize(urdf, tmp_path / "c", options), "ground_truth.json")
    assert [j["values"] for j in truth["joints"]] == [[0.1, 0.2, 0.0], [-0.5, 0.0, 0.0], [0.0, 0.0, 3.0]]
    assert (tmp_path / "c" / "state_02" / "transforms.json").is_file()
    assert truth["novel"] == [] and not load_novel(tmp_path / "c")  # which would have no frames


def test_a_joint_has_one_value_a_state(urdf, tmp_path):
    options = replace(SMALL, joint_values=("lift=0.1, lift=0.2", "lift=0"))
    with pytest.raises(InputError, match="'lift' has two values"):
        synthesize(urdf, tmp_path / "c", options)


def test_a_frozen_joint_joins_its_links(urdf, tmp_path):
    options = replace(SMALL, freeze=("bend=0.5", "roll=1"), train_views=1, test_views=0)
    truth = read(synthesize(urdf, tmp_path / "c", options), "ground_truth.json")
    assert [p["links"] for p in truth["parts"]] == [["world", "base"], ["arm", "knuckle", "finger"]]
    assert [j["name"] for j in truth["joints"]] == ["lift"]
    assert truth["source"]["frozen_joints"] == {"bend": 0.5, "roll": 1.0}


def test_a_frozen_joint_is_given_no_other_value(urdf, tmp_path):
    options = replace(SMALL, freeze=("bend=0.5",), joint_values=("bend=0.5,lift=0", "bend=0.2,lift=0.1"))
    with pytest.raises(InputError, match="joint 'bend' is frozen at 0.5 and given the value 0.2; leave out one"):
        synthesize(urdf, tmp_path / "new", options)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"joint_values": ("lift=0.1", "lift=0.9")}, "its limits are 0 to 0.3"),
        ({"joint_values": ("lift=0.1", "lift=high")}, "'lift=high'"),
        ({"joint_values": ("lift=0.1", "lid=0.2")}, "no movable joint 'lid'"),
        ({"joint_values": ("lift=0.1",)}, "two states"),
        ({"states": 1}, "states is 1"),
        ({"train_views": 0}, "train-views is 0"),
        ({"labelled_fraction": 1.5}, "labelled-fraction is 1.5"),
        ({"fov_degrees": 0.0}, "fov-degrees is 0"),
        ({"length_unit": " "}, "length-unit is ' '"),
    ],
)
def test_options_that_make_no_sense_are_refused_and_leave_nothing(urdf, tmp_path, change, says):
    with pytest.raises(InputError, match=says):
        synthesize(urdf, tmp_path / "c", replace(SMALL, **change))
    assert list(tmp_path.iterdir()) == []


def test_a_folder_in_use_is_left_alone_and_an_empty_one_is_taken(urdf, tmp_path):
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "mine.txt").write_text("keep")
    with pytest.raises(InputError, match="not empty"):
        synthesize(urdf, tmp_path / "c", SMALL)
    assert [p.name for p in (tmp_path / "c").iterdir()] == ["mine.txt"]
    (tmp_path / "c" / "mine.txt").unlink()
    synthesize(urdf, tmp_path / "c", replace(SMALL, train_views=1, test_views=0))
    assert (tmp_path / "c" / "ground_truth.json").is_file()
    assert [p.name for p in tmp_path.iterdir()] == ["c"]


def test_a_parent_that_cannot_hold_a_folder_is_refused(urdf, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        synthesize(urdf, tmp_path / "file" / "c", SMALL)


def test_a_failure_half_way_leaves_no_folder(tmp_path):
    path = tmp_path / "toy.urdf"
    path.write_text(URDF.replace('<box size="0.1 0.1 0.4"/>', '<mesh filename="gone.obj"/>'))
    with pytest.raises(InputError, match="gone.obj"):
        synthesize(path, tmp_path / "c", SMALL)
    assert [p.name for p in tmp_path.iterdir()] == ["toy.urdf"]


def test_a_moving_link_may_have_a_shape_without_any_extent(tmp_path):
    path = tmp_path / "toy.urdf"
    path.write_text(URDF.replace('<cylinder radius="0.04" length="0.2"/>', '<sphere radius="0"/>'))
    truth = read(synthesize(path, tmp_path / "c", SMALL), "ground_truth.json")
    assert {part["name"]: part["id"] for part in truth["parts"]} == {
        "base": 1,
        "arm": 2,
        "knuckle": None,
        "finger": None,
    }


def test_a_robot_without_shapes_is_refused(tmp_path):
    path = tmp_path / "bare.urdf"
    path.write_text('<robot name="bare"><link name="base"/></robot>')
    with pytest.raises(InputError, match="nothing to render"):
        synthesize(path, tmp_path / "c", SMALL)


def test_the_capture_reads_back_with_its_parts_and_unit(capture):
    read_back = load_capture(capture)
    assert read_back.parts == {1: "base", 2: "arm", 3: "finger"}
    assert [len(s.split("train")) for s in read_back.states] == [6, 6]
    assert read_back.length_unit == "metre"


@pytest.mark.parametrize("views", ["sphere", "hemisphere"])
def test_cameras_look_at_the_centre_from_well_spread_places(views):
    centre = np.array([1.0, 2.0, 3.0])
    T = camera_poses(40, centre, 2.0, views, np.random.default_rng(0))
    R, away = T[:, :3, :3], (T[:, :3, 3] - centre) / 2.0
    assert R @ R.transpose(0, 2, 1) == pytest.approx(np.broadcast_to(np.eye(3), R.shape), abs=1e-8)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert R[:, :, 2] == pytest.approx(away, abs=1e-8)
    assert (R[:, 2, 1] >= 0.0).all()
    assert (away[:, 2].min() > 0.0) == (views == "hemisphere")
    between = np.arccos(np.clip(away @ away.T, -1.0, 1.0)) + 10.0 * np.eye(40)
    share = 0.5 if views == "hemisphere" else 1.0
    assert between.min() > 0.4 * np.sqrt(4.0 * np.pi * share / 40)
