import dataclasses
import errno
import json
import os
import re
import shutil
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import PIL.ExifTags
import PIL.Image
import PIL.ImageOps
import pytest
from label_exports import flat_name, label_studio_name, roboflow_name, write_coco, write_masks, write_yolo

from splatart_ns.capture import label_import
from splatart_ns.capture.check import check_capture
from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.images import read_labels
from splatart_ns.capture.label_import import _transforms, import_capture, import_labels
from splatart_ns.errors import InputError


def without_labels(path):
    """The capture without any label."""
    for file in path.rglob("*.png"):
        if "labels" in file.parent.name or "semantics" in file.parent.name:
            file.unlink()
    for file in path.rglob("transforms.json"):
        meta = json.loads(file.read_text())
        meta.pop("semantic_classes", None)
        for entry in meta["frames"]:
            entry.pop("semantics_path")
        file.write_text(json.dumps(meta))
    return path


def ragged(capture):
    """Labels with holes, single pixels and unlabelled ones, another in every frame."""
    rng = np.random.default_rng(0)
    for state in capture.states:
        for frame in state.frames:
            labels = read_labels(frame.labels)
            labels[rng.random(labels.shape) < 0.1] = 1
            labels[rng.random(labels.shape) < 0.1] = 2
            labels[rng.random(labels.shape) < 0.1] = 255
            cv2.imwrite(str(frame.labels), labels)
    return capture


def all_labels(path):
    capture = load_capture(path)
    return {
        (state, frame.image.parts[-2:], frame.split): read_labels(frame.labels).tolist()
        for state, frames in enumerate(s.frames for s in capture.states)
        for frame in frames
        if frame.labels is not None
    }


EXPORTS = {
    "COCO polygons": lambda c, out: write_coco(c, out / "_annotations.coco.json", "polygons"),
    "COCO runs": lambda c, out: write_coco(c, out / "instances.json", "runs"),
    "COCO compressed runs": lambda c, out: write_coco(c, out / "a/_annotations.coco.json", "compressed", roboflow_name),
    "COCO folder": lambda c, out: write_coco(c, out / "train/_annotations.coco.json", "runs").parents[1],
    "COCO of Label Studio": lambda c, out: write_coco(c, out / "result.json", "polygons", label_studio_name),
    "YOLO": write_yolo,
    "YOLO of Roboflow": lambda c, out: write_yolo(c, out, roboflow_name),
    "YOLO of Label Studio": lambda c, out: write_yolo(c, out, label_studio_name),
    "masks": lambda c, out: write_masks(c, out, flat_name),
    "masks of Roboflow": write_masks,
}


def bit_for_bit(path, tmp_path, write):
    capture = ragged(load_capture(path))
    truth = all_labels(path)
    export = write(capture)
    without_labels(path)
    done = import_capture([path], tmp_path / "new", export)
    assert all_labels(tmp_path / "new") == truth
    assert (done.labelled, done.frames, done.unmatched) == (len(truth), len(truth), ())
    assert load_capture(tmp_path / "new").parts == capture.parts
    assert all_labels(path) == {}


@pytest.mark.parametrize("layout", ["capture_folder", "single_file_folder"])
@pytest.mark.parametrize("name", EXPORTS)
def test_labels_come_back_bit_for_bit(request, tmp_path, layout, name):
    bit_for_bit(request.getfixturevalue(layout), tmp_path, lambda c: EXPORTS[name](c, tmp_path / "export"))


@pytest.mark.parametrize("write", [write_yolo, write_masks])
def test_labels_of_paris_come_back_bit_for_bit(paris_folder, tmp_path, write):
    def whole_path(state, frame):  # its splits may count from 0 each
        return f"{state.name}_{frame.name.replace('/', '_')}"

    bit_for_bit(paris_folder, tmp_path, lambda c: write(c, tmp_path / "export", whole_path))


