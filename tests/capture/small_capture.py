"""A capture of a few pixels: its frames and files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

SIZE = 16
STATES, FRAMES = 2, 8


def looking_at_origin(angle: float, distance: float = 4.0) -> np.ndarray:
    """An OpenGL camera-to-world pose on a ring, a little above the origin that it looks at."""
    centre = distance * np.array([np.cos(angle), np.sin(angle), 0.3])
    back = centre / np.linalg.norm(centre)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3] = np.stack([right, np.cross(back, right), back, centre], axis=1)
    return T


def pose(i: int) -> list[list[float]]:
    return looking_at_origin(2 * np.pi * i / FRAMES).tolist()


def write_images(folder: Path, name: str, labels: str) -> None:
    """A square object of two halves, part 1 left and part 2 right, in an RGBA image."""
    part = np.zeros((SIZE, SIZE), np.uint8)
    part[4:12, 4:8], part[4:12, 8:12] = 1, 2
    image = np.zeros((SIZE, SIZE, 4), np.uint8)
    image[..., 2], image[..., 1] = 100 * part, 50
    image[..., 3] = np.where(part > 0, 255, 0)
    for file, pixels in ((folder / name, image), (folder / labels, part)):
        file.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(file), pixels)


def intrinsics() -> dict[str, Any]:
    return {"w": SIZE, "h": SIZE, "fl_x": 20.0, "fl_y": 20.0, "cx": SIZE / 2, "cy": SIZE / 2, "camera_model": "OPENCV"}


def entry(i: int, prefix: str = "") -> dict[str, Any]:
    name = f"{prefix}images/{i:04d}.png"
    return {"file_path": name, "semantics_path": f"{prefix}labels/{i:04d}.png", "transform_matrix": pose(i)}


def write_state(folder: Path, **extra: Any) -> None:
    """A state folder with six training and two test frames; `extra` goes into its transforms.json."""
    entries = [entry(i) for i in range(FRAMES)]
    for e in entries:
        write_images(folder, e["file_path"], e["semantics_path"])
    names = [e["file_path"] for e in entries]
    splits = {"train_filenames": names[:6], "val_filenames": names[6:], "test_filenames": names[6:]}
    meta = {**intrinsics(), "semantic_classes": ["background", "base", "door"], **splits, "frames": entries, **extra}
    (folder / "transforms.json").write_text(json.dumps(meta))


def give_another_world(state: Path) -> np.ndarray:
    """Write the poses of a state's `transforms.json` in another world, and return the similarity [4, 4] to that."""
    world = np.array([[0.0, -2, 0, 1], [2, 0, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]])
    meta = json.loads((state / "transforms.json").read_text())
    for frame in meta["frames"]:
        T = world @ np.array(frame["transform_matrix"])
        T[:3, :3] /= 2
        frame["transform_matrix"] = T.tolist()
    (state / "transforms.json").write_text(json.dumps(meta))
    return world
