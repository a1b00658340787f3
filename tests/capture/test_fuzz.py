"""Whatever is in a file from a stranger: a value that is sound, or one sentence. `make fuzz` tries more of it."""

import io
import json
import os
import struct
import zlib

import cv2
import numpy as np
import PIL.Image
import pytest
import trimesh
from fuzzing import damaged_bytes, damaged_json, fuzzed, one_sentence
from hypothesis import given
from hypothesis import strategies as st
from label_exports import write_coco, write_masks, write_yolo

from splatart_ns.capture.annotations import read_annotations
from splatart_ns.capture.capture import Normalization
from splatart_ns.capture.check import check_capture
from splatart_ns.capture.examination import examine
from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.images import image_size, read_depth, read_image, read_labels, read_mask, read_silhouette
from splatart_ns.capture.label_import import import_labels
from splatart_ns.capture.view import load_points
from splatart_ns.errors import InputError

RNG = np.random.default_rng(0)


def encoded(suffix, pixels):
    return cv2.imencode(suffix, pixels)[1].tobytes()


def palette_png():
    image = PIL.Image.fromarray(RNG.integers(0, 4, (9, 7), np.uint8), mode="P")
    image.putpalette(list(range(12)))
    file = io.BytesIO()
    image.save(file, "png")
    return file.getvalue()


def saved(array):
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def pixels(*shape, dtype=np.uint8):
    return RNG.integers(0, 200, shape).astype(dtype)


IMAGES = [
    encoded(".png", pixels(9, 7, 4)),
    encoded(".png", pixels(9, 7, 3, dtype=np.uint16)),
    encoded(".png", pixels(9, 7)),
    encoded(".jpg", pixels(9, 7, 3)),
    encoded(".webp", pixels(9, 7, 3)),
    encoded(".tiff", pixels(9, 7, dtype=np.float32)),
    encoded(".bmp", pixels(9, 7, 3)),
]
LABELS = [encoded(".png", pixels(9, 7)), encoded(".png", pixels(9, 7, dtype=np.uint16)), *IMAGES[:1], palette_png()]
DEPTHS = [saved(RNG.random((9, 7))), saved(RNG.random((9, 7, 1)).astype(np.float32)), LABELS[1]]
POINTS = [
    trimesh.PointCloud(RNG.random((20, 3)), colors=pixels(20, 4)).export(file_type="ply", encoding=encoding)
    for encoding in ("binary", "ascii")
]


@given(data=st.sampled_from(IMAGES).flatmap(damaged_bytes))
@fuzzed
def test_any_image(tmp_path, data):
    file = tmp_path / "image.png"
    file.write_bytes(data)
    image = one_sentence(read_image, file)
    assert image is None or (image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] in (3, 4))
    for mask in (one_sentence(read_mask, file), one_sentence(read_silhouette, file)):
        assert mask is None or (mask.dtype == np.uint8 and mask.ndim == 2)
    one_sentence(image_size, file)


@given(data=st.sampled_from(LABELS).flatmap(damaged_bytes))
@fuzzed
def test_any_label_png(tmp_path, data):
    file = tmp_path / "labels.png"
    file.write_bytes(data)
    labels = one_sentence(read_labels, file)
    assert labels is None or (labels.dtype == np.uint8 and labels.ndim == 2)


@given(data=st.sampled_from(DEPTHS).flatmap(damaged_bytes), suffix=st.sampled_from([".npy", ".png"]))
@fuzzed
def test_any_depth(tmp_path, data, suffix):
    file = tmp_path / f"depth{suffix}"
    file.write_bytes(data)
    depth = one_sentence(read_depth, file)
    assert depth is None or (depth.dtype == np.float32 and depth.ndim == 2 and np.isfinite(depth).all())


@given(data=st.sampled_from(POINTS).flatmap(damaged_bytes))
@fuzzed
def test_any_point_cloud(tmp_path, data):
    file = tmp_path / "points.ply"
    file.write_bytes(data)
    points = one_sentence(load_points, file, Normalization(np.zeros(3), 1.0))
    assert points is None or (points[0].isfinite().all() and len(points[0]) == len(points[1]) > 0)


def sound(capture):
    assert len(capture.states) >= 1
    for state in capture.states:
        for frame in state.frames:
            T = frame.T_world_camera
            assert np.isfinite(T).all() and np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
            assert os.path.realpath(frame.image).startswith(os.path.realpath(capture.path) + os.sep)
            assert np.isfinite([frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy]).all()
    assert np.isfinite(capture.normalization.centre).all() and 0 < capture.normalization.scale < np.inf