def test_a_transforms_json_for_another_layout_says_all_that_its_files_said(capture_folder):
    """ArtGS' cameras may be distorted, and count depth in other units."""

    def told(capture):
        return [[(f.camera, f.depth_unit, f.split) for f in state.frames] for state in capture.states]

    capture = load_capture(capture_folder)
    for state in capture.states:
        frame = state.frames[0]
        camera = dataclasses.replace(frame.camera, distortion=(0.02, 0.001, 0.0, 0.0, 1e-4, -2e-4))
        object.__setattr__(frame, "camera", camera)
        object.__setattr__(frame, "depth", frame.image)
        object.__setattr__(frame, "depth_unit", 0.25)
        (capture_folder / state.name / "transforms.json").unlink()
    content = _transforms(capture) | {"semantic_classes": ["background", *capture.parts.values()]}
    (capture_folder / "transforms.json").write_text(json.dumps(content))
    assert told(load_capture(capture_folder)) == told(capture)


def test_an_export_of_each_state_lies_in_a_folder_of_its_name(capture_folder, tmp_path):
    truth = all_labels(capture_folder)
    capture = load_capture(capture_folder)
    for state in capture.states:
        one = dataclasses.replace(capture, states=(state,))
        file = tmp_path / f"export/{state.name}/result.json"
        write_coco(one, file, "runs", lambda state, frame: frame.image.name)
    without_labels(capture_folder)
    import_capture([capture_folder], tmp_path / "new", tmp_path / "export")
    assert all_labels(tmp_path / "new") == truth


def test_folders_of_single_states_become_one_capture(capture_folder, tmp_path):
    truth = {(1 - k, *rest): labels for (k, *rest), labels in all_labels(capture_folder).items()}
    scans = capture_folder.rename(tmp_path / "scans")
    sources = [scans / "state_01", scans / "state_00"]
    assert import_capture(sources, tmp_path / "new") is None
    assert [s.name for s in load_capture(tmp_path / "new").states] == ["state_00", "state_01"]
    assert all_labels(tmp_path / "new") == truth
    assert check_capture(tmp_path / "new") == []


def test_a_copy_names_its_own_files_where_the_source_names_them_by_absolute_paths(capture_folder, tmp_path, edit):
    def absolute(meta):
        for e in meta["frames"][:4]:
            e.update(file_path=f"{state}/{e['file_path']}", semantics_path=f"{state}/{e['semantics_path']}")
        meta["frames"][4]["semantics_path"] = f"../{state.name}/labels/0004.png"
        meta["train_filenames"] = [e["file_path"] for e in meta["frames"][:6]]

    truth = all_labels(capture_folder)
    for state in sorted(capture_folder.iterdir()):
        edit(state / "transforms.json", absolute)
    import_capture(sorted(capture_folder.iterdir()), tmp_path / "states")
    import_capture([capture_folder], tmp_path / "whole", write_export(capture_folder, tmp_path))
    shutil.rmtree(capture_folder)
    assert all_labels(tmp_path / "states") == all_labels(tmp_path / "whole") == truth


def test_errors_about_a_copy_name_its_source(capture_folder, tmp_path, edit):
    export = write_masks(load_capture(capture_folder), tmp_path / "export", flat_name)
    (export / "train/state_00_0003_mask.png").unlink()
    states = [capture_folder / "state_01", capture_folder / "state_00"]
    for state in states:
        edit(state / "transforms.json", lambda meta: meta.pop("semantic_classes"))
    for sources, state in (([capture_folder], "state_00"), (states, "state_01")):
        with pytest.raises(InputError) as error:
            import_capture(sources, tmp_path / "new", export)
        assert str(error.value).startswith(f"{capture_folder}/{state}/labels/0003.png: its parts have no names")


def test_labels_go_into_the_capture_itself_only_on_request(capture_folder, tmp_path):
    truth = all_labels(capture_folder)
    export = write_coco(load_capture(capture_folder), tmp_path / "labels.json", "polygons")
    without_labels(capture_folder)
    import_labels(capture_folder, export)
    assert all_labels(capture_folder) == truth
    meta = json.loads((capture_folder / "state_00/transforms.json").read_text())
    assert meta["frames"][3]["semantics_path"] == "semantics/0003.png"
    assert meta["semantic_classes"] == ["background", "base", "door"]


