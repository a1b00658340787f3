"""One capture in every layout and from every annotation tool: what a fit reads is the same, so the bundle is."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import FRAMES, STATES, pose, write_state
from label_exports import flat_name, write_coco, write_masks, write_yolo
from test_label_import import without_labels

from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.images import read_labels
from splatart_ns.capture.label_import import import_labels
from splatart_ns.capture.view import load_views


def as_folders(path: Path) -> Path:
    for k in range(STATES):
        write_state(path / f"state_{k:02d}")
        for i in range(FRAMES):  # another in each frame
            for kind in ("images", "labels"):
                file = path / f"state_{k:02d}/{kind}/{i:04d}.png"
                image = np.roll(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), (i - 3, k), (0, 1))
                cv2.imwrite(str(file), image)
    return path


def as_one_file(path: Path) -> Path:
    as_folders(path)
    frames: list[dict] = []
    lists: dict[str, list[str]] = {}
    for k, file in enumerate(sorted(path.glob("state_*/transforms.json"))):
        meta = json.loads(file.read_text())
        file.unlink()
        folder = file.parent.name
        for entry in meta.pop("frames"):
            moved = {key: f"{folder}/{entry[key]}" for key in ("file_path", "semantics_path")}
            frames.append(entry | moved | {"state": k})
        for key in [key for key in meta if key.endswith("_filenames")]:
            lists.setdefault(key, []).extend(f"{folder}/{name}" for name in meta.pop(key))
    (path / "transforms.json").write_text(json.dumps(meta | lists | {"frames": frames}))
    return path


def as_paris(path: Path) -> Path:
    source = load_capture(as_folders(path / "source"))
    for state, name in zip(source.states, ("start", "end"), strict=True):
        for split, as_split in (("train", "train"), ("test", "test")):
            frames = state.split(split)
            cameras = {"K": frames[0].camera.K.tolist()}
            for frame in frames:
                stem = Path(frame.name).stem
                cameras[stem] = pose(int(stem))
                for file, folder in ((frame.image, as_split), (frame.labels, f"{as_split}_semantics")):
                    target = path / name / folder / f"{stem}.png"
                    target.parent.mkdir(parents=True, exist_ok=True)
                    shutil.copy(file, target)
            (path / name / f"camera_{as_split}.json").write_text(json.dumps(cameras))
    shutil.rmtree(path / "source")
    return path


def through(write):
    """Labels go through an export and the import."""

    def make(path: Path) -> Path:
        labelled = load_capture(as_folders(path / "labelled"))
        export = write(labelled, path / "export")
        capture = without_labels(as_folders(path / "capture"))
        import_labels(capture, export)
        return capture

    return make


WAYS = {
    "one file": as_one_file,
    "PARIS": as_paris,
    "COCO": through(lambda c, out: write_coco(c, out / "_annotations.coco.json", "polygons", flat_name)),
    "YOLO": through(write_yolo),
    "masks": through(write_masks),
}


def what_fit_reads(path: Path) -> tuple:
    capture = load_capture(path)
    views = [load_views(capture, s, split) for s in range(len(capture.states)) for split in ("train", "test")]
    tensors = [
        [
            tuple(t if t is None else t.tolist() for t in (v.viewmat, v.K, v.rgb, v.alpha, v.labels, v.mask))
            for v in some
        ]
        for some in views
    ]
    normalization = capture.normalization
    return list(capture.parts), normalization.centre.tolist(), normalization.scale, tensors


@pytest.mark.parametrize("way", WAYS)
def test_a_fit_reads_the_same_whatever_way_a_capture_came(way, tmp_path):
    expected = what_fit_reads(as_folders(tmp_path / "folders"))
    assert read_labels(tmp_path / "folders/state_01/labels/0003.png").any()
    assert what_fit_reads(WAYS[way](tmp_path / "other")) == expected