@pytest.mark.parametrize("layout", ["capture_folder", "single_file_folder", "paris_folder"])
@given(data=st.data())
@fuzzed
def test_any_json_of_a_capture(request, layout, data):
    path = request.getfixturevalue(layout)
    file = min(path.rglob("*.json"))
    original = file.read_bytes()
    meta = {"camera_angle_x": 1.0, "k1": 0.01, "ply_file_path": "a.ply", "distortion_params": [0.0] * 6}
    try:
        file.write_bytes(data.draw(damaged_json({**json.loads(original), **({} if "camera" in file.name else meta)})))
        if (capture := one_sentence(load_capture, path)) is not None:
            sound(capture)
        for problem in check_capture(path)[1]:
            assert problem.mend and "\n" not in problem.message.split("is not JSON")[0]
    finally:
        file.write_bytes(original)


@given(data=st.data())
@fuzzed
def test_any_file_of_an_export(capture_folder, tmp_path, data):
    capture = load_capture(capture_folder)
    export = tmp_path / "export"
    if not export.exists():
        write_coco(capture, export / "polygons/a.json", "polygons")
        write_coco(capture, export / "runs/a.json", "runs")
        write_coco(capture, export / "compressed/a.json", "compressed")
        write_yolo(capture, export / "yolo")
        write_masks(capture, export / "masks")
    kind = data.draw(st.sampled_from(["polygons", "runs", "compressed", "yolo", "masks"]))
    files = sorted(f for f in (export / kind).rglob("*") if f.is_file() and f.suffix != ".jpg")
    file = data.draw(st.sampled_from(files))
    original = file.read_bytes()
    try:
        content = damaged_json(json.loads(original)) if file.suffix == ".json" else damaged_bytes(original)
        file.write_bytes(data.draw(content))
        annotations = one_sentence(read_annotations, export / kind)
        for image in annotations.images[:4] if annotations else ():
            labels = one_sentence(image.draw, 16, 16)
            assert labels is None or (labels.ndim == 2 and labels.max() <= len(annotations.classes))
    finally:
        file.write_bytes(original)


@given(data=st.data())
@lambda test: fuzzed(test, one_in=6)  # a second each
def test_any_damage_to_a_capture_is_examined(hinge_capture, tmp_path, data):
    """The whole check, of a capture with some damaged files."""
    path = tmp_path / "capture"
    if not path.exists():
        for file in hinge_capture.rglob("state_*/*"):
            target = path / file.relative_to(hinge_capture)
            target.parent.mkdir(parents=True, exist_ok=True)
            if file.is_dir():
                target.mkdir(exist_ok=True)
                for inner in file.iterdir():
                    (target / inner.name).write_bytes(inner.read_bytes())
            else:
                target.write_bytes(file.read_bytes())
    files = sorted(f for f in path.rglob("*") if f.is_file())
    changed = {}
    try:
        for file in data.draw(st.lists(st.sampled_from(files), min_size=1, max_size=4, unique=True)):
            changed[file] = file.read_bytes()
            json_file = file.suffix == ".json"
            content = damaged_json(json.loads(changed[file])) if json_file else damaged_bytes(changed[file])
            file.write_bytes(data.draw(content))
        examination = examine(path, suggest=1)
        assert all(problem.mend for problem in examination.problems)
    finally:
        for file, content in changed.items():
            file.write_bytes(content)