@pytest.mark.parametrize("written", ["png", "json"])
def test_an_import_that_fails_half_way_leaves_the_capture_as_it_was(capture_folder, tmp_path, monkeypatch, written):
    write, calls = getattr(label_import, f"write_{written}"), count()

    def fail_at_second(file, value):
        if next(calls):
            raise OSError(errno.ENOSPC, "No space left on device", str(file))
        write(file, value)

    def files():
        return {f: f.read_bytes() for f in capture_folder.rglob("*") if f.is_file()}

    export = write_coco(load_capture(capture_folder), tmp_path / "labels.json", "runs")
    state = capture_folder / "state_00"
    (state / "labels").rename(state / "semantics")  # where new labels go
    cv2.imwrite(str(state / "semantics/0000.png"), np.ones((16, 16), np.uint8))
    text = (state / "transforms.json").read_text()
    (state / "transforms.json").write_text(text.replace('"labels/', '"semantics/'))
    before = files()
    monkeypatch.setattr(label_import, f"write_{written}", fail_at_second)
    with pytest.raises(OSError, match="No space") as error:
        import_labels(capture_folder, export)
    assert ".tmp" not in error.value.filename
    assert files() == before and not (capture_folder / "state_01/semantics").exists()


def test_a_few_labelled_frames_leave_the_others_as_they_are(capture_folder, tmp_path):
    export = write_masks(load_capture(capture_folder), tmp_path / "export", flat_name)
    for file in sorted(export.glob("train/state_0?_000[3-7]_mask.png")):
        file.unlink()
    without_labels(capture_folder)
    done = import_capture([capture_folder], tmp_path / "new", export)
    assert (done.labelled, done.frames) == (6, 16)
    assert len(all_labels(tmp_path / "new")) == 6


def test_declared_parts_keep_their_ids_and_new_ones_follow(capture_folder, tmp_path, edit):
    export = write_yolo(load_capture(capture_folder), tmp_path / "export")
    (export / "data.yaml").write_text("names:\n  0: Door\n  1: handle\n")
    import_labels(capture_folder, export)
    capture = load_capture(capture_folder)
    assert capture.parts == {1: "base", 2: "door", 3: "handle"}
    assert set(np.unique(read_labels(capture.states[0].frames[0].labels))) == {0, 2, 3}


def test_new_classes_beside_old_labels_without_names_are_refused(capture_folder, tmp_path, edit):
    export = write_masks(load_capture(capture_folder), tmp_path / "export", flat_name)
    for state in ("state_00", "state_01"):
        edit(capture_folder / state / "transforms.json", lambda meta: meta.pop("semantic_classes"))
    assert import_labels(shutil.copytree(capture_folder, tmp_path / "all"), export).parts == ("base", "door")
    (export / "train/state_00_0003_mask.png").unlink()
    with pytest.raises(InputError, match=r"labels/0003\.png: its parts have no names, so 'base' of the"):
        import_labels(capture_folder, export)
    (export / "train/_classes.csv").write_text("1, part_2\n2, part_1\n")
    assert import_labels(capture_folder, export).parts == ("part_1", "part_2")


def test_files_of_frames_that_are_not_labelled_are_not_overwritten(capture_folder, tmp_path, edit):
    def other_frames_files(meta):
        meta["frames"][0]["semantics_path"] = "semantics/0001.png"
        meta["frames"][2]["object_mask_path"] = "./semantics/0001.png.png"

    export = write_masks(load_capture(capture_folder), tmp_path / "export", flat_name)
    for file in set(export.glob("train/*_mask.png")) - {export / "train/state_00_0001_mask.png"}:
        file.unlink()
    state = capture_folder / "state_00"
    edit(state / "transforms.json", other_frames_files)
    (state / "semantics").mkdir()
    for name in ("0001.png", "0001.png.png"):
        cv2.imwrite(str(state / "semantics" / name), np.full((16, 16), 2, np.uint8))
    assert import_labels(capture_folder, export).labelled == 1
    frames = load_capture(capture_folder).states[0].frames
    assert np.unique(read_labels(frames[0].labels)).tolist() == [2]
    assert np.unique(read_labels(frames[2].object_mask)).tolist() == [2]
    assert np.unique(read_labels(frames[1].labels)).tolist() == [0, 1, 2]


@pytest.mark.parametrize(
    "name",
    [
        r"images\1a2b3c4d-state_00_0000.png",
        r"C:\data\state_00_0000.png",
        r"C:\data\state_00\images\0000.png",
        "https://host/data/state_00_0000.png?token=a/b.c",
        "https://host/o/my%20images%2Fstate_00%2F0000.PNG?alt=media#a",
    ],
)
def test_images_are_known_by_windows_paths_and_addresses(capture_folder, tmp_path, edit, name):
    export = write_coco(load_capture(capture_folder), tmp_path / "export/a/labels.json", "runs")
    edit(export, lambda e: e["images"][0].update(file_name=name))
    done = import_labels(capture_folder, tmp_path / "export")
    assert (done.labelled, done.unmatched) == (16, ())


