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

    def wait_for(self, wanted: Callable[[Message], bool], since: int = 0) -> Message:
        """The first message from number `since` on that is wanted."""
        while True:
            for message in self.messages[since:]:
                if wanted(message):
                    return message
            since = len(self.messages)
            assert time.monotonic() < self.deadline, "the viewer did not send it"
            try:
                packet = msgspec.msgpack.decode(self.socket.recv(timeout=1))
            except TimeoutError:
                continue
            self.messages.extend(packet if isinstance(packet, list) else [packet])

    def slider(self, label: str) -> Message:
        return self.wait_for(lambda m: m["type"] == "GuiAddSliderMessage" and m["label"] == label)

    def sharp_frame(self, since: int = 0) -> np.ndarray:
        """The first image [512, 512, 3] at the viewer's full resolution."""
        frames: list[np.ndarray] = []

        def is_sharp(message: Message) -> bool:
            if message["type"] != "BackgroundImageMessage":
                return False
            frames.append(cv2.imdecode(np.frombuffer(message["rgb_bytes"], np.uint8), cv2.IMREAD_COLOR))
            return frames[-1].shape[0] == 512

        self.wait_for(is_sharp, since)
        return frames[-1]

    def move(self, slider: Message, value: float) -> None:
        self._send({"type": "GuiUpdateMessage", "id": slider["id"], "updates": {"value": value}})

    def close(self) -> None:
        self.socket.close()
