"""Folders of ArtGS, of DTA and of ns-process-data, and prompts for a segmenter, whatever is in them. `make fuzz` tries
more of it."""

import json
import math
import os
import shutil

import numpy as np
import pytest
import yaml
from fuzzing import damaged_bytes, damaged_json, fuzzed, one_sentence
from hypothesis import given
from hypothesis import strategies as st
from small_capture import SIZE, pose, write_images, write_state

from splatart_ns.capture.check import check_capture
from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.label_import import import_capture, import_labels
from splatart_ns.capture.segmenter import segment
from splatart_ns.capture.values import read_yaml
from splatart_ns.errors import InputError
from splatart_ns.plain_yaml import parse_yaml


def sound(capture):
    root = os.path.realpath(capture.path) + os.sep
    for frame in (frame for state in capture.states for frame in state.frames):
        T = frame.T_world_camera
        assert np.isfinite(T).all() and np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
        files = (frame.image, frame.labels, frame.object_mask, frame.mask, frame.depth)
        assert all(os.path.realpath(file).startswith(root) for file in files if file is not None)
        assert np.isfinite(frame.camera.K).all()
    assert np.isfinite(capture.normalization.centre).all() and 0 < capture.normalization.scale < np.inf


@pytest.fixture
def artgs_folder(tmp_path):
    path = tmp_path / "artgs"
    angle = 2 * math.atan(SIZE / 2 / 20.0)
    for state in ("start", "end"):
        for split, numbers in (("train", range(6)), ("test", range(6, 8))):
            entries = []
            for i in numbers:
                write_images(path / state / split, f"rgba/{i:04d}.png", f"depth/{i:04d}.png")
                entries.append({"file_path": f"./{state}/{split}/rgba/{i:04d}", "transform_matrix": pose(i)})
            meta = {"camera_angle_x": angle, "camera_angle_y": angle, "frames": entries}
            (path / f"transforms_{split}_{state}.json").write_text(json.dumps(meta))
    return path


@pytest.fixture
def dta_folder(tmp_path):
    path, keyframes = tmp_path / "dta", {}
    for i in range(6):
        write_images(path, f"color_segmented/{i:04d}.png", f"mask/{i:04d}.png")
        keyframes[f"frame_{i:04d}"] = {"cam_in_ob": np.ravel(pose(i)).tolist(), "time": i % 2}
    (path / "init_keyframes.yml").write_text(yaml.safe_dump(keyframes))
    (path / "cam_K.txt").write_text(f"20 0 {SIZE / 2}\n0 20 {SIZE / 2}\n0 0 1\n")
    return path