@pytest.mark.parametrize("name", ["1a2b3c4d-", "1a2b3c4d-.", "..rf.x", "."])
def test_names_of_nothing_but_what_tools_add_fit_no_frame(capture_folder, tmp_path, edit, name):
    export = write_coco(load_capture(capture_folder), tmp_path / "labels.json", "runs")
    edit(export, lambda e: e["images"][0].update(file_name=name))
    assert len(import_labels(capture_folder, export).unmatched) == 1


def test_an_export_may_lie_in_a_folder_of_any_name(capture_folder, tmp_path):
    export = write_yolo(load_capture(capture_folder), tmp_path / "labels")
    assert import_labels(capture_folder, export).labelled == 16
    (export / "train/images").mkdir()
    cv2.imwrite(str(export / "train/images/state_00_0000.png"), np.zeros((8, 8), np.uint8))
    with pytest.raises(InputError, match="'train/labels/state_00_0000' is 8x8 pixels"):
        import_labels(capture_folder, export)


@pytest.mark.parametrize("mask", ["{}_mask.png", "{}-Mask.png", "{}.labels.png", "../masks/{}.png"])
def test_pictures_beside_masks_are_not_taken_for_labels(capture_folder, tmp_path, mask):
    truth = all_labels(capture_folder)
    (tmp_path / "export/images").mkdir(parents=True)
    (tmp_path / "export/masks").mkdir()
    (tmp_path / "export/classes.txt").write_text("base\ndoor\n")
    for state in load_capture(capture_folder).states:
        for frame in state.frames:
            stem = f"{state.name}_{frame.image.stem}"
            shutil.copy(frame.image, tmp_path / f"export/images/{stem}.png")
            shutil.copy(frame.labels, tmp_path / "export/images" / mask.format(stem))
    without_labels(capture_folder)
    assert import_labels(capture_folder, tmp_path / "export").unmatched == ()
    assert all_labels(capture_folder) == truth


def test_texts_beside_masks_are_not_taken_for_labels(capture_folder, tmp_path):
    export = write_masks(load_capture(capture_folder), tmp_path / "export", flat_name)
    (export / "train/_classes.csv").unlink()
    (export / "classes.txt").write_text("base\ndoor\n")
    (export / "notes.txt").write_bytes(b"labelled by Ren\xe9\n")
    (export / "todo.txt").write_text("3 frames are left\n")
    assert import_labels(capture_folder, export).format == "masks"


def test_polygons_need_no_data_yaml_to_be_known(capture_folder, tmp_path):
    export = write_yolo(load_capture(capture_folder), tmp_path / "export")
    (export / "data.yaml").unlink()
    (export / "classes.txt").write_text("base\ndoor\nignore\n")
    (export / "train/labels").rename(export / "texts")
    assert import_labels(capture_folder, export).format == "YOLO"


@pytest.mark.parametrize("listed", ["data/obj_train_data/{}.png", "C:\\my data\\{}.JPG\r"])
def test_lists_of_images_beside_polygons_are_passed_over(capture_folder, tmp_path, listed):
    """Darknet's train.txt, as CVAT writes it."""
    export = write_yolo(load_capture(capture_folder), tmp_path / "export")
    (export / "data.yaml").unlink()
    (export / "obj.names").write_text("base\ndoor\nignore\n")
    (export / "obj.data").write_text("classes = 3\ntrain = data/train.txt\nnames = data/obj.names\n")
    (export / "train/labels").rename(export / "obj_train_data")
    stems = sorted(f.stem for f in (export / "obj_train_data").iterdir())
    (export / "train.txt").write_text("".join(listed.format(stem) + "\n" for stem in stems))
    (export / "valid.txt").write_text("")
    done = import_labels(capture_folder, export)
    assert (done.format, done.labelled, done.unmatched) == ("YOLO", 16, ())


