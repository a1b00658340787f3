import dataclasses
import errno
import json
import os
import shutil
from itertools import count

import cv2
import numpy as np
import pytest
from label_exports import (
    EXPORTS,
    all_labels,
    flat_name,
    ragged,
    roboflow_name,
    without_labels,
    write_coco,
    write_masks,
    write_yolo,
)

from splatart_ns.capture import label_import
from splatart_ns.capture.check import check_capture
from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.images import read_labels
from splatart_ns.capture.label_import import _transforms, import_capture, import_labels
from splatart_ns.errors import InputError


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
    assert check_capture(tmp_path / "new")[1] == []


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


def test_the_copy_of_a_read_only_capture_can_be_written(capture_folder, tmp_path):
    folders = [path for path in capture_folder.rglob("*") if path.is_dir()]
    for folder in folders:
        folder.chmod(0o555)
    try:
        import_capture([capture_folder], tmp_path / "new", write_export(capture_folder, tmp_path))
    finally:
        for folder in folders:
            folder.chmod(0o755)
    copied = [path for path in (tmp_path / "new").rglob("*") if path.is_dir()]
    assert copied and all(path.stat().st_mode & 0o700 == 0o700 for path in copied)


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


@pytest.mark.parametrize("name", EXPORTS)
def test_parts_whose_names_no_file_can_have_are_found_by_those_of_our_labels(capture_folder, tmp_path, edit, name):
    names = ["background", "left door/T\u00fcr", "left_door_Tur"]
    for state in capture_folder.iterdir():
        edit(state / "transforms.json", lambda meta: meta.update(semantic_classes=names))
    capture = load_capture(capture_folder)
    assert capture.parts == {1: "left_door_Tur_2", 2: "left_door_Tur"}
    truth = all_labels(capture_folder)
    done = import_capture([capture_folder], tmp_path / "new", EXPORTS[name](capture, tmp_path / "export"))
    assert done.parts == tuple(names[1:])
    assert load_capture(tmp_path / "new").parts == capture.parts and all_labels(tmp_path / "new") == truth


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
    with pytest.raises(InputError, match=r"may be state_00/images/0000.jpg or state_00/images/0000.png; give it"):
        import_labels(capture_folder, export)


def test_images_of_one_name_are_told_apart_by_their_paths(single_file_folder, tmp_path):
    """As where training and test images count from 0 each."""
    file = single_file_folder / "transforms.json"
    (single_file_folder / "s0/rest").mkdir()
    (single_file_folder / "s0/images/0001.png").rename(single_file_folder / "s0/rest/0000.png")
    file.write_text(file.read_text().replace("s0/images/0001.png", "s0/rest/0000.png"))
    capture, truth = load_capture(single_file_folder), all_labels(single_file_folder)
    with pytest.raises(InputError, match=r"may be s0/images/0000.png or s0/rest/0000.png; give it its image's path"):
        import_labels(single_file_folder, write_coco(capture, tmp_path / "flat.json", "runs"))
    import_labels(single_file_folder, write_coco(capture, tmp_path / "paths.json", "runs", lambda _, frame: frame.name))
    assert all_labels(single_file_folder) == truth


def test_images_without_a_frame_are_told(capture_folder, tmp_path, edit):
    export = write_coco(load_capture(capture_folder), tmp_path / "labels.json", "runs")
    edit(export, lambda e: e["images"][0].update(file_name="elsewhere.png"))
    assert import_labels(capture_folder, export).unmatched == ("elsewhere.png",)


def test_only_what_belongs_to_a_capture_is_copied(capture_folder, paris_folder, tmp_path, edit):
    state = capture_folder / "state_00"
    for name in ("depth/0.npy", "depth/1.npy", "images_2/0000.png", "colmap/database.db", "sparse.ply", "raw.mp4"):
        (state / name).parent.mkdir(exist_ok=True)
        (state / name).write_bytes(b"x")
    shutil.copytree(capture_folder / "state_01", capture_folder / "eval/novel_00")
    (capture_folder / "ground_truth.json").write_text("{}")
    (capture_folder / "ground_truth_points").mkdir()
    (capture_folder / "ground_truth_points/part_1.ply").write_text("x")
    os.symlink("../depth/1.npy", state / "images/deep.npy")

    def name_some(meta):
        meta["ply_file_path"] = "sparse.ply"
        meta["frames"][0]["depth_file_path"] = f"{state}/depth/0.npy"
        meta["frames"][1]["depth_file_path"] = "images/deep.npy"
        meta["frames"][2]["depth_file_path"] = "depth/missing.npy"

    edit(state / "transforms.json", name_some)

    def files(folder):
        return {f.relative_to(folder).as_posix() for f in folder.rglob("*") if f.is_file()}

    left = {f"state_00/{name}" for name in ("depth/1.npy", "images_2/0000.png", "colmap/database.db", "raw.mp4")}
    import_capture([capture_folder], tmp_path / "new", write_export(capture_folder, tmp_path))
    new = tmp_path / "new"
    assert {f for f in files(new) if "semantics" not in f} == files(capture_folder) - left
    assert not (new / "state_00/colmap").exists()
    import_capture([state, capture_folder / "state_01"], tmp_path / "states")
    own = {f for f in files(capture_folder) - left if f.startswith("state_")}
    assert files(tmp_path / "states") == own

    (paris_folder / "notes.txt").write_text("x")
    import_capture([paris_folder], tmp_path / "paris_new", write_export(paris_folder, tmp_path / "p"))
    assert files(paris_folder) <= files(tmp_path / "paris_new")


def test_links_out_of_a_source_are_not_followed(capture_folder, tmp_path):
    (tmp_path / "secret.png").write_bytes(b"secret")
    os.symlink(tmp_path / "secret.png", capture_folder / "secret.png")
    os.symlink("/", capture_folder / "root")
    (capture_folder / "state_00/images/0001.png").rename(capture_folder / "state_00/image.png")
    os.symlink("../image.png", capture_folder / "state_00/images/0001.png")
    novel = capture_folder / "eval/novel_00"
    novel.mkdir(parents=True)
    os.symlink(tmp_path / "secret.png", novel / "secret.png")
    (novel / "transforms.json").write_text(json.dumps({"frames": [{"file_path": "secret.png"}, {"file_path": "\0"}]}))
    os.mkfifo(capture_folder / "pipe")
    import_capture([capture_folder], tmp_path / "new", write_export(capture_folder, tmp_path))
    assert {f.name for f in (tmp_path / "new").iterdir()} == {"state_00", "state_01", "eval"}
    assert (tmp_path / "new/state_00/images/0001.png").read_bytes().startswith(b"\x89PNG")
    assert [f.name for f in (tmp_path / "new/eval/novel_00").iterdir()] == ["transforms.json"]


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
    assert code == 2 and errors.startswith("error: ") and ("--output-dir" in errors or "--labels" in errors)
