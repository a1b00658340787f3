"""A capture of a few pixels, in any of the three layouts."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from small_capture import FRAMES, STATES, entry, intrinsics, pose, write_images, write_state


@pytest.fixture
def capture_folder(tmp_path: Path) -> Path:
    """A sound capture of two state folders."""
    path = tmp_path / "capture"
    for k in range(STATES):
        write_state(path / f"state_{k:02d}")
    return path


@pytest.fixture
def single_file_folder(tmp_path: Path) -> Path:
    """A sound capture of one transforms.json with states, and no lists of splits."""
    path = tmp_path / "single"
    frames = [{**entry(i, f"s{k}/"), "state": k} for k in range(STATES) for i in range(FRAMES)]
    for e in frames:
        write_images(path, e["file_path"], e["semantics_path"])
    (path / "transforms.json").write_text(json.dumps({**intrinsics(), "frames": frames}))
    return path


@pytest.fixture
def paris_folder(tmp_path: Path) -> Path:
    """A sound capture in the layout of PARIS."""
    path = tmp_path / "paris"
    K = [[20.0, 0.0, 7.0], [0.0, 22.0, 9.0], [0.0, 0.0, 1.0]]
    for state in ("start", "end"):
        for split, numbers in (("train", range(5)), ("val", range(5, 6)), ("test", range(6, 8))):
            for i in numbers:
                write_images(path / state, f"{split}/{i:04d}.png", f"{split}_semantics/{i:04d}.png")
            cameras = {"K": K, **{f"{i:04d}": pose(i) for i in numbers}}
            (path / state / f"camera_{split}.json").write_text(json.dumps(cameras))
    return path


@pytest.fixture
def edit() -> Callable[[Path, Callable[[dict[str, Any]], Any]], None]:
    """Changes a JSON file in place by a function of its value."""

    def apply(file: Path, change: Callable[[dict[str, Any]], Any]) -> None:
        meta = json.loads(file.read_text())
        change(meta)
        file.write_text(json.dumps(meta))

    return apply