def test_other_files_beside_coco_are_passed_over(capture_folder, tmp_path):
    export = tmp_path / "export"
    write_coco(load_capture(capture_folder), export / "result.json", "runs")
    (export / "__MACOSX").mkdir()
    for name in ("._result.json", "__MACOSX/result.json", ".cache.txt"):
        (export / name).write_bytes(b"\0\5\x16\7\xff")
    (export / "tasks.json").write_text('[{"id": 1, "annotations": []}]')
    (export / "notes.json").write_text('{"version": 3}')
    assert import_labels(capture_folder, export).labelled == 16


@pytest.mark.parametrize("content", ["[1]", '{"version": 3}'])
def test_json_that_is_not_coco_is_to_be_exported_as_coco(capture_folder, tmp_path, content):
    (tmp_path / "export").mkdir()
    (tmp_path / "export/tasks.json").write_text(content)
    cv2.imwrite(str(tmp_path / "export/state_00_0000.png"), np.zeros((16, 16), np.uint8))
    for export in (tmp_path / "export", tmp_path / "export/tasks.json"):
        with pytest.raises(InputError, match=r"tasks\.json: .*; export the labels as COCO segmentation"):
            import_labels(capture_folder, export)


def test_line_numbers_of_a_list_of_classes_stay_where_lines_are_empty(capture_folder, tmp_path):
    truth = all_labels(capture_folder)
    export = write_yolo(load_capture(capture_folder), tmp_path / "export")
    (export / "data.yaml").unlink()
    (export / "classes.txt").write_text("base\n\ndoor\n\n")
    with pytest.raises(InputError, match=r"has class 1, which none of the 2 classes is; add its name"):
        import_labels(capture_folder, export)
    for file in export.glob("train/labels/*.txt"):
        file.write_text(file.read_text().replace("\n1 ", "\n2 "))
    without_labels(capture_folder)
    assert import_labels(capture_folder, export).parts == ("base", "door")
    assert all_labels(capture_folder) == truth


def coco_split(capture, folder, names):
    file = write_coco(capture, folder / "_annotations.coco.json", "runs")
    content = json.loads(file.read_text())
    numbers = {part: number for number, part in capture.parts.items()}
    moved = {numbers.get(name, 90): number for number, name in enumerate(names, start=1)}
    content["categories"] = [{"id": number, "name": name} for number, name in enumerate(names, start=1)]
    for annotation in content["annotations"]:
        annotation["category_id"] = moved[annotation["category_id"]]
    file.write_text(json.dumps(content))


def yolo_split(capture, folder, names):
    write_yolo(capture, folder)
    (folder / "data.yaml").write_text(f"names: {json.dumps(names)}\n")
    for file in folder.glob("train/labels/*.txt"):
        lines = [line.partition(" ") for line in file.read_text().splitlines()]
        numbers = [names.index(capture.parts[int(number) + 1]) for number, _, _ in lines]
        file.write_text("\n".join(f"{n} {rest}" for n, (_, _, rest) in zip(numbers, lines, strict=True)))


def mask_split(capture, folder, names):
    write_masks(capture, folder, flat_name)
    rows = [f"{number}, {name}" for number, name in enumerate(names, start=1)]
    (folder / "train/_classes.csv").write_text("\n".join(rows) + "\n")
    for file in folder.glob("train/*_mask.png"):
        labels = read_labels(file)
        numbers = np.array([0, *(names.index(part) + 1 for part in capture.parts.values())], np.uint8)
        cv2.imwrite(str(file), numbers[labels])


def write_splits(path, tmp_path, write, lists):
    capture = load_capture(path)
    for split, state, names in zip(("train", "valid"), capture.states, lists, strict=True):
        write(dataclasses.replace(capture, states=(state,)), tmp_path / "export" / split, names)
    return tmp_path / "export"


@pytest.mark.parametrize("write", [coco_split, yolo_split, mask_split])
def test_splits_need_the_same_classes_only_where_they_are_used(capture_folder, tmp_path, write):
    truth = all_labels(capture_folder)
    lists = ["base", "door"], ["hinge", "door", "base", "handle"]
    export = write_splits(capture_folder, tmp_path, write, lists)
    without_labels(capture_folder)
    assert import_labels(capture_folder, export).parts == ("base", "door")
    assert all_labels(capture_folder) == truth


