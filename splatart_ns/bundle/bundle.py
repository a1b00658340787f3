"""The result: parts with their Gaussians and motions, joints, and the kinematic tree."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from splatart_ns.splats.splat import Splat
from splatart_ns.stages.joint_parameters import JOINT_DOFS as JOINT_DOFS
from splatart_ns.stages.joint_parameters import JOINT_LENGTHS as JOINT_LENGTHS


@dataclass
class Part:
    """A rigid body of the object."""

    id: int
    """The label id, 1 or more."""
    name: str
    splat: Splat
    """Gaussians in the canonical frame (the world at state 0), in the input cameras' unit."""
    motion: Tensor
    """T[state]: canonical to that state [S, 4, 4] float64; the first is the identity."""
    motion_covariance: Tensor
    """Covariance of each motion's tangent (translation, rotation) [S, 6, 6]; NaN where undetermined."""


@dataclass
class Joint:
    """A joint between two parts; axis and origin are in the canonical frame."""

    name: str
    type: str
    """A key of `JOINT_DOFS`."""
    parent: str
    child: str
    axis: Tensor
    """Unit axis [3] float64."""
    origin: Tensor
    """A point on the axis [3] float64."""
    values: Tensor
    """Per state [S], radian (revolute, screw) or length (prismatic), 0 at state 0; [S, D] for D = 2, 3 or 6 degrees
    of freedom: (length, angle) for cylindrical, a rotation vector for spherical, a tangent (translation, rotation)
    for free. Zeros for fixed."""
    limits: tuple[float, float] | None
    """The observed range of the value, or what somebody gave instead; a whole turn of a round part whose turns nothing
    tells. 0, where state 0 is, lies in it. None for types with more than one degree of freedom."""
    pitch: float = 0.0
    """Length per radian; 0 but for screws."""
    in_tree: bool = True
    residual: float = 0.0
    """Mean distance of the child's points between the observed motion and the joint's, length."""
    covariance: dict[str, Any] = field(default_factory=dict)
    """Blocks as nested lists: "axis", "origin" (across the axis), "axis_origin", all [3, 3], and "values" [S, S] or
    [S D, S D]; None where undetermined."""
    ambiguous: bool = False
    alternatives: list[dict[str, Any]] = field(default_factory=list)
    """Other types that were tried: {"type", "residual", "score"}; and, with the key "parent", the joint by which the
    child would hang on another part, where that is nearly as likely."""

    @property
    def other_parents(self) -> list[str]:
        """Parts that the child may hang on as well."""
        return [other["parent"] for other in self.alternatives if "parent" in other]

    @property
    def ranges(self) -> list[tuple[float, float]]:
        """Of each of the joint's numbers: `limits` where they are given, else what its values lie between; with 0."""
        numbers = self.values.reshape(len(self.values), -1)
        if self.limits is not None:
            numbers = numbers.new_tensor(self.limits)[:, None]
        return list(zip(numbers.amin(0).clamp_max(0).tolist(), numbers.amax(0).clamp_min(0).tolist(), strict=True))


@dataclass
class Bundle:
    """What `splatart fit` leaves, with the Gaussians loaded."""

    parts: list[Part]
    """In order of id."""
    joints: list[Joint]
    """All accepted joints; those with `in_tree` form a tree, the rest close loops."""
    root: str
    """The part that the tree hangs from. A part that hangs on nothing has no joint, and moves with the root."""
    states: list[str]
    length_unit: str = "unknown"
    loops: list[dict[str, Any]] = field(default_factory=list)
    """Loop closures: {"joint": name, "parts": [names around the loop]}."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """{"version", "seed", "settings"}; "cameras": where those of each state were [S][N][3], canonical frame; "worlds",
    where states came in worlds of their own: the similarities [S][4][4] that brought them into the canonical frame."""

    @property
    def part_names(self) -> list[str]:
        return [part.name for part in self.parts]

    def part(self, name: str) -> Part:
        return next(part for part in self.parts if part.name == name)

    @property
    def tree_joints(self) -> list[Joint]:
        """The tree's joints, parents before children."""
        of_parent: dict[str, list[Joint]] = {}
        for joint in self.joints:
            if joint.in_tree:
                of_parent.setdefault(joint.parent, []).append(joint)
        ordered, open_parts = [], [self.root]
        while open_parts:
            joints = of_parent.pop(open_parts.pop(0), [])
            ordered += joints
            open_parts += [joint.child for joint in joints]
        return ordered

    def tree_joint(self, name: str) -> Joint | None:
        """The tree's joint of this name, or else the one that moves the part of this name."""
        joints = self.tree_joints
        by_part = {joint.child: joint for joint in joints}
        return next((joint for joint in joints if joint.name == name), by_part.get(name))
