"""What lights a synthesized scene."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Light:
    """A sun fixed in the world, and a sky that lights from all around."""

    direction: tuple[float, float, float] = (0.3, -0.5, 0.8)
    """From the object towards the sun, in the world; z is up."""
    ambient: float = 0.65
    """The share of the sky's light, 0 to 1; the rest is the sun's."""
    shadows: bool = True
    """Cast hard shadows."""