@pytest.mark.parametrize("write", [coco_split, yolo_split, mask_split])
def test_splits_whose_used_classes_have_other_names_are_refused(capture_folder, tmp_path, write):
    def renamed(capture, folder, names):
        write(dataclasses.replace(capture, parts=dict(enumerate(names, start=1))), folder, names)

    export = write_splits(capture_folder, tmp_path, renamed, (["base", "door"], ["base", "lid"]))
    with pytest.raises(InputError, match=r"export/valid/.*: its class 'lid' is none of those of .*export/train/"):
        import_labels(capture_folder, export)


@pytest.mark.parametrize("categories", [{}, {"categories": []}])
def test_a_split_without_annotations_labels_nothing(capture_folder, tmp_path, edit, categories):
    for split in ("train", "valid"):
        write_coco(load_capture(capture_folder), tmp_path / f"export/{split}/_annotations.coco.json", "runs")
    edit(tmp_path / "export/valid/_annotations.coco.json", lambda e: e.update(annotations=[], **categories))
    assert import_labels(capture_folder, tmp_path / "export").labelled == 16


def two_of_one_stem(capture_folder):
    """The second frame's image becomes a JPEG that is called as the first's, and its labels other ones."""
    images = capture_folder / "state_00/images"
    cv2.imwrite(str(images / "0000.jpg"), cv2.imread(str(images / "0001.png")))
    text = (capture_folder / "state_00/transforms.json").read_text()
    (capture_folder / "state_00/transforms.json").write_text(text.replace("images/0001.png", "images/0000.jpg"))
    cv2.imwrite(str(capture_folder / "state_00/labels/0001.png"), np.ones((16, 16), np.uint8))
    return load_capture(capture_folder)


@pytest.mark.parametrize(
    "write",
    [
        lambda c, out: write_coco(c, out / "labels.json", "runs"),
        lambda c, out: write_coco(c, out / "labels.json", "runs", roboflow_name),
        write_masks,
    ],
)
def test_suffixes_tell_images_of_one_stem_apart(capture_folder, tmp_path, write):
    capture = two_of_one_stem(capture_folder)
    truth = all_labels(capture_folder)
    export = write(capture, tmp_path / "export")
    without_labels(capture_folder)
    import_labels(capture_folder, export)
    assert all_labels(capture_folder) == truth


@pytest.mark.parametrize("write", [write_yolo, lambda c, out: write_masks(c, out, flat_name)])
def test_images_of_one_stem_that_an_export_does_not_tell_apart_need_other_names(capture_folder, tmp_path, write):
    export = write(two_of_one_stem(capture_folder), tmp_path / "export")
    with pytest.raises(InputError, match=r"may be state_00/images/0000.jpg or state_00/images/0000.png; give the two"):
        import_labels(capture_folder, export)


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


def test_images_without_a_frame_are_told(capture_folder, tmp_path, edit):
    export = write_coco(load_capture(capture_folder), tmp_path / "labels.json", "runs")
    edit(export, lambda e: e["images"][0].update(file_name="elsewhere.png"))
    assert import_labels(capture_folder, export).unmatched == ("elsewhere.png",)


def change_coco(change):
    def make(capture, folder):
        file = write_coco(capture, folder / "labels.json", "runs")
        content = json.loads(file.read_text())
        change(content)
        file.write_text(json.dumps(content))
        return file

    return make


def change_text(pattern, text):
    def make(capture, folder):
        (file, *_) = write_yolo(capture, folder).glob(pattern)
        file.write_text(text)
        return folder

    return make


def zipped(capture, folder):
    write_coco(capture, folder / "labels.json", "runs")
    return Path(shutil.make_archive(folder, "zip", folder)).replace(folder / "labels.zip")


def one_text(capture, folder):
    return min(write_yolo(capture, folder).glob("train/labels/*.txt"))


def segmentation_mask(capture, folder):
    """As CVAT writes it."""
    write_masks(capture, folder, flat_name)
    (folder / "train/_classes.csv").unlink()
    (folder / "train").rename(folder / "SegmentationClass")
    (folder / "labelmap.txt").write_text("# label:color_rgb:parts:actions\nbackground:0,0,0::\nbase:250,50,83::\n")
    (folder / "default.txt").write_text("0000\n0001\n0002\n0003\n0004\n")
    return folder


def segmentation(value):
    return change_coco(lambda e: e["annotations"][0].update(segmentation=value))


