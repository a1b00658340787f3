"""What is wrong with a capture, and how to mend it."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from splatart_ns.capture.capture import UNLABELLED, Capture, CaptureError, Frame, Normalization, Problem, State
from splatart_ns.capture.formats import read_capture
from splatart_ns.capture.images import read_depth_for, read_image, read_labels, read_mask, read_silhouette, read_sized
from splatart_ns.capture.label_steps import blurred_share, count_steps
from splatart_ns.capture.view import load_points
from splatart_ns.capture.worlds import OTHER_WORLDS_MEND, looks_elsewhere
from splatart_ns.choices import Worlds
from splatart_ns.errors import InputError
from splatart_ns.machine import num_cores


def require_valid(
    path: Path | str, warn: Callable[[Problem], None] | None = None, worlds: Worlds | None = None
) -> Capture:
    """Load and check a capture. Raises `InputError` with the first error, and how many there are.

    `warn` is called with each problem that is none; `worlds` as in `check_capture`.
    """
    capture, problems = check_capture(Path(path), worlds)
    errors = [p for p in problems if p.severity == "error"]
    if errors or capture is None:
        more = f" (and {len(errors) - 1} more, see `splatart check {path}`)" if len(errors) > 1 else ""
        raise InputError(f"{errors[0]}{more}.")
    for problem in problems if warn is not None else ():
        warn(problem)
    return capture


def check_capture(path: Path, worlds: Worlds | None = None) -> tuple[Capture | None, list[Problem]]:
    """What can be read of a capture, None for nothing, and all that is wrong with it: its structure first, then its
    files frame by frame, then its views and labels.

    Every file is decoded once. Never raises for what is in the capture. `worlds`: how the states' worlds are said to
    differ, in place of what the capture says.
    """
    problems: list[Problem] = []
    try:
        capture = read_capture(path, problems.append)
    except CaptureError as error:
        return None, [*problems, error.problem]
    frames = [frame for state in capture.states for frame in state.frames]
    with ThreadPoolExecutor(num_cores()) as pool:
        contents = list(pool.map(lambda frame: _look(frame, capture.parts), frames))
    for content in contents:
        problems.extend(content.problems)
    by_frame = dict(zip(map(id, frames), contents, strict=True))
    problems.extend(_check_states(capture))
    problems.extend(_check_duplicates(capture))
    said = replace(capture, worlds=worlds or capture.worlds)
    for state in capture.states:
        problems.extend(_check_cameras(capture, state))
        if (strange := looks_elsewhere(said, state)) is not None:
            problems.append(Problem("warning", capture.path / state.name, strange, OTHER_WORLDS_MEND))
        problems.extend(_check_silhouettes(capture, state, [by_frame[id(f)] for f in state.frames]))
        problems.extend(_check_steps(capture, state, [by_frame[id(f)] for f in state.frames]))
        problems.extend(_check_background(capture, state, [by_frame[id(f)] for f in state.frames]))
        if (train := state.split("train")) and all(by_frame[id(f)].masked_out for f in train):
            found, mend = "the masks leave no pixel of any training frame", "white must be what counts: invert them"
            problems.append(Problem("error", capture.path / state.name, found, mend))
        problems.extend(_check_points(state))
    pixels = [sum((by_frame[id(f)].pixels for f in s.split("train")), np.zeros(256, int)) for s in capture.states]
    gaps = _gaps(capture, contents)
    if gaps:
        problems.append(_gap_problem(capture, np.array(pixels), gaps))
    named = replace(capture, parts={i: name for i, name in capture.parts.items() if i not in gaps})
    problems.extend(_check_labels(named, np.array(pixels)))
    return capture, list(dict.fromkeys(problems))


ONE_SPOT_MEND = "give views from around the object, with poses relative to the object's fixed world"
_INVERTED = 0.9
"""Silhouettes are inverted if they leave out more than this share of all labelled pixels."""
_BLURRED, _ENOUGH_STEPS = 0.3, 100
"""Labels are interpolated if more than this share of a state's steps, of which there are enough, leads over ids in
between (see `blurred_share`). In 72 captures it was at most 0.17 (tiny parts; 0.07 in all others), 0.22 halved by the
nearest neighbour; at least 0.94 blurred by a pixel, 0.99 halved and enlarged, 0.52 enlarged by 1.5, 0.35 shrunk to 0.7,
0.40 halved by means.
"""
_NO_PIXELS = np.zeros(256, int)


@dataclass
class _Content:
    """What a frame's files hold."""

    problems: list[Problem] = field(default_factory=list)
    pixels: np.ndarray = field(default_factory=lambda: _NO_PIXELS)
    """Number of pixels of each label [256]."""
    steps: Counter[tuple[int, int, bool]] = field(default_factory=Counter)
    """Of the labels, by `count_steps`."""
    silhouette: float | None = None
    """The part of the image inside the silhouette, if the frame has one."""
    left_out: int = 0
    """Number of pixels that are labelled as a part, but lie outside the silhouette."""
    masked_out: bool = False
    """Whether the mask leaves no pixel to the loss."""


