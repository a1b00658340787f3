import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatart_ns.capture.check import check_capture, require_valid
from splatart_ns.errors import InputError

FILE = "state_00/transforms.json"


def put(path, pixels):
    assert cv2.imwrite(str(path), pixels)


def found(problems, severity="error"):
    return [f"{p.file.name}: {p.message}" for p in problems if p.severity == severity]


def relabel(folder, old, new):
    for file in folder.glob("labels/*.png"):
        labels = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        labels[labels == old] = new
        put(file, labels)


def empty(file):
    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    image[..., 3] = 0
    put(file, image)


def test_sound_captures_have_no_problems(capture_folder, single_file_folder, paris_folder):
    for path in (capture_folder, single_file_folder, paris_folder):
        assert check_capture(path)[1] == []
        assert len(require_valid(path).states) == 2


def test_every_frame_is_looked_at_and_every_problem_told(capture_folder):
    state = capture_folder / "state_00"
    (state / "images/0000.png").unlink()
    (state / "images/0001.png").write_bytes((state / "images/0001.png").read_bytes()[:-20])
    put(state / "images/0002.png", np.zeros((8, 16, 3), np.uint8))
    put(state / "labels/0002.png", np.zeros((8, 8), np.uint8))
    put(state / "labels/0003.png", np.full((16, 16), 9, np.uint8))
    put(capture_folder / "state_01/labels/0007.png", np.full((16, 16, 3), [0, 0, 1], np.uint8))
    assert found(check_capture(capture_folder)[1]) == [
        "0000.png: the file does not exist",
        "0001.png: the image is cut off, damaged or of an unknown kind",
        "0002.png: it is 16x8 pixels, but its camera is 16x16",
        "0002.png: it is 8x8 pixels, but its camera is 16x16",
        "0003.png: the label 9 is none of the declared parts 1 to 2",
        "0007.png: labels are a PNG of 8-bit RGB",
    ]


def test_every_bad_entry_is_told_and_the_files_still_checked(capture_folder, edit):
    def change(meta):
        meta["frames"][0]["transform_matrix"][0][0] = float("inf")
        meta["frames"][1]["fl_x"] = "wide"
        meta["frames"][2].pop("transform_matrix")

    edit(capture_folder / FILE, change)
    (capture_folder / "state_01/images/0005.png").unlink()
    problems = check_capture(capture_folder)[1]
    assert found(problems) == [
        "transforms.json: an entry of transform_matrix of frame 'images/0000.png' is inf",
        "transforms.json: fl_x of frame 'images/0001.png' is 'wide'",
        "transforms.json: transform_matrix of frame 'images/0002.png' is missing",
        "0005.png: the file does not exist",
    ]
    assert all(p.mend for p in problems)


def test_the_first_error_is_raised_with_the_number_of_the_others(capture_folder):
    for i in range(3):
        (capture_folder / f"state_00/images/000{i}.png").unlink()
    with pytest.raises(InputError) as error:
        require_valid(capture_folder)
    text = str(error.value)
    assert text.startswith(f"{capture_folder / 'state_00/images/0000.png'}: the file does not exist; add it")
    assert text.endswith(f"(and 2 more, see `splatart check {capture_folder}`).")
    assert "\n" not in text


def test_one_state_shows_no_motion(capture_folder):
    shutil.rmtree(capture_folder / "state_01")
    assert found(check_capture(capture_folder)[1]) == ["capture: there is only the state state_00"]


def test_a_folder_that_cannot_be_read_is_named(capture_folder, monkeypatch):
    stat = os.stat

    def denied(path, **options):
        if not isinstance(path, int) and Path(path).parent == capture_folder / "state_00":
            raise PermissionError
        return stat(path, **options)

    monkeypatch.setattr(os, "stat", denied)
    (problem,) = check_capture(capture_folder)[1]
    assert problem.file == capture_folder / "state_00" and "cannot be read" in problem.message


def test_the_mend_of_a_windows_path_is_its_slashes(capture_folder, edit):
    edit(capture_folder / FILE, lambda m: m["frames"][0].update(semantics_path="labels\\0000.png"))
    (problem,) = check_capture(capture_folder)[1]
    assert problem.message == "the file does not exist" and problem.mend == "write / for \\ in its path"


