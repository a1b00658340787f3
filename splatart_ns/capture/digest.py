"""What a capture holds, as a short text: a fit of the same contents need not be run again."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence

from splatart_ns.capture.capture import Capture, Frame, State


def capture_digest(capture: Capture, states: Sequence[State] | None = None) -> str:
    """SHA-256 of all that a fit reads of a capture, or of some of its states alone; not of where the files lie."""
    digest = hashlib.sha256(repr((capture.parts, capture.length_unit, capture.worlds)).encode())
    for state in capture.states if states is None else states:
        digest.update(state.name.encode() + (state.points.read_bytes() if state.points else b""))
        for frame in state.frames:
            digest.update(repr((frame.name, frame.camera, frame.T_world_camera.tolist(), frame.split)).encode())
            digest.update(repr(frame.depth_unit).encode() if frame.depth else b"")
            for content in _contents(frame):
                digest.update(content)
    return digest.hexdigest()


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
