import json
import shutil

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image
from scipy.spatial.transform import Rotation
from small_capture import looking_at_origin

from splatart_ns.capture.check import check_capture
from splatart_ns.capture.digest import capture_digest
from splatart_ns.capture.examination import as_json, as_text, examine
from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.procedural import synthesize_object
from splatart_ns.capture.synthesis import synthesize
from splatart_ns.capture.synthesis_options import SynthesisOptions


@pytest.fixture
def capture(hinge_capture, tmp_path):
    return shutil.copytree(hinge_capture, tmp_path / "capture")


def change_png(file, change):
    assert cv2.imwrite(str(file), np.ascontiguousarray(change(cv2.imread(str(file), cv2.IMREAD_UNCHANGED))))


def change_all(folder, change):
    for file in folder.glob("*.png"):
        change_png(file, change)


def change_json(file, change):
    meta = json.loads(file.read_text())
    change(meta)
    file.write_text(json.dumps(meta))


def change_poses(state, change):
    def apply(meta):
        for frame in meta["frames"]:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()

    change_json(state / "transforms.json", apply)


def swapped(labels):
    return np.select([labels == 1, labels == 2], [2, 1], labels).astype(np.uint8)


def left_half(mask):
    return mask * (np.arange(mask.shape[1]) < mask.shape[1] // 2).astype(np.uint8)


def pose_of_another(meta):
    meta["frames"][5]["transform_matrix"] = meta["frames"][9]["transform_matrix"]


def another_world(T):
    out = T.copy()
    R = Rotation.from_rotvec([0.3, 1.0, 0.5]).as_matrix()
    out[:3, :3], out[:3, 3] = R @ T[:3, :3], 1.3 * R @ T[:3, 3] + [0.5, -0.3, 0.2]
    return out


def labelled_once(labels):
    return np.where(labels == 2, 255, labels).astype(np.uint8)


def copy_state(capture):
    shutil.rmtree(capture / "state_01")
    shutil.copytree(capture / "state_00", capture / "state_01")


def opaque_images(capture):
    for state in ("state_00", "state_01"):
        change_json(
            capture / state / "transforms.json",
            lambda meta: [frame.pop("object_mask_path") for frame in meta["frames"]],
        )
        change_all(capture / state / "images", lambda image: image[..., :3])


def unlabelled_surroundings(capture):
    """But for a few of its pixels, so that no frame has a silhouette."""
    rows = np.arange(64)[:, None] > 0
    for state in ("state_00", "state_01"):
        change_all(capture / state / "semantics", lambda labels: np.where((labels == 0) & rows, 255, labels))


LABELS = "state_01/semantics/0005.png"
MASK = "state_01/masks/0005.png"
DEFECTS = {
    "labels of two parts swapped in one frame": (
        lambda c: change_png(c / LABELS, swapped),
        {LABELS: "the labels of images/0005.png contradict the other frames on"},
    ),
    "labels shifted in one frame": (
        lambda c: change_png(c / LABELS, lambda labels: np.roll(labels, 4, axis=1)),
        {LABELS: "the labels of images/0005.png do not fit its silhouette"},
    ),
    "all labels too large": (
        lambda c: change_all(c / "state_01/semantics", lambda labels: cv2.dilate(labels, np.ones((5, 5), np.uint8))),
        {"state_01": "the outlines of labels and silhouettes lie"},
    ),
    "labels resized with interpolation": (
        lambda c: change_all(c / "state_01/semantics", lambda labels: cv2.blur(labels, (2, 2))),
        {"state_01": "the labels seem to be resized or anti-aliased"},
    ),
    "a part labelled in one frame": (
        lambda c: [change_png(f, labelled_once) for f in sorted((c / "state_01/semantics").iterdir())[1:]],
        {"state_01": "part 2 (lid) is seen in 1 labelled training frame"},
    ),
    "the pose of another frame": (
        lambda c: change_json(c / "state_01/transforms.json", pose_of_another),
        {MASK: "the silhouette of images/0005.png does not fit those of the other frames"},
    ),
    "half of a mask": (
        lambda c: change_png(c / MASK, left_half),
        {MASK: "the silhouette of images/0005.png does not fit those of the other frames"},
    ),
    "poses in OpenCV's axes": (
        lambda c: change_poses(c / "state_01", lambda T: T @ np.diag([1.0, -1.0, -1.0, 1.0])),
        {"state_01": "the silhouettes contradict each other: no point lies inside more than"},
    ),
    "poses world to camera": (
        lambda c: change_poses(c / "state_01", np.linalg.inv),
        {"state_01": "the silhouettes contradict each other: no point lies inside more than"},
    ),
    "masks inverted": (
        lambda c: change_all(c / "state_01/masks", lambda mask: 255 - mask),
        {"state_01": "the silhouettes"},
    ),
    "other ids in a state": (
        lambda c: change_all(c / "state_01/semantics", swapped),
        {"state_01": "what is part 1 (base) in state_00 is labelled 2 (lid) here"},
    ),
    "a state in another world": (
        lambda c: change_poses(c / "state_01", another_world),
        {"state_01": "no part is where it was in state_00: the states may have different worlds"},
    ),
    "a state in another scale": (
        lambda c: change_poses(c / "state_01", lambda T: np.block([[T[:3, :3], 2 * T[:3, 3:]], [T[3:]]])),
        {"state_01": "no part is where it was in state_00: the states may have different worlds"},
    ),
    "a state of another lens": (
        lambda c: change_json(
            c / "state_01/transforms.json", lambda m: m.update(fl_x=1.2 * m["fl_x"], fl_y=1.2 * m["fl_y"])
        ),
        {"state_01": "parts measure 0."},
    ),
    "no motion": (
        lambda c: [copy_state(c), change_all(c / "state_01/images", lambda image: image // 2 * 2)],
        {"state_01": "no part seems to have moved since state_00"},
    ),
    "a state that is a copy": (
        lambda c: [copy_state(c), opaque_images(c), unlabelled_surroundings(c)],
        {"state_01": "it shows the same images as state_00"},
    ),
}


@pytest.mark.parametrize("name", DEFECTS)
def test_a_defect_is_told_and_its_frame_named(capture, name):
    spoil, expected = DEFECTS[name]
    spoil(capture)
    problems = examine(capture).problems
    for file, words in expected.items():
        assert [p for p in problems if p.file == capture / file and p.message.startswith(words)], problems
    assert all(p.mend for p in problems)
    blamed = {str(p.file.relative_to(capture)) for p in problems if p.file.suffix == ".png"}
    assert blamed <= set(expected)


@pytest.mark.parametrize("count", [1, 6])
def test_masks_drawn_on_images_that_exif_data_turn_are_told_so(capture, count):
    """Of an image turned upside down its size tells nothing."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 3
    state = capture / "state_01"
    for k in range(count):
        image = Image.open(state / f"images/{k:04d}.png")
        image.save(state / f"images/{k:04d}.png", exif=exif)
        for drawn in ("masks", "semantics"):
            change_png(state / f"{drawn}/{k:04d}.png", lambda pixels: pixels[::-1, ::-1])
    (problem,) = (p for p in examine(capture).problems if p.message.startswith("the silhouette"))
    assert "drawn on the pixels as they are stored (EXIF data turn images/00" in problem.mend


def test_wrong_axes_are_not_called_another_world(capture):
    for state in ("state_00", "state_01"):
        change_poses(capture / state, lambda T: T @ np.diag([1.0, -1.0, -1.0, 1.0]))
    change_poses(capture / "state_01", lambda T: np.vstack([np.c_[T[:3, :3], 4 * T[:3, 3:]], T[3:]]))
    assert any("worlds" in p.mend for p in check_capture(capture)[1])
    assert not any("worlds" in p.mend for p in examine(capture).problems)


def swapped_at_the_left(labels):
    """Swapped on less than half of each part."""
    columns = np.nonzero((labels > 0).any(0))[0]
    left = np.arange(labels.shape[1]) < 0.6 * columns[0] + 0.4 * columns[-1]
    return np.where(left, swapped(labels), labels)


def test_a_frame_that_is_partly_wrong_is_named_where_many_silhouettes_make_a_sharp_hull(tmp_path):
    options = SynthesisOptions(train_views=16, test_views=2, resolution=64)
    capture = synthesize_object("hinge", tmp_path / "capture", options)
    change_png(capture / LABELS, swapped_at_the_left)
    problems = examine(capture).problems
    assert [p.file for p in problems] == [capture / LABELS], problems


BOOK = """<robot name="book">
<link name="back"><visual><origin xyz="0.08 0 0"/><geometry><box size="0.16 0.22 0.02"/></geometry></visual></link>
<link name="cover"><visual><origin xyz="0.081 0 0"/><geometry><box size="0.162 0.222 0.004"/></geometry></visual></link>
<joint name="hinge" type="revolute"><parent link="back"/><child link="cover"/><origin xyz="0 0 0.0135"/>
<axis xyz="0 -1 0"/><limit lower="0" upper="3.1" effort="1" velocity="1"/></joint>
</robot>"""


def test_a_lid_thinner_than_the_hull_can_tell_makes_neither_labels_nor_worlds_seem_wrong(tmp_path):
    (tmp_path / "book.urdf").write_text(BOOK)
    options = SynthesisOptions(
        joint_values=("hinge=0", "hinge=2.9"), train_views=16, test_views=2, resolution=96, labelled_fraction=0.25
    )
    capture = synthesize(tmp_path / "book.urdf", tmp_path / "capture", options)
    assert examine(capture).problems == ()
    labels = sorted((capture / "state_01/semantics").iterdir())[1]
    change_png(labels, swapped)
    assert [p.file for p in examine(capture).problems] == [labels]


def test_a_sound_capture_has_no_problems_and_its_parts_are_counted(hinge_capture):
    examination = examine(hinge_capture)
    assert examination.problems == () and examination.errors == 0
    assert [(c.state, c.part, c.frames, c.labelled) for c in examination.coverage] == [
        ("state_00", "base", 12, 12),
        ("state_01", "base", 12, 12),
        ("state_00", "lid", 12, 12),
        ("state_01", "lid", 12, 12),
    ]
    lines = as_text(examination).splitlines()
    assert lines[0].split() == ["seen", "in", "labelled", "frames", "state_00", "state_01"]
    assert lines[-1] == "0 errors, 0 warnings"


def unlabel(capture, state, numbers):
    change_json(
        capture / state / "transforms.json",
        lambda meta: [meta["frames"][i].pop("semantics_path") for i in numbers],
    )


@pytest.mark.parametrize("count", [2, 3, 5])
def test_a_few_labelled_neighbours_do_not_make_states_seem_to_have_other_worlds(capture, count):
    """In one state most of the base is hidden by the lid from there."""
    for state in load_capture(capture).states:
        centres = np.stack([frame.T_world_camera[:3, 3] for frame in state.frames])
        near = np.argsort(np.linalg.norm(centres - centres[1], axis=1))
        unlabel(capture, state.name, near[count:])
    assert [p for p in examine(capture).problems if "labelled training frame" not in p.message] == []


def test_silhouettes_may_come_from_the_labels(capture):
    opaque_images(capture)
    assert examine(capture).problems == ()
    change_png(capture / LABELS, lambda labels: np.roll(labels, 6, axis=1))
    examination = examine(capture)
    (problem,) = examination.problems
    assert (problem.file, problem.mend) == (capture / LABELS, "correct its pose or its labels, or take the frame out")
    assert problem.message.startswith("the outline of the labels of images/0005.png does not fit")
    assert [(c.frames, c.labelled) for c in examination.coverage] == [(12, 12)] * 4


def test_few_silhouettes_most_of_which_do_not_fit_are_one_problem(capture):
    unlabel(capture, "state_01", range(3, 12))
    opaque_images(capture)
    change_poses(capture / "state_01", lambda T: looking_at_origin(0.02 * np.arctan2(T[1, 3], T[0, 3]), distance=1.0))
    (problem,) = [p for p in examine(capture).problems if "not fit" in p.message]
    assert problem.file == capture / "state_01"


def test_a_state_with_cameras_on_one_spot_is_told_so_and_not_judged_otherwise(capture):
    change_poses(capture / "state_01", lambda T: looking_at_origin(0.5))
    examination = examine(capture)
    assert [p.message for p in examination.problems] == ["all training cameras stand on one spot"]
    assert [(c.frames, c.labelled) for c in examination.coverage] == [(12, 12)] * 4


def test_states_may_be_of_utterly_different_scales(capture):
    change_poses(capture / "state_01", lambda T: np.block([[T[:3, :3], 1e-7 * T[:3, 3:]], [T[3:]]]))
    assert examine(capture).problems


def test_the_frame_that_shows_what_no_labelled_frame_shows_is_suggested(capture):
    unlabel(capture, "state_00", range(12))
    unlabel(capture, "state_01", range(1, 12))
    suggested = examine(capture, suggest=4).suggested
    assert len(suggested) == len({frame.image for frame in suggested}) == 4
    states = [frame.image.parts[-3] for frame in suggested]
    assert states.count("state_00") >= 2  # it has no labelled train frame yet
    assert all(frame.split == "train" and frame.labels is None for frame in suggested)
    # The first one of a state without labels stands where most of the object is seen; the next one on another side.
    first, second = [f.T_world_camera[:3, 2] for f in suggested if f.image.parts[-3] == "state_00"][:2]
    assert first @ second < 0.5


def test_nothing_is_suggested_where_all_is_labelled(hinge_capture):
    assert examine(hinge_capture, suggest=3).suggested == ()


def test_json_says_the_same(capture):
    change_png(capture / LABELS, swapped)
    unlabel(capture, "state_00", range(6))
    examination = examine(capture, suggest=1)
    value = json.loads(as_json(examination))
    assert value["errors"] == 0 and len(value["problems"]) == len(examination.problems) == 1
    assert value["problems"][0]["severity"] == "warning"
    assert value["problems"][0]["file"] == str(capture / LABELS)
    assert value["label_next"] == [str(examination.suggested[0].image)]
    assert value["coverage"][0] == {"state": "state_00", "part": "base", "frames": 6, "labelled": 6}
    assert value["shown"] == list(examination.shown)


def test_it_is_told_how_much_labelled_frames_show(capture):
    assert "of what all frames show" not in as_text(examine(capture))
    unlabel(capture, "state_00", range(1, 12))
    examination = examine(capture)
    first, second = examination.shown
    assert 0.1 < first < 0.7 and second == 1  # one view sees less than half of a solid
    assert f"of what all frames show  {f'{first:.0%}':>10}  {'100%':>10}" in as_text(examination)


def test_a_capture_that_nobody_labelled_yet_is_examined_and_told_what_to_label(capture):
    """The first thing that a user runs."""
    for state in load_capture(capture).states:
        unlabel(capture, state.name, range(len(state.frames)))
        change_json(capture / state.name / "transforms.json", lambda meta: meta.pop("semantic_classes"))
    examination = examine(capture, suggest=2)
    text = as_text(examination)
    assert "no training frame has part labels" in text and text.count("label next: ") == 2
    assert f"of what all frames show  {'0%':>10}  {'0%':>10}" in text


def test_labels_and_classes_of_the_background_alone_are_told(capture):
    for state in ("state_00", "state_01"):
        change_all(capture / state / "semantics", np.zeros_like)
        change_json(capture / state / "transforms.json", lambda meta: meta.update(semantic_classes=["background"]))
    examination = examine(capture)
    assert examination.errors and as_text(examination)


def test_what_is_no_capture_is_one_problem(tmp_path):
    examination = examine(tmp_path)
    assert examination.capture is None and examination.errors == len(examination.problems) == 1
    assert as_text(examination).endswith("1 error, 0 warnings")


@pytest.fixture(scope="module")
def deep(tmp_path_factory):
    """A capture with depth, in counts of 0.0001."""
    options = SynthesisOptions(train_views=16, test_views=1, resolution=64, depth=True)
    return synthesize_object("hinge", tmp_path_factory.mktemp("deep") / "capture", options)


@pytest.mark.parametrize("wrong", [1e-3, 1.0, 2e-5])
def test_depth_of_a_wrong_unit_is_told_and_the_right_one_guessed(deep, tmp_path, wrong):
    assert not examine(deep).problems
    capture = shutil.copytree(deep, tmp_path / "capture")
    change_json(capture / "state_01/transforms.json", lambda meta: meta.update(depth_unit_scale_factor=wrong))
    (problem,) = examine(capture).problems
    assert problem.severity == "warning" and problem.file.name == "state_01"
    assert problem.message == "other frames confirm 0% of the frames' depth"
    guess = float(problem.mend.split(" would be about ")[1].split(";")[0])
    assert guess == pytest.approx(1e-4, rel=0.05)


def test_depth_that_is_none_is_told_without_a_guess(deep, tmp_path):
    capture = shutil.copytree(deep, tmp_path / "capture")
    noise = np.random.default_rng(0)
    change_all(capture / "state_00/depth", lambda d: (d * noise.uniform(0.3, 3, d.shape)).astype(np.uint16))
    (problem,) = examine(capture).problems
    assert problem.file.name == "state_00" and "take depth_file_path out" in problem.mend


def test_depth_of_another_frame_is_named(deep, tmp_path):
    capture = shutil.copytree(deep, tmp_path / "capture")
    file = capture / "state_01/transforms.json"
    change_json(file, lambda meta: meta["frames"][3].update(depth_file_path="depth/0010.png"))
    (problem,) = examine(capture).problems
    assert problem.file.name == "0010.png" and problem.severity == "warning"
    assert problem.message == "the depth of images/0003.png contradicts the other frames'"


def test_the_unit_of_depth_belongs_to_what_a_capture_holds(deep, tmp_path):
    first = load_capture(deep)
    capture = shutil.copytree(deep, tmp_path / "capture")
    assert capture_digest(load_capture(capture)) == capture_digest(first)
    change_json(capture / "state_01/transforms.json", lambda meta: meta.update(depth_unit_scale_factor=1.0))
    assert capture_digest(load_capture(capture)) != capture_digest(first)


def test_names_of_strangers_send_a_terminal_no_orders(run_main, capture_folder):
    (capture_folder / "state_01").rename(capture_folder / "state_\x1b[31m01")
    code, output, _ = run_main("check", capture_folder)
    assert code == 0 and "state_" in output and "\x1b" not in output