def test_the_mend_of_a_path_without_its_suffix_is_the_suffix(capture_folder, edit):
    edit(capture_folder / FILE, lambda m: m["frames"][0].update(semantics_path="labels/0000"))
    (problem,) = check_capture(capture_folder)[1]
    assert problem.message == "the file does not exist" and problem.mend == "write .png after its path"


def test_a_broken_state_leaves_the_other_checked(capture_folder):
    (capture_folder / FILE).write_text("{")
    (capture_folder / "state_01/images/0000.png").unlink()
    errors = found(check_capture(capture_folder)[1])
    assert "is not JSON" in errors[0] and "0000.png: the file does not exist" in errors


def test_warnings_do_not_stop_a_fit(capture_folder, edit):
    for k in range(2):
        edit(capture_folder / f"state_0{k}/transforms.json", lambda m: m.update(val_filenames=[], test_filenames=[]))
    empty(capture_folder / "state_00/images/0000.png")
    problems = check_capture(capture_folder)[1]
    assert found(problems) == []
    assert found(problems, "warning") == ["capture: no view is held out for tests", "0000.png: the silhouette is empty"]
    require_valid(capture_folder)


def test_a_frame_for_training_and_test_is_a_warning(capture_folder, edit):
    edit(capture_folder / FILE, lambda m: m["train_filenames"].append("images/0007.png"))
    assert found(check_capture(capture_folder)[1], "warning") == [
        "transforms.json: 'images/0007.png' is a training frame and a test frame at once"
    ]


def test_only_empty_silhouettes_are_an_error(capture_folder):
    for file in (capture_folder / "state_00/images").iterdir():
        empty(file)
    assert found(check_capture(capture_folder)[1]) == ["state_00: all silhouettes are empty"]


def invert(file):
    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    image[..., 3] = 255 - image[..., 3]
    put(file, image)


def test_inverted_silhouettes_are_an_error_where_labels_tell(capture_folder, edit):
    files = sorted((capture_folder / "state_01/images").iterdir())
    invert(files[0])
    assert found(check_capture(capture_folder)[1]) == []  # which may be this frame's labels' fault
    for file in files[1:]:
        invert(file)
    edit(capture_folder / "state_01/transforms.json", lambda m: [e.pop("semantics_path") for e in m["frames"][2:]])
    assert found(check_capture(capture_folder)[1]) == [
        "state_01: the silhouettes leave out 100% of what is labelled as parts"
    ]


def test_an_object_mask_of_part_ids_is_an_error(capture_folder, edit):
    edit(capture_folder / FILE, lambda m: [e.update(object_mask_path=e["semantics_path"]) for e in m["frames"][:2]])
    told = "the mask is nowhere white: its values are 0, 1, 2"
    assert found(check_capture(capture_folder)[1]) == [f"0000.png: {told}", f"0001.png: {told}"]


def test_opaque_images_are_told_from_silhouettes(capture_folder, edit):
    for file in (capture_folder / "state_00/images").iterdir():
        put(file, np.full((16, 16, 4), 255, np.uint8))
    assert found(check_capture(capture_folder)[1], "warning") == []
    put(capture_folder / "state_00/all.png", np.full((16, 16), 255, np.uint8))
    edit(capture_folder / FILE, lambda m: [frame.update(object_mask_path="all.png") for frame in m["frames"]])
    assert ["fill their images" in w for w in found(check_capture(capture_folder)[1], "warning")] == [True]


def test_opaque_images_need_labels_that_tell_where_the_object_ends(capture_folder, edit):
    state = capture_folder / "state_00"
    for i, file in enumerate(sorted((state / "images").iterdir())):
        put(file, np.full((16, 16, 3 + i % 2), 255, np.uint8))  # also with an alpha that leaves nothing out
    assert found(check_capture(capture_folder)[1]) == []
    relabel(state, 0, 255)
    assert found(check_capture(capture_folder)[1]) == ["state_00: no labelled frame tells where the object ends"]

    test_frame = cv2.imread(str(state / "labels/0007.png"), cv2.IMREAD_UNCHANGED)
    put(state / "labels/0007.png", np.where(test_frame == 255, 0, test_frame))  # it is not looked at by a fit
    assert len(found(check_capture(capture_folder)[1])) == 1
    edit(capture_folder / FILE, lambda m: m["frames"][0].update(object_mask_path="labels/0001.png"))
    put(state / "labels/0001.png", np.where(test_frame == 255, 0, 255).astype(np.uint8))
    assert found(check_capture(capture_folder)[1]) == []


