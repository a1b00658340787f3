"""What lies around a part: behind it no camera could see whether there is more of the part."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from splatart_ns.bundle.bundle import Bundle, Part
from splatart_ns.geometry.directions import golden_spiral
from splatart_ns.geometry.se3 import inverse, transform_points
from splatart_ns.splats.splat import Splat

_OPAQUE = 0.5
_DIRECTIONS = 60
_OUTERMOST = 0.005
"""Share of the Gaussians that a part's extent leaves out on either side."""
_WITHIN = 0.1
"""A part that another holds more of leaves room for itself in it, as a drawer does."""
_DEPTH = 0.01
"""How deep what counts as held lies, in diameters of what holds it: parts that touch overlap by rounding."""
_STATES = 4
"""States that are looked at, at most: an even choice of them."""


@dataclass(frozen=True)
class Extent:
    """A convex body about nearly all Gaussians of a part: how far they reach in many directions."""

    directions: Tensor
    """Unit vectors [D, 3] float64."""
    reach: Tensor
    """Length along each [D]."""

    @classmethod
    def of(cls, points: Tensor) -> Extent:
        """Of points [N, 3] float64, N > 0: a box along their principal axes, cut off in many other directions."""
        offsets = points - points.mean(0)
        axes = torch.linalg.eigh(offsets.mT @ offsets).eigenvectors.mT
        heights = 1 - (2 * torch.arange(_DIRECTIONS, dtype=points.dtype) + 1) / _DIRECTIONS
        directions = torch.cat([golden_spiral(heights), axes, -axes])
        along = (points @ directions.mT).sort(0).values
        return cls(directions, along[min(len(points) - 1, int((1 - _OUTERMOST) * len(points)))])

    def holds(self, points: Tensor, depth: float = 0.0) -> Tensor:
        """Which points [N, 3] lie inside, and at least so deep: bool [N]."""
        return (points.to(self.directions) @ self.directions.mT <= self.reach - depth).all(-1)

    @property
    def diameter(self) -> float:
        """The length of the box's diagonal; its axes are the last directions."""
        return float((self.reach[-6:-3] + self.reach[-3:]).norm())


def surroundings(bundle: Bundle, part: Part) -> list[Splat]:
    """The other parts' Gaussians at every state, or an even choice of states, in the canonical frame of a part.

    Without parts that reach into this one at some state, or it into them: they fill what may be a hollow. Empty where
    none is left.
    """
    own = _opaque(part)
    if len(own) == 0:
        return []
    beside = [q for q in bundle.parts if q is not part and len(_opaque(q)) and _stay_apart(part, q)]
    if not beside:
        return []
    states = range(len(bundle.states))[:: -(-len(bundle.states) // _STATES)]
    return [Splat.cat([q.splat.transformed(inverse(part.motion[s]) @ q.motion[s]) for q in beside]) for s in states]


def _opaque(part: Part) -> Tensor:
    splat = part.splat.detach()
    return splat.means[splat.opacities > _OPAQUE].double().cpu()


def _stay_apart(a: Part, b: Part) -> bool:
    points = [_opaque(part) for part in (a, b)]
    extents = [Extent.of(x) for x in points]
    for T in inverse(a.motion) @ b.motion:
        for x, held_by, motion in ((points[1], extents[0], T), (points[0], extents[1], inverse(T))):
            inside = held_by.holds(transform_points(motion, x), _DEPTH * held_by.diameter)
            if float(inside.double().mean()) > _WITHIN:
                return False
    return True
