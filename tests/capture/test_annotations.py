"""What among the files of an export is labels, and of which classes."""

import dataclasses
import json
import shutil

import cv2
import numpy as np
import pytest
from label_exports import (
    all_labels,
    flat_name,
    without_labels,
    write_coco,
    write_masks,
    write_yolo,
)

from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.images import read_labels
from splatart_ns.capture.label_import import import_labels
from splatart_ns.errors import InputError


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
