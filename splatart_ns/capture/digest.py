"""What a capture holds, as a short text: a fit of the same contents need not be run again."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

from splatart_ns.capture.capture import Capture, State


def capture_digest(capture: Capture, states: Sequence[State] | None = None) -> str:
    """SHA-256 of all that a fit reads of a capture, or of some of its states alone; not of where the files lie."""
    digest = hashlib.sha256(repr((capture.parts, capture.length_unit, capture.worlds)).encode())
    for state in capture.states if states is None else states:
        digest.update(state.name.encode() + (state.points.read_bytes() if state.points else b""))
        for frame in state.frames:
            digest.update(repr((frame.name, frame.camera, frame.T_world_camera.tolist(), frame.split)).encode())
            digest.update(repr(frame.depth_unit).encode() if frame.depth else b"")
            for file in (frame.image, frame.labels, frame.object_mask, frame.mask, frame.depth):
                digest.update(file.read_bytes() if file else b"-")
    return digest.hexdigest()
