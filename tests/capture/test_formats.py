import copy
import json
import random

import cv2
import numpy as np
import pytest

from splatart_ns.capture.capture import Normalization
from splatart_ns.capture.formats import load_capture, load_novel
from splatart_ns.capture.part_names import safe_names
from splatart_ns.errors import InputError

FILE = "state_00/transforms.json"


def names(frames):
    return [f.name for f in frames]


def looking_along(direction, centre):
    back = -np.asarray(direction, float) / np.linalg.norm(direction)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3] = np.stack([right, np.cross(back, right), back, centre], axis=1)
    return T


def test_state_folders_give_states_frames_cameras_and_parts(capture_folder):
    capture = load_capture(capture_folder)
    assert [s.name for s in capture.states] == ["state_00", "state_01"]
    assert capture.parts == {1: "base", 2: "door"}
    state = capture.states[1]
    assert names(state.split("train")) == [f"images/{i:04d}.png" for i in range(6)]
    assert names(state.split("test")) == ["images/0006.png", "images/0007.png"]
    assert state.split("val") == ()
    frame = state.frames[3]
    assert frame.image == capture_folder / "state_01/images/0003.png"
    assert frame.labels == capture_folder / "state_01/labels/0003.png"
    assert frame.object_mask is frame.mask is frame.depth is None
    camera = frame.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height) == (20, 20, 8, 8, 16, 16)
    given = json.loads((capture_folder / "state_01/transforms.json").read_text())["frames"][3]["transform_matrix"]
    np.testing.assert_allclose(frame.T_world_camera, given, atol=1e-12)


def test_eval_is_not_a_state_and_holds_the_novel_configurations(capture_folder):
    for i in (10, 2):
        (capture_folder / "eval").mkdir(exist_ok=True)
        target = capture_folder / f"eval/novel_{i}"
        target.mkdir()
        (target / "transforms.json").write_bytes((capture_folder / FILE).read_bytes())
    (capture_folder / "eval/transforms.json").write_text("not read")
    assert len(load_capture(capture_folder).states) == 2
    assert [s.name for s in load_novel(capture_folder)] == ["novel_2", "novel_10"]


def test_without_eval_there_are_no_novel_configurations(capture_folder):
    assert load_novel(capture_folder) == ()


def test_states_are_in_natural_order(capture_folder):
    (capture_folder / "state_00").rename(capture_folder / "pose10")
    (capture_folder / "state_01").rename(capture_folder / "pose9")
    assert [s.name for s in load_capture(capture_folder).states] == ["pose9", "pose10"]


def test_single_file_groups_frames_by_state_and_holds_out_every_eighth(single_file_folder):
    capture = load_capture(single_file_folder)
    assert [s.name for s in capture.states] == ["state_00", "state_01"]
    assert names(capture.states[1].split("test")) == ["s1/images/0007.png"]
    assert len(capture.states[1].split("train")) == 7
    assert capture.parts == {1: "part_1", 2: "part_2"}


def test_paris_layout(paris_folder):
    capture = load_capture(paris_folder)
    assert [s.name for s in capture.states] == ["start", "end"]
    start = capture.states[0]
    assert names(start.split("val")) == ["val/0005.png"]
    assert names(start.split("test")) == ["test/0006.png", "test/0007.png"]
    assert start.frames[0].labels == paris_folder / "start/train_semantics/0000.png"
    camera = start.frames[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width) == (20, 22, 7, 9, 16)
    assert capture.parts == {1: "part_1", 2: "part_2"}


def test_paris_without_labels_has_no_parts(paris_folder):
    for file in paris_folder.glob("*/*_semantics/*.png"):
        file.unlink()
    assert load_capture(paris_folder).parts == {}


def test_frames_outside_the_lists_are_left_out_and_train_comes_first(capture_folder, edit):
    def change(meta):
        meta["train_filenames"] = ["./images/0000.png", "images/0001.png"]
        meta["test_filenames"] = ["images/0001.png", "images/0002.png"]
        del meta["val_filenames"]

    edit(capture_folder / FILE, change)
    state = load_capture(capture_folder).states[0]
    assert {f.name: f.split for f in state.frames} == {
        "images/0000.png": "train",
        "images/0001.png": "train",
        "images/0002.png": "test",
    }


@pytest.mark.parametrize("key", ["file_path", "filenames"])
def test_splits_may_list_frames_by_another_path_to_their_file(capture_folder, edit, key):
    splits = {f.image: f.split for f in load_capture(capture_folder).states[0].frames}

    def change(meta):
        if key == "file_path":
            for frame in meta["frames"]:
                frame["file_path"] = str(capture_folder / "state_00" / frame["file_path"])
        else:
            for split in ("train", "val", "test"):
                meta[f"{split}_filenames"] = [f"images/../{name}" for name in meta[f"{split}_filenames"]]

    edit(capture_folder / FILE, change)
    assert {f.image: f.split for f in load_capture(capture_folder).states[0].frames} == splits


