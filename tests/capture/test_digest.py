"""What another fit would see changes a digest; where a capture lies, and when its files were written, does not."""

import os
import shutil

import cv2
import pytest

from splatart_ns.capture.digest import capture_digest, training_digest
from splatart_ns.capture.formats import load_capture


def change_image(file, value):
    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    image[0, 0] = value
    cv2.imwrite(str(file), image)


def transforms(change):
    return lambda folder, edit: edit(folder / "state_01/transforms.json", change)


def move(meta):
    meta["frames"][0]["transform_matrix"][0][3] += 1e-3


def test_a_state_may_have_any_name_that_a_folder_can_have(capture_folder):
    (capture_folder / "state_01").rename(capture_folder / os.fsdecode(b"state_\xff1"))
    assert len(capture_digest(load_capture(capture_folder))) == 64


SEEN = {
    "an image": lambda folder, edit: change_image(folder / "state_01/images/0000.png", 7),
    "labels": lambda folder, edit: change_image(folder / "state_01/labels/0000.png", 2),
    "a camera's place": transforms(move),
    "a camera's lens": transforms(lambda meta: meta.update(fl_x=meta["fl_x"] + 1)),
    "whether a frame has labels": transforms(lambda meta: meta["frames"][0].pop("semantics_path")),
    "which frames are trained on": transforms(lambda meta: meta["val_filenames"].append(meta["train_filenames"].pop())),
}


@pytest.mark.parametrize("what", SEEN)
def test_a_digest_changes_with_what_a_fit_sees(capture_folder, edit, what):
    before = load_capture(capture_folder)
    whole, trained = capture_digest(before), [training_digest(before, state) for state in (0, 1)]
    SEEN[what](capture_folder, edit)
    after = load_capture(capture_folder)
    assert capture_digest(after) != whole
    assert training_digest(after, 1) != trained[1]
    assert capture_digest(after, after.states[:1]) == capture_digest(before, before.states[:1])


def test_names_of_parts_count_for_the_whole_and_not_for_training(capture_folder, edit):
    before = load_capture(capture_folder)
    whole, trained = capture_digest(before), training_digest(before, 0)
    for state in ("state_00", "state_01"):
        file = capture_folder / state / "transforms.json"
        edit(file, lambda meta: meta["semantic_classes"].__setitem__(-1, "another name"))
    after = load_capture(capture_folder)
    assert capture_digest(after) != whole
    assert training_digest(after, 0) == trained


def test_neither_the_place_nor_the_time_of_files_counts(capture_folder, tmp_path):
    here = load_capture(capture_folder)
    there = load_capture(shutil.copytree(capture_folder, tmp_path / "elsewhere"))
    for file in there.path.rglob("*.png"):
        os.utime(file, (1, 1))
    assert capture_digest(there) == capture_digest(here)
    assert training_digest(there, 0) == training_digest(here, 0)