def _look(frame: Frame, parts: dict[int, str]) -> _Content:
    content = _Content()

    def read(path: Path | None, reader: Callable[[Path], np.ndarray]) -> np.ndarray | None:
        try:
            return None if path is None else read_sized(path, reader, frame.camera)
        except CaptureError as error:
            content.problems.append(error.problem)
            return None

    image = read(frame.image, read_image)
    silhouette = read(frame.object_mask, read_silhouette)
    if frame.object_mask is None and image is not None and image.shape[2] == 4 and not (image[..., 3] == 255).all():
        silhouette = image[..., 3]
    if silhouette is not None:
        content.silhouette = float((silhouette > 127).mean())
    mask = read(frame.mask, read_mask)
    if mask is not None and not mask.any():
        content.masked_out = True
        message, mend = "the mask leaves no pixel to the loss", "white must be what counts; or take the frame out"
        content.problems.append(Problem("warning", frame.mask, message, mend))
    if frame.depth is not None and image is not None:  # which has the camera's size, and so a bearable one
        try:
            read_depth_for(frame.depth, frame.camera)
        except CaptureError as error:
            content.problems.append(error.problem)
    labels = read(frame.labels, read_labels)
    if labels is not None:
        content.pixels = np.bincount(labels.ravel(), minlength=256)
        content.steps = count_steps(labels)
        if silhouette is not None:
            content.left_out = int(((labels > 0) & (labels != UNLABELLED) & (silhouette <= 127)).sum())
        unknown = [i for i in np.flatnonzero(content.pixels[:UNLABELLED]) if i > 0 and i not in parts]
        if unknown:
            message = f"the label {unknown[-1]} is none of the declared parts 1 to {max(parts, default=0)}"
            mend = "add its name to semantic_classes, or correct the labels"
            content.problems.append(Problem("error", frame.labels, message, mend))
    return content


def _check_states(capture: Capture) -> Iterator[Problem]:
    if len(capture.states) < 2:
        found = f"there is only the state {capture.states[0].name}"
        yield Problem("error", capture.path, found, "add the object at a second configuration: one shows no motion")
    if not any(state.split("test") or state.split("val") for state in capture.states):
        yield Problem(
            "warning", capture.path, "no view is held out for tests", "list some in test_filenames to measure quality"
        )


def _check_duplicates(capture: Capture) -> Iterator[Problem]:
    seen: dict[str, str] = {}
    for state in capture.states:
        for frame in state.frames:
            path = os.path.normpath(frame.image)
            if path in seen:
                found = f"the image belongs to two frames, in {seen[path]} and in {state.name}"
                yield Problem("error", frame.image, found, "keep one of them")
            seen[path] = state.name


def _check_cameras(capture: Capture, state: State) -> Iterator[Problem]:
    place, frames = capture.path / state.name, state.split("train")
    if not frames:
        yield Problem("error", place, "the state has no training view", "list some frames in train_filenames")
        return
    centres = np.stack([f.T_world_camera[:3, 3] for f in frames])
    if np.ptp(centres, axis=0).max() * capture.normalization.scale < 1e-3:
        found = "there is one training view" if len(frames) == 1 else "all training cameras stand on one spot"
        yield Problem("error", place, found, ONE_SPOT_MEND)


def _check_silhouettes(capture: Capture, state: State, contents: list[_Content]) -> Iterator[Problem]:
    shares = [content.silhouette for content in contents]
    known = [share for share in shares if share is not None]
    if known and max(known) == 0:
        found = "all silhouettes are empty"
        yield Problem("error", capture.path / state.name, found, "make the object white in object_mask_path, or opaque")
        return
    for frame, share in zip(state.frames, shares, strict=True):
        if share == 0:
            found, file = "the silhouette is empty", frame.object_mask or frame.image
            yield Problem("warning", file, found, "leave the frame out if the object cannot be seen")
    if known and min(known) == 1:
        found = "all silhouettes fill their images, so the background counts as the object"
        mend = "give silhouettes by object_mask_path, or images without alpha"
        yield Problem("warning", capture.path / state.name, found, mend)
    labelled = sum(int(c.pixels[1:UNLABELLED].sum()) for c in contents if c.silhouette)
    left_out = sum(content.left_out for content in contents if content.silhouette)
    if left_out > _INVERTED * labelled:
        found = f"the silhouettes leave out {left_out / labelled:.0%} of what is labelled as parts"
        mend = "invert them: the object must be opaque, or white in object_mask_path, and what surrounds it not"
        yield Problem("error", capture.path / state.name, found, mend)