def test_a_frames_intrinsics_come_before_the_files(capture_folder, edit):
    edit(capture_folder / FILE, lambda m: m["frames"][0].update(fl_x=30.0, k1=0.01))
    first, second = load_capture(capture_folder).states[0].frames[:2]
    assert (first.camera.fx, first.camera.distortion[0]) == (30.0, 0.01)
    assert (second.camera.fx, second.camera.distortion[0]) == (20.0, 0.0)


def test_a_frames_own_focal_length_or_distortion_replaces_the_files_in_either_form(capture_folder, edit):
    def change(meta):
        meta["distortion_params"] = [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]
        meta["frames"][0].update(camera_angle_x=2 * np.arctan(0.5), k1=0.01)
        meta["frames"][1].update(fl_x=30.0, fl_y=None)

    edit(capture_folder / FILE, change)
    first, second, third = (frame.camera for frame in load_capture(capture_folder).states[0].frames[:3])
    assert (first.fx, first.fy, first.distortion[0]) == pytest.approx((16, 16, 0.01))
    assert (second.fx, second.fy, second.distortion[0]) == (30, 30, 0.1)
    assert (third.fx, third.fy, third.distortion[0]) == (20, 20, 0.1)


def test_what_a_frame_leaves_open_is_as_the_file_says(capture_folder, edit):
    expected = load_capture(capture_folder).states[0].frames
    empty = dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "depth_unit_scale_factor"))
    edit(capture_folder / FILE, lambda m: m["frames"][0].update(empty))
    edit(capture_folder / FILE, lambda m: m.update(depth_unit_scale_factor=None))
    found = load_capture(capture_folder).states[0].frames
    assert [(f.camera, f.depth_unit) for f in found] == [(f.camera, f.depth_unit) for f in expected]
    edit(capture_folder / FILE, lambda m: m.update(depth_unit_scale_factor=0.5))
    assert {frame.depth_unit for frame in load_capture(capture_folder).states[0].frames} == {0.5}
    splits = [f"{split}_filenames" for split in ("train", "val", "test")]
    edit(capture_folder / FILE, lambda m: [m.pop(key, None) for key in splits])
    expected = [frame.split for frame in load_capture(capture_folder).states[0].frames]
    edit(capture_folder / FILE, lambda m: m.update(dict.fromkeys(splits)))
    assert [frame.split for frame in load_capture(capture_folder).states[0].frames] == expected


@pytest.mark.parametrize("model", ["opencv", "Pinhole", None])
def test_a_camera_model_may_be_spelled_otherwise_or_be_missing(capture_folder, edit, model):
    expected = load_capture(capture_folder).states[0].frames[0].camera
    edit(capture_folder / FILE, lambda m: m.update(camera_model=model))
    assert load_capture(capture_folder).states[0].frames[0].camera == expected


def test_field_of_view_and_image_size_stand_in_for_missing_intrinsics(capture_folder, edit):
    def change(meta):
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            del meta[key]
        meta["camera_angle_x"] = 2 * np.arctan(0.5)

    edit(capture_folder / FILE, change)
    camera = load_capture(capture_folder).states[0].frames[0].camera
    assert (camera.fx, camera.fy) == pytest.approx((16, 16))
    assert (camera.cx, camera.cy, camera.width, camera.height) == (8, 8, 16, 16)