def test_masks_that_leave_nothing_to_learn_from_are_an_error(capture_folder, edit):
    put(capture_folder / "state_00/none.png", np.zeros((16, 16), np.uint8))
    edit(capture_folder / FILE, lambda m: [frame.update(mask_path="none.png") for frame in m["frames"]])
    assert found(check_capture(capture_folder)[1]) == ["state_00: the masks leave no pixel of any training frame"]


def test_cameras_on_one_spot_are_an_error(capture_folder, edit):
    def change(meta):
        for frame in meta["frames"]:
            frame["transform_matrix"] = meta["frames"][0]["transform_matrix"]

    edit(capture_folder / FILE, change)
    assert found(check_capture(capture_folder)[1]) == ["state_00: all training cameras stand on one spot"]


def test_a_state_in_another_world_is_a_warning(capture_folder, edit):
    def change(meta):
        for frame in meta["frames"]:
            frame["transform_matrix"][0][3] += 50

    edit(capture_folder / "state_01/transforms.json", change)
    (warning,) = [p for p in check_capture(capture_folder)[1] if "look" in p.message]
    assert (warning.severity, warning.file.name) == ("warning", "state_01") and "--worlds similar" in warning.mend
    edit(capture_folder / "state_01/transforms.json", lambda meta: meta.update(worlds="similar"))
    assert not [p for p in check_capture(capture_folder)[1] if "look" in p.message]


def test_a_state_without_training_views_is_an_error(capture_folder, edit):
    edit(capture_folder / FILE, lambda m: m.update(train_filenames=[]))
    errors = found(check_capture(capture_folder)[1])
    assert "state_00: the state has no training view" in errors


def test_an_image_in_two_frames_is_an_error(capture_folder, edit):
    edit(capture_folder / FILE, lambda m: m["frames"].append(m["frames"][3]))
    assert found(check_capture(capture_folder)[1]) == [
        "0003.png: the image belongs to two frames, in state_00 and in state_00"
    ]


def test_one_image_cannot_show_two_states(capture_folder, edit):
    edit(
        capture_folder / "state_01/transforms.json",
        lambda m: [
            m["frames"][0].update(file_path="../state_00/images/0000.png"),
            m["train_filenames"].__setitem__(0, "../state_00/images/0000.png"),
        ],
    )
    assert ["in state_00 and in state_01" in e for e in found(check_capture(capture_folder)[1])] == [True]


def test_numbers_that_labels_without_classes_leave_out_are_one_problem(capture_folder, edit):
    for k in range(2):
        relabel(capture_folder / f"state_0{k}", 2, 4)
        relabel(capture_folder / f"state_0{k}", 1, 2)
        edit(capture_folder / f"state_0{k}/transforms.json", lambda m: m.pop("semantic_classes"))
    told = ["capture: the labels go up to 4, but none is 1, 3"]
    problems = check_capture(capture_folder)[1]
    assert (found(problems), found(problems, "warning")) == ([], told)

    edit(capture_folder / "state_01/transforms.json", lambda m: m["frames"][0].pop("semantics_path"))
    assert found(check_capture(capture_folder)[1]) == told  # that frame may show them


def test_more_gaps_than_numbers_are_an_error(capture_folder, edit):
    for k in range(2):
        relabel(capture_folder / f"state_0{k}", 1, 80)
        relabel(capture_folder / f"state_0{k}", 2, 160)
        edit(capture_folder / f"state_0{k}/transforms.json", lambda m: m.pop("semantic_classes"))
    (problem,) = check_capture(capture_folder)[1]
    assert problem.severity == "error" and "up to 160, but none is 1, 2, 3, ..." in problem.message
    assert problem.mend.startswith("number the parts 1, 2, ... without gaps")


def test_names_that_are_made_fit_for_files_are_told_once(capture_folder, edit):
    for k in range(2):
        change = {"semantic_classes": ["background", "left door/T\u00fcr", "base"]}
        edit(capture_folder / f"state_0{k}/transforms.json", lambda m, change=change: m.update(change))
    (problem,) = check_capture(capture_folder)[1]
    assert problem.severity == "warning" and problem.file == capture_folder / "state_00/transforms.json"
    assert problem.message.endswith("'left door/T\u00fcr' is called left_door_Tur")


