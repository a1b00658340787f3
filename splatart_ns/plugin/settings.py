"""What decides the result of a fit, besides the capture."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from splatart_ns.capture.capture import Capture, Problem
from splatart_ns.capture.check import require_valid
from splatart_ns.capture.worlds import require_one_place
from splatart_ns.choices import Quality, Rasterizer, RefineCameras, Worlds, require_seed
from splatart_ns.errors import InputError
from splatart_ns.stages.joint_constraint import parse_constraints


@dataclass(frozen=True)
class Settings:
    """See `splatart fit --help`."""

    quality: Quality
    root: str | None
    seed: int
    rasterizer: Rasterizer = "auto"
    joints: list[str] = field(default_factory=list)
    worlds: Worlds | None = None
    refine_cameras: RefineCameras = "auto"
    downscale: int | None = None

    def of(self, capture: Capture) -> Settings:
        """With what the capture says where nothing else was asked for."""
        downscale = self.downscale or image_downscale(capture, self.quality)
        return replace(self, worlds=self.worlds or capture.worlds, downscale=downscale)


@dataclass(frozen=True)
class Effort:
    """How much work a quality stands for."""

    gaussians: int
    """Gaussians that each state starts from."""
    steps: int
    """Steps on geometry and colour of each state."""
    part_steps: int
    """Steps on the parts of each state, which start from the labels' votes."""
    merge_steps: int
    """Steps on the merged Gaussians of all states."""
    longest: int = 800
    """Most pixels along the longer side with which images are looked at."""
    downscale: int = 1
    """How many times smaller than that they are looked at, where `SMALLEST` are left."""


EFFORTS: dict[Quality, Effort] = {
    "draft": Effort(gaussians=4000, steps=450, part_steps=30, merge_steps=100, downscale=2),
    "standard": Effort(gaussians=8000, steps=1000, part_steps=100, merge_steps=400),
    "high": Effort(gaussians=16000, steps=3000, part_steps=100, merge_steps=1500, longest=1600),
}
SMALLEST = 128
"""Along the shorter side of images that are made smaller."""
LEAST_LEFT = 16
"""Along the same, of images that the user wants smaller."""


def require_fittable(capture_path: Path, settings: Settings, warn: Callable[[Problem], None] | None = None) -> Capture:
    """Load and check a capture, and the settings that are about it; `warn` as in `require_valid`.

    Raises:
        InputError: for a capture, a root, a joint or a seed that cannot be used.
    """
    capture, root = require_valid(capture_path, warn, settings.worlds), settings.root
    if settings.worlds is None:
        require_one_place(capture)
    if root is not None and root not in capture.parts.values():
        raise InputError(
            f"{capture_path} has no part '{root}'; choose --root from {', '.join(capture.parts.values())}."
        )
    number = next((p for p, name in capture.parts.items() if name == root), None)
    parse_constraints(settings.joints, capture.parts, number)
    require_seed(settings.seed)
    most = max(1, min(min(size) for size in _image_sizes(capture)) // LEAST_LEFT)
    if settings.downscale is not None and not 1 <= settings.downscale <= most:
        raise InputError(f"--downscale is {settings.downscale}; give 1 to {most}, or leave it out.")
    return capture


def image_downscale(capture: Capture, quality: Quality) -> int:
    """How many times smaller than they are a quality looks at the images of all states."""
    sizes, effort = _image_sizes(capture), EFFORTS[quality]
    factor = effort.downscale * math.ceil(max(max(size) for size in sizes) / effort.longest)
    return max(1, min(factor, min(min(size) for size in sizes) // SMALLEST))


def _image_sizes(capture: Capture) -> set[tuple[int, int]]:
    """Widths and heights in pixels."""
    return {(frame.camera.width, frame.camera.height) for state in capture.states for frame in state.frames}
