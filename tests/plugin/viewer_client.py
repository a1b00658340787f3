"""A browser's part of viser's protocol, as far as the tests need it."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from typing import Any

import cv2
import msgspec
import numpy as np
from websockets.sync.client import connect

Message = dict[str, Any]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class ViewerClient:
    """One connection to a viewer, with all messages that came."""

    def __init__(self, port: int, alive: Callable[[], bool], seconds: float = 120):
        self.deadline = time.monotonic() + seconds
        self.messages: list[Message] = []
        while True:
            try:
                self.socket = connect(f"ws://127.0.0.1:{port}", max_size=None, proxy=None)
                break
            except OSError:
                assert alive() and time.monotonic() < self.deadline, "the viewer does not answer"
                time.sleep(0.2)
        camera = {"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (3.0, 3.0, 3.0), "fov": 1.3, "aspect": 1.0}
        orbit = {"look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0)}
        self._send({"type": "ViewerCameraMessage", **camera, **orbit})

    def _send(self, message: Message) -> None:
        self.socket.send(msgspec.msgpack.encode(message))

    def _receive(self) -> list[Message]:
        """What comes within a second."""
        assert time.monotonic() < self.deadline, "the viewer did not send what the test waits for"
        try:
            packet = msgspec.msgpack.decode(self.socket.recv(timeout=1))
        except TimeoutError:
            return []
        new = packet if isinstance(packet, list) else [packet]
        self.messages.extend(new)
        return new

    def wait_for(self, wanted: Callable[[Message], bool]) -> Message:
        """The first message of all that is wanted."""
        seen = 0
        while True:
            for message in self.messages[seen:]:
                if wanted(message):
                    return message
            seen = len(self.messages)
            self._receive()

    def slider(self, label: str) -> Message:
        return self.wait_for(lambda m: m["type"] == "GuiAddSliderMessage" and m["label"] == label)

    def settled_image(self) -> np.ndarray:
        """The image [512, 512, 3] at full resolution after which no other comes for a second."""
        frame = None
        while True:
            new = [m for m in self._receive() if m["type"] == "BackgroundImageMessage"]
            if new:
                frame = cv2.imdecode(np.frombuffer(new[-1]["rgb_bytes"], np.uint8), cv2.IMREAD_COLOR)
            elif frame is not None and frame.shape[0] == 512:
                return frame

    def move(self, slider: Message, value: float) -> None:
        self._send({"type": "GuiUpdateMessage", "id": slider["id"], "updates": {"value": value}})

    def close(self) -> None:
        self.socket.close()