@pytest.fixture
def phone_folders(tmp_path):
    """Two states as ns-process-data leaves them of polycam and record3d: distortion, a point cloud, depth, own
    intrinsics."""
    extra = {"k1": 0.01, "k2": 0.0, "p1": 1e-4, "p2": 0.0, "applied_transform": np.eye(4)[:3].tolist()}
    for k in range(2):
        folder = tmp_path / f"phone_{k}"
        write_state(folder, **extra, ply_file_path="sparse.ply", worlds="similar", length_unit="metre")
        meta = json.loads((folder / "transforms.json").read_text())
        for frame in meta["frames"]:
            frame |= {"fl_x": 20.0, "fl_y": 20.0, "colmap_im_id": 1, "depth_file_path": frame["semantics_path"]}
        (folder / "transforms.json").write_text(json.dumps(meta))
        (folder / "sparse.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    return [tmp_path / f"phone_{k}" for k in range(2)]


@given(data=st.data())
@fuzzed
def test_any_file_of_artgs(artgs_folder, data):
    file = data.draw(st.sampled_from(sorted(artgs_folder.glob("*.json"))))
    original = file.read_bytes()
    try:
        file.write_bytes(data.draw(damaged_json(json.loads(original))))
        if (capture := one_sentence(load_capture, artgs_folder)) is not None:
            sound(capture)
        assert all(problem.mend and str(problem).isprintable() for problem in check_capture(artgs_folder)[1])
    finally:
        file.write_bytes(original)


TAGS = [
    "!!bool x",
    "!!int ''",
    "!!timestamp x",
    "!!python/name:os.system ''",
    "!!set {a}",
    "&a [*a]",
    "<<: *a",
    "? [1]",
]


@given(data=st.data())
@fuzzed
def test_any_file_of_dta(dta_folder, data):
    name = data.draw(st.sampled_from(["init_keyframes.yml", "init_keyframes.yml", "cam_K.txt"]))
    file = dta_folder / name
    original = file.read_bytes()
    try:
        if name == "cam_K.txt" or data.draw(st.booleans()):
            content = data.draw(damaged_bytes(original))
        else:
            content = data.draw(damaged_json(yaml.safe_load(original)))  # JSON is YAML
        if data.draw(st.integers(0, 3)) == 0:
            content += f"\nx: {data.draw(st.sampled_from(TAGS))}\n".encode()
        file.write_bytes(content)
        if (capture := one_sentence(load_capture, dta_folder)) is not None:
            sound(capture)
        assert all(problem.mend and str(problem).isprintable() for problem in check_capture(dta_folder)[1])
    finally:
        file.write_bytes(original)


@given(data=st.data())
@lambda test: fuzzed(test, one_in=2)  # every fourth is copied
def test_any_states_of_ns_process_data(phone_folders, tmp_path, data):
    file = phone_folders[1] / "transforms.json"
    original = file.read_bytes()
    outside = {f: f.stat().st_mtime_ns for f in tmp_path.iterdir() if f.name != "out"}
    try:
        file.write_bytes(data.draw(damaged_json(json.loads(original))))
        one_sentence(import_capture, phone_folders, tmp_path / "out")
        assert (tmp_path / "out").exists() or not [f for f in tmp_path.iterdir() if f.name.startswith(".out")]
        if (tmp_path / "out").exists() and (capture := one_sentence(load_capture, tmp_path / "out")) is not None:
            sound(capture)
        assert outside == {f: f.stat().st_mtime_ns for f in tmp_path.iterdir() if f.name != "out"}
    finally:
        file.write_bytes(original)
        shutil.rmtree(tmp_path / "out", ignore_errors=True)


PROMPTS = {
    "state_00/images/0001.png": {"lid": {"points": [[1, 2], [3, 4]], "not": [[5, 6]], "box": [1, 1, 9, 9]}},
    "state_01/images/0002.png": {"a knob": {"box": [2, 2, 5, 5]}, "door": {"points": [[4, 4]]}},
}
NAMES = ["\n", "\u2028", "\x85", "\udcff", "a,b", " lid", "LID", "Door", "background", "void", "../x", "é", "x" * 300]


@given(data=st.data())
@fuzzed
def test_any_prompts_give_labels_that_the_import_takes_or_refuses(capture_folder, tmp_path, data):
    capture, file = load_capture(capture_folder), tmp_path / "prompts.json"
    content = data.draw(damaged_json(PROMPTS))
    if data.draw(st.booleans()):
        content = content.replace(b'"lid"', json.dumps(data.draw(st.sampled_from(NAMES))).encode())
    file.write_bytes(content)

    def boxes(image, prompts):
        return np.stack([np.full(image.shape[:2], float(k)) for k, _ in enumerate(prompts)])

    if one_sentence(segment, capture, file, tmp_path / "out", boxes) is not None:
        shutil.copytree(capture_folder, tmp_path / "copy")
        one_sentence(import_labels, tmp_path / "copy", tmp_path / "out")
        shutil.rmtree(tmp_path / "copy")
        assert {f.name for f in tmp_path.iterdir()} == {"capture", "prompts.json", "out"}
        shutil.rmtree(tmp_path / "out")
    assert {f.name for f in tmp_path.iterdir()} == {"capture", "prompts.json"}


@pytest.mark.parametrize("name", ["a\rb", "a\u2028b", "a\x1eb"])
def test_a_part_s_name_stays_on_one_line(capture_folder, tmp_path, name):
    (tmp_path / "prompts.json").write_text(json.dumps({"state_00/images/0001.png": {name: {"box": [1, 1, 9, 9]}}}))
    with pytest.raises(InputError, match="is called"):
        segment(load_capture(capture_folder), tmp_path / "prompts.json", tmp_path / "out", None)


@pytest.mark.parametrize("file", ["init_keyframes.yml", "cam_K.txt", "transforms_train_start.json"])
def test_files_that_are_links_out_of_the_capture_are_refused(request, tmp_path, file):
    folder = request.getfixturevalue("artgs_folder" if file.endswith("json") else "dta_folder")
    shutil.move(folder / file, tmp_path / "elsewhere")
    os.symlink(tmp_path / "elsewhere", folder / file)
    with pytest.raises(InputError, match="a link out of the capture"):
        load_capture(folder)


def test_mappings_that_merge_each_other_take_no_memory(tmp_path):
    lines = ["a0: &a0 {k: v}"]
    lines += [f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 10)}]}}" for i in range(1, 12)]
    (tmp_path / "data.yaml").write_text("\n".join(lines))
    with pytest.raises(InputError, match="the file is not YAML"):
        read_yaml(tmp_path / "data.yaml")


@pytest.mark.parametrize("text", [*TAGS[:5], "[" * 5000, "2020-99-99", "- <<", "\0", "a: [" + "1," * (5 << 20)])
def test_yaml_that_is_none_is_a_value_error(text):
    with pytest.raises(ValueError):
        parse_yaml(text)
