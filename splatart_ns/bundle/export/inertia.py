"""Mass and inertia of a solid body."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh

from splatart_ns.bundle.export.robot import Inertia

MIN_MASS = 1e-3
"""Kilograms; simulators lose precision where masses differ by many orders."""
_GYRATION = 1e-3
"""Metres that a radius of gyration is longer, in square: thin and tiny bodies keep an inertia that is not zero."""


def solid_inertia(surface: trimesh.Trimesh | None, pieces: Sequence[trimesh.Trimesh], density: float) -> Inertia:
    """Mass properties of what `surface` encloses, in metres; of `pieces` where the surface is open or encloses nothing.

    `density` is in kg / m^3. The mass is at least `MIN_MASS`; without a volume the body is a small ball.
    """
    solids = [surface] if surface is not None and surface.is_volume else list(pieces)
    solids = [s for s in solids if np.isfinite(s.mass_properties.inertia).all() and s.volume > 0]
    volume = sum(s.volume for s in solids)
    if volume <= 0:
        centre = np.zeros(3) if surface is None or surface.is_empty else surface.bounds.mean(0)
        return Inertia(MIN_MASS, centre, MIN_MASS * _GYRATION**2 * np.eye(3))
    centre = sum(s.volume * s.center_mass for s in solids) / volume
    tensor = sum(_about(s, centre) for s in solids) / volume
    mass = max(density * volume, MIN_MASS)
    return Inertia(float(mass), centre, mass * (tensor + _GYRATION**2 * np.eye(3)))


def _about(solid: trimesh.Trimesh, centre: np.ndarray) -> np.ndarray:
    """The inertia [3, 3] of a solid of density 1 about a point, by Steiner's theorem."""
    d = solid.center_mass - centre
    tensor = solid.moment_inertia / solid.density
    return (tensor + tensor.T) / 2 + solid.volume * (d @ d * np.eye(3) - np.outer(d, d))


def between(inertia: Inertia) -> Inertia:
    """Of a link between two freedoms of a joint: a hundredth of the body that they move, about its own origin."""
    return Inertia(inertia.mass / 100, np.zeros(3), inertia.tensor / 100)
