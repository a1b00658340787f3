"""Exports of annotation tools, made from a capture's own labels."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from pycocotools import mask as coco

from splatart_ns.capture.capture import Capture, Frame, State
from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.images import read_labels

Naming = Callable[[State, Frame], str]


def flat_name(state: State, frame: Frame) -> str:
    """As people name images before they upload them: state_00_0001.png."""
    return f"{state.name}_{Path(frame.name).name}"


def roboflow_name(state: State, frame: Frame) -> str:
    name = Path(flat_name(state, frame))
    return f"{name.stem}_{name.suffix[1:]}.rf.9f3c1a{abs(hash(frame.name)) % 1000:03d}.jpg"


def label_studio_name(state: State, frame: Frame) -> str:
    return f"images/{abs(hash(frame.name)) % 16**8:08x}-{flat_name(state, frame)}"


def outlines(mask: np.ndarray) -> list[list[float]]:
    """Polygons along the pixel borders of a mask: a rectangle for each run of pixels in a row."""
    polygons = []
    for y, row in enumerate(mask):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
        for x0, x1 in edges.reshape(-1, 2).tolist():
            polygons.append([x0, y, x1, y, x1, y + 1, x0, y + 1])
    return polygons


def _labelled(capture: Capture) -> Iterator[tuple[State, Frame, np.ndarray]]:
    for state in capture.states:
        for frame in state.frames:
            if frame.labels is not None:
                yield state, frame, read_labels(frame.labels)


def write_coco(capture: Capture, file: Path, shapes: str, name: Naming = flat_name) -> Path:
    """`shapes` is "polygons", "runs" or "compressed"."""
    images, annotations = [], []
    for number, (state, frame, labels) in enumerate(_labelled(capture), start=1):
        height, width = labels.shape
        images.append({"id": number, "file_name": name(state, frame), "width": width, "height": height})
        for part in sorted(set(np.unique(labels).tolist()) - {0}):
            mask = labels == part
            if shapes == "polygons":
                segmentation = outlines(mask)
            elif shapes == "runs":
                column = mask.T.ravel()
                starts = np.flatnonzero(np.diff(column, prepend=~column[:1]))
                counts = np.diff(starts, append=len(column)).tolist()
                segmentation = {"counts": [0, *counts] if column[0] else counts, "size": [height, width]}
            else:
                segmentation = coco.encode(np.asfortranarray(mask.astype(np.uint8)))
                segmentation["counts"] = segmentation["counts"].decode()
            annotations.append({"image_id": number, "category_id": part, "segmentation": segmentation, "iscrowd": 0})
    # Roboflow's way: the project first, as the category of all others.
    categories = [{"id": 0, "name": "my-parts", "supercategory": "none"}]
    categories += [{"id": i, "name": part, "supercategory": "my-parts"} for i, part in capture.parts.items()]
    categories.append({"id": 255, "name": "unlabelled", "supercategory": "my-parts"})
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps({"images": images, "categories": categories, "annotations": annotations}))
    return file


def write_yolo(capture: Capture, folder: Path, name: Naming = flat_name, digits: int = 6) -> Path:
    (folder / "train/labels").mkdir(parents=True)
    names = [*capture.parts.values(), "ignore"]
    (folder / "data.yaml").write_text(f"train: ../train/images\nnc: {len(names)}\nnames: {json.dumps(names)}\n")
    (folder / "README.roboflow.txt").write_text("exported\n")
    for state, frame, labels in _labelled(capture):
        height, width = labels.shape
        lines = []
        for part in sorted(set(np.unique(labels).tolist()) - {0}):
            for polygon in outlines(labels == part):
                numbers = np.array(polygon).reshape(-1, 2) / [width, height]
                number = len(names) - 1 if part == 255 else part - 1
                lines.append(" ".join([str(number), *(f"{x:.{digits}f}" for x in numbers.ravel())]))
        file = folder / "train/labels" / f"{Path(name(state, frame)).stem}.txt"
        file.write_text("\n".join(lines))
    return folder


def write_masks(capture: Capture, folder: Path, name: Naming = roboflow_name) -> Path:
    (folder / "train").mkdir(parents=True)
    rows = ["Pixel Value, Class", "0, background", *(f"{i}, {part}" for i, part in capture.parts.items())]
    (folder / "train/_classes.csv").write_text("\n".join(rows) + "\n")
    for state, frame, labels in _labelled(capture):
        stem = Path(name(state, frame)).stem
        (folder / "train" / f"{stem}.jpg").write_bytes(frame.image.read_bytes())
        assert cv2.imwrite(str(folder / "train" / f"{stem}_mask.png"), labels)
    return folder


def write_labelme(capture: Capture, folder: Path, name: Naming = flat_name) -> Path:
    """As Labelme saves them beside images that lie elsewhere."""
    folder.mkdir(parents=True)
    names = {**capture.parts, 255: "__ignore__"}
    for state, frame, labels in _labelled(capture):
        shapes = [
            {"label": names[part], "points": np.reshape(polygon, (-1, 2)).tolist(), "shape_type": "polygon"}
            for part in sorted(set(np.unique(labels).tolist()) - {0})
            for polygon in outlines(labels == part)
        ]
        height, width = labels.shape
        size = {"imageData": None, "imageHeight": height, "imageWidth": width}
        content = {"shapes": shapes, "imagePath": f"..\\photos\\{name(state, frame)}", **size}
        (folder / f"{state.name}_{frame.image.stem}.json").write_text(json.dumps(content))
    return folder


def write_labelme_masks(capture: Capture, folder: Path, name: Naming = flat_name) -> Path:
    """As Labelme's labelme2voc makes them: pictures in other colours have their parts as objects."""
    for kind in ("SegmentationClassPNG", "SegmentationObjectPNG"):
        (folder / kind).mkdir(parents=True)
    (folder / "class_names.txt").write_text("\n".join(["_background_", *capture.parts.values()]))
    for state, frame, labels in _labelled(capture):
        file = Path(name(state, frame)).name
        assert cv2.imwrite(str(folder / "SegmentationClassPNG" / file), labels)
        assert cv2.imwrite(str(folder / "SegmentationObjectPNG" / file), np.where(labels == 1, 2, labels))
    return folder


