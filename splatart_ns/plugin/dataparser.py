"""Captures as nerfstudio sees them: one state at a time, all states in one normalised world."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
import tyro
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox

from splatart_ns.capture.capture import Capture
from splatart_ns.capture.check import require_valid
from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.images import undistorted_camera
from splatart_ns.capture.worlds import focus_on_focus
from splatart_ns.choices import Worlds
from splatart_ns.errors import InputError


@dataclass
class SplatartDataParserConfig(DataParserConfig):
    """An articulated object at two or more states (docs/captures.md has the layouts that are read)."""

    _target: type = field(default_factory=lambda: SplatartDataParser)
    state: int = 0
    """Which state of the object, counted from 0 in the order of the state folders."""
    worlds: Worlds | None = None
    """How the states' worlds differ; what the capture says when not given, and else shared."""
    checked: tyro.conf.Suppress[bool] = False
    """Whether the capture was checked before, as `splatart fit` does for all its runs."""


@dataclass
class SplatartDataParser(DataParser):
    """Gives the frames of one state, undistorted, normalised by the similarity that all states share."""

    config: SplatartDataParserConfig

    def __init__(self, config: SplatartDataParserConfig):
        super().__init__(config)
        self._capture: Capture | None = None

    @property
    def capture(self) -> Capture:
        """The whole capture, states of separate worlds side by side; checked when it is first read, if never before.

        Raises:
            InputError: for a capture that cannot be used, or a state that it does not have.
        """
        if self._capture is None:
            capture = (load_capture if self.config.checked else require_valid)(self.config.data)
            if not 0 <= self.config.state < len(capture.states):
                raise InputError(
                    f"{self.config.data} has no state {self.config.state}; "
                    f"choose --state between 0 and {len(capture.states) - 1}."
                )
            self._capture = focus_on_focus(capture, self.config.worlds or capture.worlds)
        return self._capture

    def _generate_dataparser_outputs(self, split: str = "train", **_) -> DataparserOutputs:
        capture = self.capture
        state = capture.states[self.config.state]
        frames = state.split(split)
        if not frames and split != "train":  # nerfstudio needs something to evaluate on
            frames = state.split("test") or state.split("val") or state.split("train")
        cameras = [undistorted_camera(f.camera) for f in frames]
        T = capture.normalization.camera_to_normal(np.stack([f.T_world_camera for f in frames]))

        def column(name: str) -> torch.Tensor:
            return torch.tensor([getattr(c, name) for c in cameras])

        normalization = capture.normalization
        return DataparserOutputs(
            image_filenames=[f.image for f in frames],
            cameras=Cameras(
                camera_to_worlds=torch.from_numpy(T[:, :3]).float(),
                fx=column("fx").float(),
                fy=column("fy").float(),
                cx=column("cx").float(),
                cy=column("cy").float(),
                width=column("width"),
                height=column("height"),
                camera_type=CameraType.PERSPECTIVE,
                metadata={},  # `ns-export cameras` wants to add to it
            ),
            scene_box=SceneBox(aabb=torch.tensor([[-1.0] * 3, [1.0] * 3])),
            metadata={
                "frames": frames,
                "normalization": normalization,
                "state": self.config.state,
                "part_names": ["background", *capture.parts.values()],
                "length_unit": capture.length_unit,
            },
            dataparser_transform=torch.from_numpy(
                np.concatenate([np.eye(3), -normalization.centre[:, None]], axis=1)
            ).float(),
            dataparser_scale=normalization.scale,
        )