def _check_steps(capture: Capture, state: State, contents: list[_Content]) -> Iterator[Problem]:
    """A warning, as a frame around a window may be a thin rim between other ids, too."""
    steps = sum((content.steps for content in contents), Counter())
    share = blurred_share(steps)
    if steps.total() >= _ENOUGH_STEPS and share > _BLURRED:
        found = f"the labels seem to be resized or anti-aliased: {share:.0%} of the outlines between ids two"
        found += " or more apart are rims of ids in between"
        mend = "export them without anti-aliasing, and resize them by the nearest neighbour"
        yield Problem("warning", capture.path / state.name, found, mend)


def _check_background(capture: Capture, state: State, contents: list[_Content]) -> Iterator[Problem]:
    """Without silhouettes, labels alone tell the object from what surrounds it."""
    train = [(f, content) for f, content in zip(state.frames, contents, strict=True) if f.split == "train"]
    pixels = sum((content.pixels for _, content in train), _NO_PIXELS)
    outlined = any(frame.object_mask is not None or content.silhouette is not None for frame, content in train)
    if pixels[1:UNLABELLED].any() and not pixels[0] and not outlined:
        found = "no labelled frame tells where the object ends"
        mend = f"label what surrounds it as 0 ({UNLABELLED} says that nobody knows), or give object_mask_path"
        yield Problem("error", capture.path / state.name, found, mend)


def _check_points(state: State) -> Iterator[Problem]:
    if state.points is not None:
        try:
            load_points(state.points, Normalization(np.zeros(3), 1.0))
        except CaptureError as error:
            yield error.problem


def _gaps(capture: Capture, contents: Sequence[_Content]) -> list[int]:
    """The ids that no label file holds, below one that is there, where no `semantic_classes` give parts names."""
    if any(name != f"part_{i}" for i, name in capture.parts.items()):
        return []
    held = sum((content.pixels for content in contents), _NO_PIXELS)
    return [i for i in capture.parts if not held[i] and held[i:UNLABELLED].any()]


def _gap_problem(capture: Capture, pixels: np.ndarray, gaps: Sequence[int]) -> Problem:
    """An error unless all training frames are labelled, and two parts in two states, which are worth a fit that the
    gaps do not more than double."""
    whole = all(frame.labels is not None for state in capture.states for frame in state.split("train"))
    compared = int(((pixels[:, 1:UNLABELLED] > 0).sum(axis=0) > 1).sum())
    missing = ", ".join(map(str, gaps[:3])) + (", ..." if len(gaps) > 3 else "")
    found = f"the labels go up to {max(capture.parts)}, but none is {missing}"
    mend = "number the parts 1, 2, ... without gaps, or correct stray pixels of large numbers"
    few = 2 * len(gaps) <= len(capture.parts)
    return Problem("warning" if whole and few and compared > 1 else "error", capture.path, found, mend)


def _check_labels(capture: Capture, pixels: np.ndarray) -> Iterator[Problem]:
    """Problems with the labels of the training frames; `pixels` [states, 256] counts each label's."""
    seen = {i: np.flatnonzero(pixels[:, i]) for i in capture.parts}
    labelled = (pixels[:, 1:UNLABELLED] > 0).any(axis=1)
    if not labelled.any():
        mend = "give some frames of each state a semantics_path: a PNG of part ids"
        yield Problem("error", capture.path, "no training frame has part labels", mend)
        return
    for state, is_labelled in zip(capture.states, labelled, strict=True):
        if not is_labelled:
            found = "no training frame of this state has part labels"
            yield Problem("error", capture.path / state.name, found, "label a few of its frames")
    compared = sum(len(states) > 1 for states in seen.values())
    if len(capture.parts) == 1:
        yield Problem("warning", capture.path, "there is only one part", "label at least two parts to find a joint")
    for i, name in capture.parts.items():
        part = f"part {i} ({name})"
        missing = [s for k, s in enumerate(capture.states) if labelled[k] and k not in seen[i]]
        if not missing:
            continue
        # Where every frame is labelled there is no mend, and the motions of several others are worth a fit.
        hidden = all(frame.labels is not None for state in missing for frame in state.split("train"))
        severity = "warning" if len(seen[i]) > 1 or hidden and compared > 1 else "error"
        if len(seen[i]) == 0:
            found = f"{part} is never labelled"
            mend = "take it out of semantic_classes, or label it in some training frames of every state"
        else:
            found = f"{part} is not labelled in {missing[0].name}, so its motion cannot be known there"
            mend = "label it in some training frames of that state"
        yield Problem(severity, capture.path, found, f"{mend}, if one shows it" if hidden else mend)