def bomb(width, height):
    """A PNG of a few bytes that promises many pixels."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0" * 999)) + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("reader", [read_image, read_labels, read_mask, read_silhouette, read_depth])
@pytest.mark.parametrize("size", [(60_000, 60_000), (12_000, 12_000), (2**31 - 1, 2**31 - 1)])
def test_an_image_that_promises_too_many_pixels_is_not_decoded(tmp_path, monkeypatch, reader, size):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    (tmp_path / "bomb.png").write_bytes(bomb(*size))
    with pytest.raises(InputError, match=r"bomb\.png: the image "):
        reader(tmp_path / "bomb.png")


def test_an_array_that_promises_more_than_the_file_holds_takes_no_memory(tmp_path):
    header = saved(np.zeros((4, 4))).replace(b"(4, 4)", b"(1000000, 1000000)")
    (tmp_path / "depth.npy").write_bytes(header)
    with pytest.raises(InputError, match="the depth cannot be read"):
        read_depth(tmp_path / "depth.npy")


def test_pickles_are_not_opened(tmp_path):
    np.save(tmp_path / "depth.npy", np.array([[print]], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="the depth cannot be read"):
        read_depth(tmp_path / "depth.npy")


@pytest.mark.parametrize("label", [65535, 256])
def test_labels_beyond_the_largest_part_are_refused(tmp_path, label):
    cv2.imwrite(str(tmp_path / "labels.png"), np.full((4, 4), label, np.uint16))
    with pytest.raises(InputError, match=f"label {label} is above the largest part id, 254"):
        read_labels(tmp_path / "labels.png")


OUTSIDE = ["../../secret.png", "/etc/hostname", "images/../../../secret.png", "link.png", "folder/secret.png"]


@pytest.mark.parametrize("key", ["file_path", "semantics_path", "object_mask_path", "mask_path", "depth_file_path"])
@pytest.mark.parametrize("value", OUTSIDE)
def test_no_path_leads_out_of_the_capture(capture_folder, tmp_path, edit, key, value):
    (tmp_path / "secret.png").write_bytes(encoded(".png", pixels(16, 16, 3)))
    os.symlink(tmp_path / "secret.png", capture_folder / "state_00/link.png")
    os.symlink(tmp_path, capture_folder / "state_00/folder")
    edit(
        capture_folder / "state_00/transforms.json",
        lambda meta: [meta["frames"][2].update({key: value}), meta.update(train_filenames=[], val_filenames=[])],
    )
    edit(
        capture_folder / "state_00/transforms.json",
        lambda meta: meta.update(train_filenames=[frame["file_path"] for frame in meta["frames"]], test_filenames=[]),
    )
    with pytest.raises(InputError, match="outside the capture; copy the file into the capture"):
        load_capture(capture_folder)


def test_a_state_that_is_a_link_out_of_the_capture_is_refused(capture_folder, tmp_path):
    (capture_folder / "state_01").rename(tmp_path / "elsewhere")
    os.symlink(tmp_path / "elsewhere", capture_folder / "state_01")
    with pytest.raises(InputError, match="a link out of the capture"):
        load_capture(capture_folder)


def test_a_link_within_the_capture_is_followed(capture_folder):
    image = capture_folder / "state_00/images/0003.png"
    image.rename(capture_folder / "moved.png")
    os.symlink("../../moved.png", image)
    assert check_capture(capture_folder)[1] == []


def test_links_in_circles_and_pipes_are_refused(capture_folder):
    for name, make in (("0002.png", lambda f: os.symlink(f, f)), ("0003.png", os.mkfifo)):
        image = capture_folder / "state_00/images" / name
        image.unlink()
        make(image)
    assert [p.file.name for p in check_capture(capture_folder)[1]] == ["0002.png", "0003.png"]


def test_names_that_are_not_utf8_are_read_and_printed(capture_folder, edit, run_main):
    name = b"\xff\xfe.png"
    folder = os.fsencode(capture_folder / "state_00/images")
    os.rename(folder + b"/0003.png", folder + b"/" + name)

    def rename(meta):
        meta["frames"][3]["file_path"] = f"images/{os.fsdecode(name)}"
        meta["train_filenames"][3] = f"images/{os.fsdecode(name)}"

    edit(capture_folder / "state_00/transforms.json", rename)
    assert check_capture(capture_folder)[1] == []
    os.unlink(folder + b"/" + name)
    code, output, errors = run_main("check", capture_folder)
    assert code == 2 and "\\udcff\\udcfe.png: the file does not exist" in output and errors == ""


def test_a_json_file_that_is_too_large_is_not_read(capture_folder):
    with open(capture_folder / "state_00/transforms.json", "wb") as file:
        file.truncate(300 << 20)  # sparse
    with pytest.raises(InputError, match="larger than 256 MiB"):
        load_capture(capture_folder)


def test_import_writes_nothing_outside_whatever_the_names_are(capture_folder, tmp_path, edit):
    export = write_coco(load_capture(capture_folder), tmp_path / "labels.json", "runs")
    edit(export, lambda e: [image.update(file_name="../../" + image["file_name"]) for image in e["images"]])
    before = {f for f in tmp_path.rglob("*") if "capture" not in f.parts}
    import_labels(capture_folder, export)
    assert {f for f in tmp_path.rglob("*") if "capture" not in f.parts} == before
