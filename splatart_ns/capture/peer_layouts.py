"""Captures as ArtGS and DigitalTwinArt (DTA) keep them: two states, no part labels."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

from splatart_ns.capture.capture import CaptureError, Frame, Report, State
from splatart_ns.capture.values import (
    check_inside,
    inner_path,
    parse_camera,
    parse_matrix,
    parse_number,
    parse_pose,
    read_inner_json,
    read_text,
    read_yaml,
    relative_path,
    show,
)

_STATES = ("start", "end")


def peer_reader(path: Path) -> Callable[[Path, Report], list[State]] | None:
    """What reads a folder: it looks like ArtGS's or DTA's, or else None."""
    if all(os.path.isfile(path / f"transforms_train_{state}.json") for state in _STATES):
        return _read_artgs
    if os.path.isfile(path / "init_keyframes.yml") and os.path.isfile(path / "cam_K.txt"):
        return _read_dta
    return None


def _read_artgs(path: Path, report: Report) -> list[State]:
    """`transforms_{train,test}_{start,end}.json` in the form of NeRF's synthetic scenes; the image of a `file_path`
    a/b/0000 is a/rgba/0000.png, its depth in thousandths a/depth/0000.png, where these are there."""
    states = []
    for name in _STATES:
        frames: list[Frame] = []
        for split in ("train", "test"):
            file = path / f"transforms_{split}_{name}.json"
            if not os.path.isfile(file):
                continue
            meta = read_inner_json(file, path)
            entries = meta.pop("frames", None)
            if not isinstance(entries, list):
                raise CaptureError(file, f'"frames" is {show(entries)}', "list frames with file_path, transform_matrix")
            for i, entry in enumerate(entries):
                try:
                    frames.append(_artgs_frame(file, path, split, meta, i, entry))
                except CaptureError as error:
                    report(error.problem)
        states.append(State(name, tuple(sorted(frames, key=lambda frame: (frame.split == "test", frame.name)))))
    return states


def _artgs_frame(file: Path, root: Path, split: str, meta: dict[str, Any], i: int, entry: Any) -> Frame:
    if not isinstance(entry, dict):
        raise CaptureError(file, f"frame {i} is {show(entry)}", "write it as an object with file_path")
    name = relative_path(file, f"file_path of frame {i}", entry.get("file_path"))
    given = PurePosixPath(name)
    beside = {kind: given.parent.parent / kind / f"{given.stem}.png" for kind in ("rgba", "depth")}
    found = {kind: inner_path(file, root, f"file_path of frame {i}", str(path)) for kind, path in beside.items()}
    image = found["rgba"]
    if not os.path.isfile(image):
        image = inner_path(file, root, f"file_path of frame {i}", name if given.suffix else f"{name}.png")
    owner = f"frame {name!r}"
    return Frame(
        name=image.relative_to(root).as_posix(),
        image=image,
        camera=parse_camera(file, owner, {**meta, **entry}, image),
        T_world_camera=parse_pose(file, owner, entry.get("transform_matrix")),
        split=split,
        depth=found["depth"] if os.path.isfile(found["depth"]) else None,
    )


def _read_dta(path: Path, report: Report) -> list[State]:
    """`init_keyframes.yml`: `frame_ID: {cam_in_ob: 16 numbers of an OpenGL camera-to-world pose, time: 0 or 1}`;
    `cam_K.txt`; `color_segmented/ID.png`, `mask/ID.png` and, in thousandths, `depth_filtered/ID.png`. Every 8th frame
    of a state is for tests."""
    file = path / "init_keyframes.yml"
    keyframes = read_yaml(check_inside(path, file))
    if not isinstance(keyframes, dict):
        raise CaptureError(file, "the file holds no keyframes", "write frame_ID: {cam_in_ob: [...], time: 0}")
    text = read_text(check_inside(path, path / "cam_K.txt"))
    try:
        rows = [[float(x) for x in line.split()] for line in text.splitlines() if line.strip()]
    except ValueError:
        rows = []
    K = parse_matrix(path / "cam_K.txt", "the intrinsic matrix", rows, ((3, 3),))
    intrinsics = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    frames: dict[str, list[Frame]] = {name: [] for name in _STATES}
    for key in sorted(map(str, keyframes)):
        try:
            state, frame = _dta_frame(file, path, key, keyframes.get(key), {k: float(v) for k, v in intrinsics.items()})
        except CaptureError as error:
            report(error.problem)
            continue
        split = "test" if len(frames[state]) % 8 == 7 else "train"
        frames[state].append(replace(frame, split=split))
    return [State(name, tuple(some)) for name, some in frames.items()]


def _dta_frame(file: Path, root: Path, key: str, value: Any, intrinsics: dict[str, float]) -> tuple[str, Frame]:
    numbers = value.get("cam_in_ob") if isinstance(value, dict) else None
    if not isinstance(numbers, list) or len(numbers) != 16:
        raise CaptureError(file, f"cam_in_ob of {key} is {show(numbers)}", "write a 4x4 pose, row by row")
    time = parse_number(file, f"time of {key}", value.get("time"))
    if time not in (0, 1):
        raise CaptureError(file, f"time of {key} is {time:g}", "write 0 for the start, 1 for the end")
    stem = key.removeprefix("frame_")
    paths = {
        kind: inner_path(file, root, f"the frame {key}", f"{kind}/{stem}.png")
        for kind in ("color_segmented", "mask", "depth_filtered")
    }
    image = paths["color_segmented"]
    return _STATES[int(time)], Frame(
        name=f"color_segmented/{stem}.png",
        image=image,
        camera=parse_camera(file, key, intrinsics, image),
        T_world_camera=parse_pose(file, key, [numbers[i : i + 4] for i in range(0, 16, 4)]),
        split="train",
        object_mask=paths["mask"] if os.path.isfile(paths["mask"]) else None,
        depth=paths["depth_filtered"] if os.path.isfile(paths["depth_filtered"]) else None,
    )