def test_each_side_of_an_image_has_its_own_field_of_view_and_centre(capture_folder, edit):
    def change(meta):
        for key in ("fl_x", "fl_y", "cx", "cy"):
            del meta[key]
        meta.update(w=32, h=16, camera_angle_x=2 * np.arctan(0.5), camera_angle_y=2 * np.arctan(0.2))

    edit(capture_folder / FILE, change)
    camera = load_capture(capture_folder).states[0].frames[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((32, 40, 16, 8))


def test_distortion_params_are_k1_to_k4_then_p1_and_p2(capture_folder, edit):
    edit(capture_folder / FILE, lambda m: m.update(k1=0.01, k2=0.02, k3=0.03, k4=0.0, p1=0.001, p2=0.002))
    edit(
        capture_folder / "state_01/transforms.json",
        lambda m: m.update(distortion_params=[0.01, 0.02, 0.03, 0.0, 0.001, 0.002]),
    )
    by_key, by_list = (state.frames[0].camera.distortion for state in load_capture(capture_folder).states)
    assert by_key == by_list == (0.01, 0.02, 0.03, 0.0, 0.001, 0.002)


def test_a_pose_may_leave_out_its_last_row(capture_folder, edit):
    expected = load_capture(capture_folder).states[0].frames[0].T_world_camera
    edit(capture_folder / FILE, lambda m: m["frames"][0]["transform_matrix"].pop())
    np.testing.assert_array_equal(load_capture(capture_folder).states[0].frames[0].T_world_camera, expected)


def test_optional_files_and_points_are_found(capture_folder, edit):
    def change(meta):
        meta["ply_file_path"] = "points.ply"
        meta["length_unit"] = "metre"
        meta["frames"][0].update(object_mask_path="o.png", mask_path="m.png", depth_file_path="d.npy")

    edit(capture_folder / FILE, change)
    capture = load_capture(capture_folder)
    state = capture.states[0]
    assert state.points == capture_folder / "state_00/points.ply"
    assert capture.length_unit == "metre"
    found = (state.frames[0].object_mask, state.frames[0].mask, state.frames[0].depth)
    assert [p.name for p in found] == ["o.png", "m.png", "d.npy"]


@pytest.mark.parametrize(
    "key, first, other", [("length_unit", "metre", "mm"), ("length_unit", "metre", 5), ("worlds", "similar", "shared")]
)
def test_what_all_states_share_cannot_differ(capture_folder, edit, key, first, other):
    for state, value in (("state_00", first), ("state_01", other)):
        edit(capture_folder / state / "transforms.json", lambda meta, value=value: meta.update({key: value}))
    with pytest.raises(InputError, match=f'state_01/transforms.json: "{key}" is '):
        load_capture(capture_folder)


@pytest.mark.parametrize("blank", ["", "  "])
def test_a_blank_unit_of_length_is_none(capture_folder, edit, blank):
    edit(capture_folder / FILE, lambda meta: meta.update(length_unit=blank))
    assert load_capture(capture_folder).length_unit == "unknown"


def test_a_count_of_depth_is_a_millimetre_unless_the_file_or_the_frame_says_otherwise(capture_folder, edit):
    def change(meta):
        meta["depth_unit_scale_factor"] = 0.25
        meta["frames"][1]["depth_unit_scale_factor"] = 2

    assert load_capture(capture_folder).states[0].frames[0].depth_unit == 1e-3
    edit(capture_folder / FILE, change)
    assert [f.depth_unit for f in load_capture(capture_folder).states[0].frames[:3]] == [0.25, 2, 0.25]


@pytest.mark.parametrize("unit", [0, -1, "mm", True, 1e300])
def test_a_unit_of_depth_that_is_no_length_is_refused(capture_folder, edit, unit):
    edit(capture_folder / FILE, lambda meta: meta.update(depth_unit_scale_factor=unit))
    with pytest.raises(InputError, match="depth_unit_scale_factor of frame 'images/0000.png' is "):
        load_capture(capture_folder)


def test_rounded_rotations_are_made_exact(capture_folder, edit):
    edit(capture_folder / FILE, lambda m: m["frames"][0].update(transform_matrix=np.round(pose_of(m), 3).tolist()))
    T = load_capture(capture_folder).states[0].frames[0].T_world_camera
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)


def pose_of(meta):
    return np.array(meta["frames"][0]["transform_matrix"])


def test_largest_label_ignores_unlabelled_pixels(single_file_folder):
    labels = np.full((16, 16), 255, np.uint16)
    labels[0, 0] = 5
    cv2.imwrite(str(single_file_folder / "s0/labels/0000.png"), labels)
    assert list(load_capture(single_file_folder).parts) == [1, 2, 3, 4, 5]