_COLOURS = {0: (0, 0, 0), 1: (200, 60, 0), 2: (0, 0, 255), 255: (255, 255, 255)}


def write_colours(capture: Capture, folder: Path, line: str, name: Naming = flat_name) -> Path:
    """As CVAT writes them, and simulators; a `line` of the list of classes has a name and a colour."""
    (folder / "SegmentationClass").mkdir(parents=True)
    names = {0: "background", **capture.parts, 255: "void"}
    lines = [line.format(names[i], *_COLOURS[i]) for i in _COLOURS]
    if ":" in line:
        (folder / "labelmap.txt").write_text("\n".join(["# label:color_rgb:parts:actions", *lines]))
        (folder / "default.txt").write_text("0000\n0001\n")
    else:
        (folder / "_classes.csv").write_text("\n".join(["name,r,g,b", *lines]))
    colours = np.zeros((256, 3), np.uint8)
    colours[[*_COLOURS]] = [*_COLOURS.values()]
    for state, frame, labels in _labelled(capture):
        file = f"{Path(name(state, frame)).stem}.png"
        assert cv2.imwrite(str(folder / "SegmentationClass" / file), colours[labels][..., ::-1])
        if ":" in line:
            (folder / "SegmentationObject").mkdir(exist_ok=True)
            assert cv2.imwrite(str(folder / "SegmentationObject" / file), colours[labels] // 2)
    return folder


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
    "Labelme": write_labelme,
    "masks of Labelme": write_labelme_masks,
    "masks": lambda c, out: write_masks(c, out, flat_name),
    "masks of Roboflow": write_masks,
    "colours of CVAT": lambda c, out: write_colours(c, out, "{}:{},{},{}::"),
    "colours of simulators": lambda c, out: write_colours(c, out, "{}, {}, {}, {}"),
}
