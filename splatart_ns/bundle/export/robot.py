"""A plain description of an articulated object as robot formats see it: links, joints of turns and slides, loops.

Metres, radians, kilograms; float64. Every link's frame has the canonical frame's axes at state 0, and its origin at the
joint that the link hangs on, so that at rest links differ by translations alone. The root's frame is the canonical one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import trimesh

EFFORT = 100.0
"""Least limit of a joint's torque or force, newton metre or newton; nothing in images tells it, nor the next three."""
VELOCITY = 2.0
"""Most speed of a joint, radian or metre per second."""
DAMPING = 0.05
"""Of a joint, newton metre per radian per second, or newton per metre per second."""
FRICTION = 0.02
"""Dry friction of a joint, newton metre or newton."""
GRAVITY = 9.81
"""Along -z of the canonical frame, metre per second squared."""


@dataclass(frozen=True)
class Freedom:
    """One number that moves a link: a turn about, or a slide along, an axis through the link's origin."""

    name: str
    type: Literal["revolute", "prismatic"]
    axis: np.ndarray
    """Unit vector [3], in the frame of the link and of the parent."""
    limits: tuple[float, float]
    """Radian or metre, lower < upper."""
    mimic: tuple[str, float] | None = None
    """For what has no value of its own: the freedom that it follows, and the factor."""


@dataclass(frozen=True)
class Joint:
    """How a link hangs on its parent: its freedoms from the parent outwards, none for fixed."""

    name: str
    parent: str
    child: str
    freedoms: tuple[Freedom, ...]
    between: tuple[str, ...]
    """Names for the links between the freedoms, where a format has one freedom a joint: one less than freedoms."""
    source: str | None
    """The bundle's joint; None for a part that hangs on nothing and is held to the root."""


@dataclass(frozen=True)
class Loop:
    """A joint that closes a loop: two links that the tree moves and that this holds together."""

    name: str
    type: str
    """A key of `JOINT_DOFS`."""
    parent: str
    child: str
    axis: np.ndarray
    """Unit vector [3]."""
    origin: np.ndarray
    """A point of the axis [3], metre, canonical frame."""
    pitch: float
    """Metre per radian; 0 but for screws."""


@dataclass(frozen=True)
class Inertia:
    """Mass properties in the link's frame."""

    mass: float
    centre: np.ndarray
    """Centre of mass [3]."""
    tensor: np.ndarray
    """About the centre of mass [3, 3], positive definite, and such as a body can have."""


@dataclass(frozen=True)
class Link:
    """A rigid body."""

    name: str
    part: str
    """The bundle's part."""
    origin: np.ndarray
    """Of the link's frame [3], in the canonical frame."""
    inertia: Inertia
    surface: trimesh.Trimesh | None
    """Coloured, in the link's frame; None for a part that has no Gaussians to be seen."""
    pieces: tuple[trimesh.Trimesh, ...]
    """Convex pieces for collision, in the link's frame."""

    @property
    def colour(self) -> np.ndarray:
        """Mean RGBA [4] of the surface in 0..1, for formats whose meshes have no colour."""
        if self.surface is None:
            return np.array([0.7, 0.7, 0.7, 1.0])
        return np.append(self.surface.visual.vertex_colors[:, :3].mean(0) / 255, 1.0)


@dataclass(frozen=True)
class Robot:
    """A tree of links, in order from the root."""

    name: str
    root: str
    links: dict[str, Link]
    joints: tuple[Joint, ...]
    """Parents before children."""
    loops: tuple[Loop, ...]
    overlaps: dict[tuple[str, str], float]
    """Links that are not neighbours but whose pieces overlap at rest, and how deep, metre; not to be collided."""
    scale: float
    """Metres per unit of the bundle."""
    notes: tuple[str, ...]
    """What a person should know of the export, a sentence each."""

    @property
    def freedoms(self) -> tuple[Freedom, ...]:
        return tuple(f for joint in self.joints for f in joint.freedoms)

    @property
    def uncollided(self) -> list[tuple[str, str]]:
        """Pairs of links that must not collide: neighbours touch at their joint, and others overlap at rest."""
        neighbours = [(joint.parent, joint.child) for joint in (*self.joints, *self.loops)]
        return list({frozenset(pair): pair for pair in (*neighbours, *self.overlaps)}.values())

    @property
    def size(self) -> float:
        """The diagonal of the box about all surfaces and link origins at rest, metre; more than 0."""
        points = [link.origin for link in self.links.values()]
        points += [
            x + link.origin for link in self.links.values() if link.surface is not None for x in link.surface.bounds
        ]
        return float(np.linalg.norm(np.ptp(points, axis=0))) or 1.0

    def offset(self, joint: Joint) -> np.ndarray:
        """The child's origin in the parent's frame [3] at rest."""
        return self.links[joint.child].origin - self.links[joint.parent].origin

    def complete(self, values: Mapping[str, float]) -> dict[str, float]:
        """A value for every freedom: those given, 0 for others, and what follows another computed."""
        out = {f.name: float(values.get(f.name, 0.0)) for f in self.freedoms}
        for f in self.freedoms:
            if f.mimic is not None:
                leader, factor = f.mimic
                out[f.name] = factor * out[leader]
        return out

    def subtree(self, link: str) -> list[Link]:
        """A link and all that hangs on it."""
        names = [link]
        for joint in self.joints:
            if joint.parent in names:
                names.append(joint.child)
        return [self.links[name] for name in names]