BAD_EXPORTS = {
    "resized": (change_coco(lambda e: e["images"][0].update(width=640)), "640x16 pixels; export it at the size"),
    "no name fits": (change_coco(lambda e: [i.update(file_name=f"a{i['id']}") for i in e["images"]]), "no frame"),
    "ambiguous": (change_coco(lambda e: e["images"][0].update(file_name="0000.png")), "'0000.png' may be state_00/"),
    "augmented": (change_coco(lambda e: e["images"][1].update(file_name="state_00_0000_png.rf.x.jpg")), "both label"),
    "box": (segmentation([]), "not boxes"),
    "two corners": (segmentation([[1, 2, 3, 4]]), "three corners"),
    "corner of text": (segmentation([[1, 2, 3, 4, "x", 5]]), "a coordinate of a segmentation"),
    "runs of another size": (segmentation({"size": [4, 4], "counts": [16]}), "is {'counts': [16]"),
    "runs too long": (segmentation({"size": [16, 16], "counts": [10**12]}), "do not fill"),
    "negative runs": (segmentation({"size": [16, 16], "counts": [300, -44]}), "do not fill"),
    "damaged runs": (segmentation({"size": [16, 16], "counts": "\u00e9"}), "damaged"),
    "runs cut off": (segmentation({"size": [16, 16], "counts": "o"}), "cut off"),
    "runs of endless numbers": (segmentation({"size": [16, 16], "counts": "o" * 10**5}), "damaged"),
    "unknown category": (change_coco(lambda e: e["annotations"][0].update(category_id=9)), "category_id 9"),
    "unknown image": (change_coco(lambda e: e["annotations"][0].update(image_id=99)), "image_id 99"),
    "no annotations": (change_coco(lambda e: e.update(annotations=[])), "labels no image"),
    "annotations of text": (change_coco(lambda e: e.update(annotations=["x"])), "annotations[0] is 'x'"),
    "YOLO boxes": (change_text("train/labels/*0003.txt", "0 0.5 0.5 0.1 0.1"), "a box is no polygon"),
    "YOLO pixels": (change_text("train/labels/*0003.txt", "0 5 5 9 9 5 9"), "divide them"),
    "YOLO words": (change_text("train/labels/*0003.txt", "door 0.5 0.5 0.1 0.1"), "line 1 is 'door"),
    "YOLO class": (change_text("train/labels/*0003.txt", "7 0.1 0.1 0.2 0.1 0.2 0.2"), "class 7, which none of"),
    "YOLO without NaN": (change_text("train/labels/*0003.txt", "0 nan 0.1 0.2 0.1 0.2 0.2"), "nan"),
    "YAML with code": (change_text("data.yaml", "names: !!python/object/apply:os.getcwd []"), "not YAML"),
    "YAML without names": (change_text("data.yaml", "names: 3"), "names is 3"),
    "one text": (one_text, "give the folder that holds data.yaml or classes.txt"),
    "zip": (zipped, "it is a zip; unpack it first"),
    "masks of colours": (segmentation_mask, "export the labels as COCO 1.0"),
    "nothing": (lambda c, folder: folder, "there are no labels here"),
}


@pytest.mark.parametrize("name", BAD_EXPORTS)
def test_what_cannot_be_imported_is_named_and_nothing_written(capture_folder, tmp_path, name):
    make, words = BAD_EXPORTS[name]
    export = make(load_capture(capture_folder), tmp_path / "export")
    with pytest.raises(InputError) as error:
        import_capture([capture_folder], tmp_path / "new", export)
    assert words in str(error.value) and str(tmp_path / "export") in str(error.value)
    assert {f.name for f in tmp_path.iterdir()} <= {"capture", "export"}


def test_masks_need_classes_for_all_their_values(capture_folder, tmp_path):
    export = write_masks(load_capture(capture_folder), tmp_path / "export", flat_name)
    (export / "train/_classes.csv").write_text("Pixel Value, Class\n0, background\n1, base\n")
    with pytest.raises(InputError, match=r"_mask\.png: no class has the value 2"):
        import_labels(capture_folder, export)
    (export / "train/_classes.csv").unlink()
    with pytest.raises(InputError, match="the names of the classes are missing"):
        import_labels(capture_folder, export)
    (export / "classes.txt").write_text("base\n\ndoor\n")
    with pytest.raises(InputError, match=r"_mask\.png: no class has the value 2"):
        import_labels(capture_folder, export)
    (export / "classes.txt").write_text("base\ndoor\n")
    assert import_labels(capture_folder, export).parts == ("base", "door")