def test_part_names_become_safe_and_unique_file_names():
    given = ["Tür links", "../../etc/passwd", "a/b", "a b", "A_B", "", "..", "x" * 300]
    made = safe_names(given)
    assert all(set(n) <= set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_.-") for n in made)
    assert len({n.lower() for n in made}) == len(given)
    assert not any(n.startswith(".") for n in made)
    assert max(map(len, made)) <= 64
    assert safe_names(["link_0", "panda.finger-1"]) == ["link_0", "panda.finger-1"]
    assert safe_names(["a b", "A_b", "a_b_2"]) == ["a_b_3", "A_b", "a_b_2"]
    assert safe_names(["Tür links", "蓋", "ドア 左", "_a"]) == ["Tur_links", "part_2", "part_3", "_a"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m.update(camera_model="OPENCV_FISHEYE"), "'OPENCV_FISHEYE'"),
        (lambda m: m.update(k4=0.1), "k4"),
        (lambda m: m.update(fl_x="20"), "fl_x of frame 'images/0000.png' is '20'"),
        (lambda m: m.update(fl_x=-3), "must be positive"),
        (lambda m: m.update(fl_x=0.05), "in pixels"),
        (lambda m: [m.pop("fl_x"), m.pop("fl_y")], "no focal length"),
        (lambda m: m.update(w=16.5), "whole numbers"),
        (lambda m: m.update(k1=-1e9), "leaves no image"),
        (lambda m: m.update(k1=1e9), "leaves no image"),
        (lambda m: m.update(p1=1.0), "leaves no image"),
        (lambda m: m.update(frames=[]), '"frames" is empty'),
        (lambda m: m.pop("frames"), '"frames" is missing'),
        (lambda m: m["frames"][0].pop("file_path"), "file_path of frame 0 is missing"),
        (lambda m: m["frames"][0].pop("transform_matrix"), "transform_matrix of frame 'images/0000.png' is missing"),
        (lambda m: m["frames"][0]["transform_matrix"][0].pop(), "4x4 matrix"),
        (lambda m: m["frames"][0]["transform_matrix"][0].__setitem__(0, float("nan")), "is nan"),
        (lambda m: m["frames"][0].update(transform_matrix=(2 * pose_of(m)).tolist()), "last row"),
        (lambda m: m["frames"][0].update(transform_matrix=(pose_of(m) @ np.diag([2, 2, 2, 1.0])).tolist()), "by 2"),
        (lambda m: m["frames"][0].update(transform_matrix=(pose_of(m) @ np.diag([1, 1, -1, 1.0])).tolist()), "mirrors"),
        (lambda m: m["frames"][0].update(transform_matrix=(pose_of(m) @ np.diag([1, 1, 0, 1.0])).tolist()), "inverted"),
        (lambda m: m["frames"][0].update(transform_matrix=(pose_of(m) @ np.diag([1, 2, 1, 1.0])).tolist()), "shears"),
        (lambda m: m.update(semantic_classes=["base", "door"]), "begins with 'base'"),
        (lambda m: m.update(semantic_classes=["background", 3]), "list of names"),
        (lambda m: m.update(semantic_classes=["background", "door", "base"]), "differs from another state's"),
        (lambda m: m.update(train_filenames=["images/9999.png"]), "'images/9999.png'"),
        (lambda m: m.update(train_filenames="images/0000.png"), "a list of file paths"),
        (lambda m: m.update(train_filenames=[], val_filenames=[], test_filenames=[]), "no frame that can be used"),
        (lambda m: m["frames"][0].update(semantics_path=7), "semantics_path"),
    ],
)
def test_what_cannot_be_read_is_named(capture_folder, edit, change, words):
    edit(capture_folder / FILE, change)
    with pytest.raises(InputError) as error:
        load_capture(capture_folder)
    assert words in str(error.value)
    assert str(capture_folder / "state_0") in str(error.value)


@pytest.mark.parametrize(
    "text", [b"", b"{", b"[]", b"3", b"\xff\xfe{}", b"[" * 100_000, b'{"frames": NaN}', b"9" * 5000]
)
def test_broken_json_is_an_input_error(capture_folder, text):
    (capture_folder / FILE).write_bytes(text)
    with pytest.raises(InputError, match=r"transforms\.json"):
        load_capture(capture_folder)


def test_a_key_that_an_object_has_twice_is_an_input_error(capture_folder):
    text = (capture_folder / FILE).read_text()
    (capture_folder / FILE).write_text(text.replace('"fl_x"', '"fl_x": 30.0, "fl_x"', 1))
    with pytest.raises(InputError, match=r"transforms\.json: an object has the key 'fl_x' twice; keep one of them"):
        load_capture(capture_folder)


def test_a_folder_without_a_capture_is_an_input_error(tmp_path, capture_folder):
    for path in (tmp_path / "nothing", tmp_path, capture_folder / FILE):
        with pytest.raises(InputError):
            load_capture(path)


@pytest.mark.parametrize("folder", ["scene", "scene/shut"])
def test_a_nerfs_synthetic_scene_is_told_what_to_make_of_it(tmp_path, folder):
    (tmp_path / folder).mkdir(parents=True)
    (tmp_path / folder / "transforms_train.json").write_text('{"camera_angle_x": 0.7, "frames": []}')
    with pytest.raises(
        InputError, match="transforms_train.json: .*; put the frames of each state into a transforms.json"
    ):
        load_capture(tmp_path / "scene")


