"""Meshes of the parts, which all formats share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import trimesh

from splatart_ns.bundle.bundle import Bundle, Part
from splatart_ns.bundle.collision import convex_pieces
from splatart_ns.bundle.occlusion import surroundings
from splatart_ns.bundle.surface import part_surface
from splatart_ns.bundle.vantage import cameras_around
from splatart_ns.errors import InputError


@dataclass(frozen=True)
class PartShape:
    """What a part looks like and what it collides with."""

    surface: trimesh.Trimesh | None
    """Coloured; None where the part's Gaussians make no surface."""
    pieces: tuple[trimesh.Trimesh, ...]
    """Convex and closed."""

    def moved(self, scale: float, origin: np.ndarray) -> PartShape:
        """Scaled, and then seen from `origin` [3]."""
        T = np.eye(4)
        T[:3, :3] *= scale
        T[:3, 3] = -origin
        surface = self.surface.copy().apply_transform(T) if self.surface is not None else None
        return replace(self, surface=surface, pieces=tuple(piece.copy().apply_transform(T) for piece in self.pieces))


def part_shapes(bundle: Bundle) -> dict[str, PartShape]:
    """The shape of each part, by name, in the canonical frame and the bundle's unit."""
    return {part.name: _shape(bundle, part) for part in bundle.parts}


def _shape(bundle: Bundle, part: Part) -> PartShape:
    try:
        surface = part_surface(part.splat, cameras_around(bundle, part), surroundings(bundle, part))
    except InputError:
        return PartShape(None, ())
    return PartShape(surface, tuple(convex_pieces(surface)))
