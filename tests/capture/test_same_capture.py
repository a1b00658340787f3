"""One capture in every layout and from every annotation tool: what a fit reads is the same, so the bundle is."""

import json
import math
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from label_exports import flat_name, without_labels, write_coco, write_masks, write_yolo
from small_capture import FRAMES, SIZE, STATES, pose, write_state

from splatart_ns.capture.capture import Frame, State
from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.images import read_labels
from splatart_ns.capture.label_import import import_labels
from splatart_ns.capture.view import load_views
from splatart_ns.errors import InputError


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


def as_artgs(path: Path) -> Path:
    source = load_capture(as_folders(path / "source"))
    for state, name in zip(source.states, ("start", "end"), strict=True):
        for split in ("train", "test"):
            entries = []
            for frame in state.split(split):
                target = path / "capture" / name / split / "rgba" / Path(frame.name).name
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(frame.image, target)
                entry = {"file_path": f"./{name}/{split}/rgba/{target.stem}", "time": float(name == "end")}
                entries.append(entry | {"transform_matrix": pose(int(target.stem))})
            angle = 2 * math.atan(SIZE / 2 / 20.0)
            meta = {"camera_angle_x": angle, "camera_angle_y": angle, "frames": entries}
            (path / "capture" / f"transforms_{split}_{name}.json").write_text(json.dumps(meta))

    def name_there(state: State, frame: Frame) -> str:
        return f"{('start', 'end')[int(state.name[-2:])]}_{frame.split}_rgba_{Path(frame.name).name}"

    import_labels(path / "capture", write_masks(source, path / "export", name_there))
    return path / "capture"


def as_dta(path: Path) -> Path:
    source = load_capture(as_folders(path / "source"))
    keyframes = {}
    for k, state in enumerate(source.states):
        for i, frame in enumerate(state.frames):
            image = cv2.imread(str(frame.image), cv2.IMREAD_UNCHANGED)
            for folder, pixels in (("color_segmented", image[..., :3]), ("mask", image[..., 3])):
                file = path / "capture" / folder / f"{k}_{i:04d}.png"
                file.parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(file), pixels)
            keyframes[f"frame_{k}_{i:04d}"] = {"cam_in_ob": np.ravel(pose(i)).tolist(), "time": k}
    (path / "capture/init_keyframes.yml").write_text(yaml.safe_dump(keyframes))
    np.savetxt(path / "capture/cam_K.txt", source.states[0].frames[0].camera.K)
    export = write_masks(
        source, path / "export", lambda state, frame: f"{int(state.name[-2:])}_{Path(frame.name).name}"
    )
    import_labels(path / "capture", export)
    return path / "capture"


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
    "ArtGS": as_artgs,
    "DTA": as_dta,
    "COCO": through(lambda c, out: write_coco(c, out / "_annotations.coco.json", "polygons", flat_name)),
    "YOLO": through(write_yolo),
    "masks": through(write_masks),
}


def what_fit_reads(path: Path) -> tuple:
    capture = load_capture(path)
    views = [  # DTA has no splits
        load_views(capture, s, "train") + load_views(capture, s, "test") for s in range(len(capture.states))
    ]
    cameras = [[(view.viewmat.double().round(decimals=9) + 0.0).tolist() for view in some] for some in views]
    pixels = [
        [tuple(t if t is None else t.tolist() for t in (v.K, v.rgb, v.alpha, v.labels, v.mask)) for v in some]
        for some in views
    ]
    normalization = capture.normalization
    world = np.round([*normalization.centre, normalization.scale], 12).tolist()
    return list(capture.parts), world, cameras, pixels


@pytest.mark.parametrize("way", WAYS)
def test_a_fit_reads_the_same_whatever_way_a_capture_came(way, tmp_path):
    expected = what_fit_reads(as_folders(tmp_path / "folders"))
    assert read_labels(tmp_path / "folders/state_01/labels/0003.png").any()
    assert what_fit_reads(WAYS[way](tmp_path / "other")) == expected


@pytest.mark.parametrize(
    ("layout", "depth"), [(as_artgs, "start/train/depth/0000.png"), (as_dta, "depth_filtered/0_0000.png")]
)
def test_depth_is_found_beside_the_images_that_have_it(layout, depth, tmp_path):
    capture = layout(tmp_path)
    (capture / "transforms.json").unlink()  # of the import
    (capture / depth).parent.mkdir()
    cv2.imwrite(str(capture / depth), np.full((SIZE, SIZE), 1500, np.uint16))
    first, second = load_capture(capture).states[0].frames[:2]
    assert (first.depth, second.depth) == (capture / depth, None)


def test_keyframes_have_their_own_intrinsics_and_every_eighth_is_for_tests(tmp_path):
    capture = as_dta(tmp_path)
    (capture / "transforms.json").unlink()
    np.savetxt(capture / "cam_K.txt", [[20, 0, 7], [0, 22, 9], [0, 0, 1]])
    frames = load_capture(capture).states[1].frames
    camera = frames[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (20, 22, 7, 9)
    assert [frame.split for frame in frames] == ["train"] * 7 + ["test"]


def test_damaged_keyframes_are_one_sentence(tmp_path):
    capture = as_dta(tmp_path)
    (capture / "transforms.json").unlink()  # of the import
    file = capture / "init_keyframes.yml"
    whole = file.read_text()
    for damaged in ("[", "!!python/object/apply:os.system [ls]", "frame_0: 3\n", whole.replace("time: 1", "time: 7")):
        file.write_text(damaged)
        with pytest.raises(InputError):
            load_capture(capture)
    file.write_text(whole)
    (capture / "cam_K.txt").write_text("1 2 x")
    with pytest.raises(InputError, match="matrix"):
        load_capture(capture)


def test_damaged_files_of_artgs_are_one_sentence(tmp_path):
    capture = as_artgs(tmp_path)
    (capture / "transforms.json").unlink()
    file = capture / "transforms_train_end.json"
    whole = json.loads(file.read_text())
    for frames in (3, [3], [{"file_path": "../../../0"}], [whole["frames"][0] | {"transform_matrix": 1}]):
        file.write_text(json.dumps(whole | {"frames": frames}))
        with pytest.raises(InputError):
            load_capture(capture)
