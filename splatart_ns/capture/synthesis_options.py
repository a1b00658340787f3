"""How a capture is synthesized: what a command line shows, without what does the work."""

from __future__ import annotations

from dataclasses import dataclass, field

from splatart_ns.capture.light import Light
from splatart_ns.choices import Views

MOST_PIXELS = 16384
"""Along a side of an image that is made."""
MOST_STATES = 100_000
"""Configurations of a bundle that a dataset shows."""
OBJECTS = ("hinge", "drawer", "arm")
"""The names of the built-in objects."""


@dataclass(frozen=True)
class SynthesisOptions:
    """How a capture is rendered."""

    states: int = 2
    """How many configurations, when no joint values are given."""
    joint_values: tuple[str, ...] = ()
    """One "joint=value,joint=value" per state (radian, length); without it, values are drawn within the limits, and
    again where parts reach into each other."""
    freeze: tuple[str, ...] = ()
    """"joint=value" for joints that are held there in all states; their links become one part."""
    train_views: int = 40
    """Training views per state."""
    test_views: int = 8
    """Test views per state, and of the novel configuration."""
    views: Views = "sphere"
    """See the object from everywhere, or from above only."""
    resolution: int = 256
    """Pixels along each side of an image."""
    fov_degrees: float = 35.0
    """Field of view across an image."""
    labelled_fraction: float = 1.0
    """Share of the training views of a state that come with part labels, 0 to 1; test views always do."""
    depth: bool = False
    """Whether images come with their depth, as of a sensor without errors."""
    samples: int = 2
    """Rays per pixel along each side, against jagged edges."""
    light: Light = field(default_factory=Light)
    """What lights the object."""
    length_unit: str = "metre"
    """The URDF's unit of length, as the capture notes it."""
    seed: int = 0
    """The same seed writes the same bytes."""