def test_a_list_of_mask_classes_may_quote_names_and_lack_a_heading(capture_folder, tmp_path):
    export = write_masks(load_capture(capture_folder), tmp_path / "export", flat_name)
    without_labels(capture_folder)
    (export / "train/_classes.csv").write_text('1,"lid, upper"\n"0", "background"\n2,"door"\n')
    assert import_labels(capture_folder, export).parts == ("lid, upper", "door")


def test_two_classes_of_one_pixel_value_are_refused(capture_folder, tmp_path):
    export = write_masks(load_capture(capture_folder), tmp_path / "export", flat_name)
    (export / "train/_classes.csv").write_text("Pixel Value, Class\n1, base\n2, lid\n2, door\n")
    with pytest.raises(InputError, match=r"_classes\.csv: the pixel value 2 is 'lid' and, in line 4, 'door'"):
        import_labels(capture_folder, export)


def test_masks_of_background_alone_leave_their_frames_unlabelled(capture_folder, tmp_path):
    export = write_masks(load_capture(capture_folder), tmp_path / "export", flat_name)
    for file in sorted(export.glob("train/state_0?_000[3-7]_mask.png")):
        cv2.imwrite(str(file), np.zeros((16, 16), np.uint8))
    without_labels(capture_folder)
    assert import_labels(capture_folder, export).labelled == 6
    assert len(all_labels(capture_folder)) == 6


def test_links_out_of_a_source_are_not_followed(capture_folder, tmp_path):
    (tmp_path / "secret.png").write_bytes(b"secret")
    os.symlink(tmp_path / "secret.png", capture_folder / "secret.png")
    os.symlink("/", capture_folder / "root")
    os.symlink("images/0001.png", capture_folder / "state_00/inside.png")
    os.mkfifo(capture_folder / "pipe")
    import_capture([capture_folder], tmp_path / "new", write_export(capture_folder, tmp_path))
    assert {f.name for f in (tmp_path / "new").iterdir()} == {"state_00", "state_01"}
    assert (tmp_path / "new/state_00/inside.png").read_bytes().startswith(b"\x89PNG")


def test_labels_are_not_written_through_a_link_out_of_the_capture(capture_folder, tmp_path):
    export = write_export(capture_folder, tmp_path)
    (tmp_path / "elsewhere").mkdir()
    os.symlink(tmp_path / "elsewhere", capture_folder / "state_00/semantics")
    with pytest.raises(InputError, match="a link out of the capture"):
        import_labels(capture_folder, export)
    assert list((tmp_path / "elsewhere").iterdir()) == []


def write_export(path, tmp_path):
    return write_coco(load_capture(path), tmp_path / "labels.json", "runs")


def test_the_output_folder_may_not_be_in_use_nor_inside_the_source(capture_folder, tmp_path):
    export = write_export(capture_folder, tmp_path)
    with pytest.raises(InputError, match="not empty"):
        import_capture([capture_folder], capture_folder, export)
    with pytest.raises(InputError, match="lies inside"):
        import_capture([capture_folder], capture_folder / "new", export)
    assert sorted(f.name for f in capture_folder.iterdir()) == ["state_00", "state_01"]


def test_the_command_says_what_it_did(run_main, capture_folder, tmp_path):
    export = write_export(capture_folder, tmp_path)
    code, output, errors = run_main("import", capture_folder, "--labels", export, "--output-dir", tmp_path / "new")
    assert (code, errors) == (0, "")
    assert output == f"Labels: COCO, 16 of 16 frames; parts: base, door\nCapture: {tmp_path / 'new'}\n"
    assert run_main("import", capture_folder, "--labels", export, "--in-place")[0] == 0
    states = [capture_folder / "state_00", capture_folder / "state_01"]
    assert run_main("import", *states, "--output-dir", tmp_path / "two")[0] == 0
    assert all_labels(tmp_path / "two") == all_labels(capture_folder)


@pytest.mark.parametrize(
    "arguments", [[], ["a"], ["a", "--in-place"], ["a", "b"], ["a", "--output-dir", "new"]], ids=str
)
def test_the_command_needs_a_source_a_target_and_something_to_import(run_main, arguments):
    code, _, errors = run_main("import", *arguments)
    assert code == 2 and errors.startswith("error: ") and "--output-dir" in errors or "--labels" in errors