def test_no_labels_at_all_is_one_error(capture_folder):
    for k in range(2):
        for i in (1, 2):
            relabel(capture_folder / f"state_0{k}", i, 0)
    assert found(check_capture(capture_folder)[1]) == ["capture: no training frame has part labels"]


def test_a_state_without_labels_is_one_error(capture_folder):
    for i in (1, 2):
        relabel(capture_folder / "state_01", i, 255)
    assert found(check_capture(capture_folder)[1]) == ["state_01: no training frame of this state has part labels"]


def test_a_part_in_one_state_only_is_an_error(capture_folder):
    relabel(capture_folder / "state_01", 2, 0)
    assert found(check_capture(capture_folder)[1]) == [
        "capture: part 2 (door) is not labelled in state_01, so its motion cannot be known there"
    ]


def with_handle(capture_folder, edit):
    """Give a third part the upper half of the door in state 0 and of the base in state 1, where nothing is the door."""
    for k, owner in enumerate((2, 1)):
        state = capture_folder / f"state_0{k}"
        edit(state / "transforms.json", lambda m: m.update(semantic_classes=["background", "base", "door", "handle"]))
        for file in state.glob("labels/*.png"):
            labels = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
            rows = np.flatnonzero((labels == owner).any(1))
            upper = np.arange(len(labels))[:, None] < rows.mean()
            labels[(labels == owner) & upper] = 3
            labels[labels == 2] = 2 if k == 0 else 1
            put(file, labels)


def test_a_part_hidden_in_a_state_of_which_all_frames_are_labelled_is_a_warning(capture_folder, edit):
    with_handle(capture_folder, edit)
    told = ["capture: part 2 (door) is not labelled in state_01, so its motion cannot be known there"]
    problems = check_capture(capture_folder)[1]
    assert found(problems) == []
    assert found(problems, "warning") == told

    edit(capture_folder / "state_01/transforms.json", lambda m: m["frames"][0].pop("semantics_path"))
    assert found(check_capture(capture_folder)[1]) == told  # that frame may show it


def test_a_part_that_is_never_labelled_is_an_error(capture_folder):
    for k in range(2):
        relabel(capture_folder / f"state_0{k}", 2, 1)
    assert found(check_capture(capture_folder)[1]) == ["capture: part 2 (door) is never labelled"]


def test_a_class_that_fully_labelled_frames_never_show_is_a_warning(capture_folder, edit):
    for k in range(2):
        relabel(capture_folder / f"state_0{k}", 2, 3)
        edit(capture_folder / f"state_0{k}/transforms.json", lambda m: m["semantic_classes"].insert(2, "part_2"))
    problems = check_capture(capture_folder)[1]
    assert found(problems) == []
    assert found(problems, "warning") == ["capture: part 2 (part_2) is never labelled"]

    edit(capture_folder / "state_01/transforms.json", lambda m: m["frames"][0].pop("semantics_path"))
    assert found(check_capture(capture_folder)[1]) == ["capture: part 2 (part_2) is never labelled"]


def test_points_masks_and_depths_are_checked(capture_folder, edit):
    np.save(capture_folder / "state_00/d.npy", np.zeros((4, 7)))
    put(capture_folder / "state_00/m.png", np.zeros((16, 16), np.uint8))

    def change(meta):
        meta["ply_file_path"] = "nothing.ply"
        meta["frames"][0].update(mask_path="m.png", depth_file_path="d.npy", object_mask_path="nothing.png")

    edit(capture_folder / FILE, change)
    problems = check_capture(capture_folder)[1]
    assert [e.split(":")[0] for e in found(problems)] == ["nothing.png", "d.npy", "nothing.ply"]
    assert found(problems, "warning") == ["m.png: the mask leaves no pixel to the loss"]


def test_damaged_files_never_raise(capture_folder):
    files = sorted(capture_folder.glob("state_00/*/*.png"))
    rng = np.random.default_rng(0)
    for file in files:
        data = bytearray(file.read_bytes())
        for at in rng.integers(0, len(data), 3):
            data[at] = rng.integers(256)
        file.write_bytes(bytes(data))
    assert found(check_capture(capture_folder)[1])


def test_unreadable_json_values_never_raise(capture_folder):
    file = capture_folder / FILE
    meta = json.loads(file.read_text())
    for key in meta:
        for value in (None, 3, "x", [], [3], {}, -1, float("nan")):
            file.write_text(json.dumps({**meta, key: value}))
            check_capture(capture_folder)[1]
