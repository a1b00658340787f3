"""Labels of images that EXIF data turn."""

import re
import shutil

import numpy as np
import PIL.ExifTags
import PIL.Image
import PIL.ImageOps
import pytest
from label_exports import EXPORTS, all_labels, flat_name, ragged, without_labels, write_yolo

from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.label_import import import_labels
from splatart_ns.errors import InputError


def turned_by_exif(capture_folder, edit, turn):
    """Images become JPEGs of 16x12 that EXIF data turn, and labels what tools draw on them as they show them. Gives the
    labels before."""
    exif = PIL.Image.Exif()
    exif[PIL.ExifTags.Base.Orientation] = turn
    for state in sorted(capture_folder.iterdir()):
        for file in sorted((state / "images").iterdir()):
            pixels = PIL.Image.open(file).convert("RGB").crop((0, 0, 16, 12))
            pixels.save(file.with_suffix(".jpg"), exif=exif)
        text = (state / "transforms.json").read_text()
        (state / "transforms.json").write_text(re.sub(r"(images/\d+)\.png", r"\1.jpg", text))
        edit(state / "transforms.json", lambda meta: meta.update(h=12, cy=6.0))
    capture = ragged(load_capture(capture_folder))
    files = [frame.labels for state in capture.states for frame in state.frames]
    for file in files:
        PIL.Image.open(file).crop((0, 0, 16, 12)).save(file)
    truth = all_labels(capture_folder)
    for file in files:
        labels = PIL.Image.open(file)
        labels.getexif()[PIL.ExifTags.Base.Orientation] = turn
        PIL.Image.fromarray(np.array(PIL.ImageOps.exif_transpose(labels))).save(file)
    return truth


def yolo_with_pictures(capture, folder):
    write_yolo(capture, folder, digits=9)
    (folder / "train/images").mkdir()
    for state in capture.states:
        for frame in state.frames:
            shutil.copy(frame.image, folder / "train/images" / flat_name(state, frame))
    return folder


@pytest.mark.parametrize("turn", [5, 6, 7, 8])
@pytest.mark.parametrize("write", [EXPORTS["COCO runs"], yolo_with_pictures, EXPORTS["masks"]])
def test_labels_of_images_that_exif_turns_on_their_side_are_turned_back(capture_folder, tmp_path, edit, turn, write):
    truth = turned_by_exif(capture_folder, edit, turn)
    export = write(load_capture(capture_folder), tmp_path / "export")
    without_labels(capture_folder)
    import_labels(capture_folder, export)
    assert all_labels(capture_folder) == truth


def test_labels_of_the_stored_size_are_not_turned(capture_folder, tmp_path, edit):
    turned_by_exif(capture_folder, edit, 6)
    for file in capture_folder.rglob("labels/*.png"):
        PIL.Image.open(file).transpose(PIL.Image.Transpose.ROTATE_90).save(file)
    truth = all_labels(capture_folder)
    import_labels(capture_folder, EXPORTS["masks"](load_capture(capture_folder), tmp_path / "export"))
    assert all_labels(capture_folder) == truth


@pytest.mark.parametrize(("turn", "write"), [(3, EXPORTS["COCO runs"]), (6, write_yolo)])
def test_labels_that_may_be_turned_or_not_are_refused(capture_folder, tmp_path, edit, turn, write):
    turned_by_exif(capture_folder, edit, turn)
    export = write(load_capture(capture_folder), tmp_path / "export")
    with pytest.raises(InputError, match=rf"images/0000\.jpg: EXIF data turn it \(orientation {turn}\), and .*; take"):
        import_labels(capture_folder, export)
