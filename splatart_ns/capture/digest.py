"""What a capture holds, as a short text: a fit of the same contents need not be run again."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from splatart_ns.capture.capture import Capture, Frame, State

IDENTITY = ("capture", "capture_sha256")
"""Where a capture lies, and what it holds: it may be moved, or changed, and is another one if both differ."""


def capture_digest(capture: Capture, states: Sequence[State] | None = None) -> str:
    """SHA-256 of all that a fit reads of a capture, or of some of its states alone; not of where the files lie."""
    digest = hashlib.sha256(repr((capture.parts, capture.length_unit, capture.worlds)).encode())
    for state in capture.states if states is None else states:
        digest.update(os.fsencode(state.name) + (state.points.read_bytes() if state.points else b""))
        for frame in state.frames:
            digest.update(repr((frame.name, frame.camera, frame.T_world_camera.tolist(), frame.split)).encode())
            digest.update(repr(frame.depth_unit).encode() if frame.depth else b"")
            for content in _contents(frame):
                digest.update(content)
    return digest.hexdigest()


def capture_identity(capture: Capture) -> dict[str, str]:
    """What a fit's report tells of its capture: the values of `IDENTITY`."""
    return dict(zip(IDENTITY, (str(capture.path.resolve()), capture_digest(capture)), strict=True))


def is_another(told: Mapping[str, Any], here: Mapping[str, Any]) -> bool:
    """Whether two reports are of different captures. One that does not tell its capture counts as of the same."""
    return all(isinstance(had := told.get(key), str) and had != here[key] for key in IDENTITY)


def training_digest(capture: Capture, state: int) -> bytes:
    """SHA-256 of the training frames of a state: their files, and their cameras in the normalised world.

    What was computed counts to 6 digits: machines may round the rest otherwise.
    """
    digest, normalization = hashlib.sha256(), capture.normalization
    for frame in capture.states[state].split("train"):
        pose = normalization.camera_to_normal(frame.T_world_camera).round(6) + 0.0  # no -0
        depth_unit = f"{normalization.scale * frame.depth_unit:.6g}"
        digest.update(repr((frame.name, frame.camera, pose.tolist(), depth_unit)).encode())
        for content in _contents(frame):
            digest.update(content)
    return digest.digest()


def _contents(frame: Frame) -> Iterator[bytes]:
    """Of all files of a frame."""
    for file in (frame.image, frame.labels, frame.object_mask, frame.mask, frame.depth):
        yield file.read_bytes() if file else b"-"
