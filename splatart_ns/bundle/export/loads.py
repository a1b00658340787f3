"""What a joint has to carry, and the motor that it needs for that."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from splatart_ns.bundle.export.robot import EFFORT, FRICTION, GRAVITY, Freedom, Joint, Robot

_FREQUENCY = 5.0  # hertz, of a motor and what it moves
_SAG = 0.01  # of the range, that gravity and friction keep a joint from where its motor wants it
_RESERVE = 3.0  # times gravity


@dataclass(frozen=True)
class Load:
    """What hangs on one freedom, at rest, in SI units."""

    inertia: float
    """Moment of inertia about the axis, or mass."""
    gravity: float
    """The most torque or force that gravity can ask, however the object lies."""

    @property
    def effort(self) -> float:
        """Most torque or force of a motor: `EFFORT`, or three times what gravity asks."""
        return max(EFFORT, _RESERVE * self.gravity)

    def stiffness(self, freedom: Freedom) -> float:
        """Torque or force per radian or metre of a motor that holds a position."""
        low, high = freedom.limits
        return max(self.inertia * (2 * math.pi * _FREQUENCY) ** 2, (self.gravity + FRICTION) / (_SAG * (high - low)))


def load(robot: Robot, joint: Joint, freedom: Freedom) -> Load:
    """What hangs on a freedom of a joint: the child and all links behind it."""
    links = robot.subtree(joint.child)
    mass = sum(link.inertia.mass for link in links)
    if freedom.type == "prismatic":
        return Load(mass, mass * GRAVITY)
    inertia, moment = 0.0, np.zeros(3)
    for link in links:
        arm = np.cross(freedom.axis, link.origin + link.inertia.centre - robot.links[joint.child].origin)
        inertia += freedom.axis @ link.inertia.tensor @ freedom.axis + link.inertia.mass * arm @ arm
        moment += link.inertia.mass * arm
    return Load(float(inertia), float(np.linalg.norm(moment)) * GRAVITY)