def test_a_single_frame_without_a_state_is_an_input_error(single_file_folder, edit):
    edit(single_file_folder / "transforms.json", lambda m: m["frames"][-1].pop("state"))
    with pytest.raises(InputError, match='carries no "state"'):
        load_capture(single_file_folder)


def test_a_state_folder_alone_is_told_from_a_capture(capture_folder):
    with pytest.raises(InputError, match="no frame carries"):
        load_capture(capture_folder / "state_00")


def test_two_layouts_at_once_are_an_input_error(capture_folder):
    (capture_folder / "transforms.json").write_text("{}")
    with pytest.raises(InputError, match="keep either"):
        load_capture(capture_folder)


def test_normalisation_puts_an_object_that_fills_the_image_into_the_unit_ball():
    target, radius, half_fov = np.array([3.0, -1.0, 0.5]), 2.0, 0.4
    distance = radius / np.tan(half_fov)
    directions = np.random.default_rng(0).normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    T = np.stack([looking_along(-d, target + distance * d) for d in directions])
    normalization = Normalization.from_cameras(T, np.full(20, half_fov))
    np.testing.assert_allclose(normalization.centre, target, atol=1e-9)
    assert normalization.scale == pytest.approx(1 / radius)


@pytest.mark.parametrize(
    ("centres", "directions"),
    [
        ([[0, 0, 0], [1, 0, 0], [0, 0, 1]], [[0, 1, 0]] * 3),
        ([[0, 0, 0]], [[0, 1, 0]]),
        ([[2, 0, 0], [-2, 0, 0], [0, 2, 0], [0, -2, 0]], [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]),
        ([[1, 1, 1]] * 3, [[1, 0, 0], [0, 1, 0], [-1, 1, 0]]),
    ],
    ids=["parallel", "one camera", "outward", "one spot"],
)
def test_normalisation_is_finite_for_cameras_without_a_common_target(centres, directions):
    T = np.stack([looking_along(d, c) for c, d in zip(centres, directions, strict=True)])
    normalization = Normalization.from_cameras(T, np.full(len(T), 0.5))
    assert np.isfinite(normalization.centre).all()
    assert 0 < normalization.scale < 100


def test_parallel_cameras_look_at_the_centre():
    T = np.stack([looking_along([0, 1, 0], c) for c in ([-1, 0, 0], [1, 0, 0])])
    np.testing.assert_allclose(Normalization.from_cameras(T, np.full(2, 0.5)).centre, [0, 1, 0], atol=1e-12)


STRANGE = [
    None,
    True,
    -1,
    0,
    1e308,
    10**400,
    float("nan"),
    float("inf"),
    "",
    "x",
    "\0",
    "/",
    "..",
    [],
    [[]],
    {},
    [None],
]


def places(value, path=()):
    """The paths of all values inside a JSON value, but not into more than the first two frames."""
    items = value.items() if isinstance(value, dict) else enumerate(value[:2]) if isinstance(value, list) else ()
    for key, inner in items:
        yield (*path, key)
        yield from places(inner, (*path, key))


def mutate(meta, path, value):
    """A copy of `meta` with the value at `path` replaced, or taken out if `value` is `mutate` itself."""
    meta = copy.deepcopy(meta)
    parent = meta
    for key in path[:-1]:
        parent = parent[key]
    if value is mutate:
        del parent[path[-1]]
    else:
        parent[path[-1]] = value
    return meta


def accept_only_input_errors(path):
    try:
        load_capture(path)
    except InputError as error:
        assert "\n" not in str(error).split("is not JSON")[0]


def test_any_value_replaced_gives_a_capture_or_an_input_error(single_file_folder, capture_folder, paris_folder):
    files = [
        (capture_folder, capture_folder / FILE, {"k1": 0.01, "distortion_params": [0.0] * 6, "ply_file_path": "a.ply"}),
        (single_file_folder, single_file_folder / "transforms.json", {"camera_angle_x": 0.9}),
        (paris_folder, paris_folder / "start/camera_train.json", {}),
    ]
    for path, file, extra in files:
        meta = {**json.loads(file.read_text()), **extra}
        for place in places(meta):
            for value in [*STRANGE, mutate]:
                file.write_text(json.dumps(mutate(meta, place, value)))
                accept_only_input_errors(path)


def test_any_damaged_byte_gives_a_capture_or_an_input_error(capture_folder):
    file = capture_folder / FILE
    data = file.read_bytes()
    rng = random.Random(0)
    for _ in range(300):
        damaged = bytearray(data)
        for _ in range(rng.randint(1, 4)):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        file.write_bytes(bytes(damaged[: rng.choice([len(damaged), rng.randrange(len(damaged))])]))
        accept_only_input_errors(capture_folder)
