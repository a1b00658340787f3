"""Stage 5: an articulated object in any configuration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from splatart_ns.geometry.se3 import adjoint, translation
from splatart_ns.stages.joint_fit import JointFit


@dataclass(frozen=True)
class Joint:
    """A fitted joint between two parts, given by their ids."""

    parent: int
    child: int
    fit: JointFit
    gap: float = 0.0
    """How far the two parts come apart in the observed states, length."""
    cost: float = 0.0
    """What speaks against the joint, in shares of the object's radius."""
    other: Joint | None = None
    """By which the child would hang on another parent, where that is nearly as likely."""

    @property
    def name(self) -> str:
        return f"joint_{self.parent}_{self.child}"


@dataclass(frozen=True)
class KinematicTree:
    """Parts and the joints that connect them."""

    part_ids: list[int]
    root: int
    joints: list[Joint]
    """One for every part that hangs on another, parents before their children."""
    loops: list[Joint] = field(default_factory=list)
    """Joints that close loops."""
    rejected: list[Joint] = field(default_factory=list)
    """Pairs that move like a joint and were not chosen, cheapest first."""
    unattached: dict[int, str] = field(default_factory=dict)
    """Parts that no joint explains, each with the reason. They hang on nothing and move with the root, but for those
    that others hang on: they have a free joint."""
    contradicted: dict[int, str] = field(default_factory=dict)
    """Parts that hang by a joint of a type that the user told and that explains their motions far worse than another
    type, each with a sentence."""

    @property
    def movable(self) -> list[Joint]:
        """The joints of the tree that have values: the order of a configuration's entries."""
        return [j for j in self.joints if j.fit.dofs > 0]

    def observed(self) -> Tensor:
        """The configurations [S, J] of the observed states; a tree without joints has but one."""
        states = len(self.joints[0].fit.values) if self.joints else 1
        values = [j.fit.values.reshape(states, j.fit.dofs) for j in self.movable]
        return torch.cat(values, -1) if values else torch.zeros(states, 0).double()


def shifted(tree: KinematicTree, by: Tensor) -> KinematicTree:
    """The tree in a world in which every point lies further along `by` [3]."""

    def moved(joint: Joint | None) -> Joint | None:
        if joint is None:
            return None
        fit = joint.fit
        values = fit.values
        if fit.type == "free":  # tangents about the world's origin
            values = values @ adjoint(translation(by)).to(values).mT
        return replace(
            joint, fit=replace(fit, origin=fit.origin + by.to(fit.origin), values=values), other=moved(joint.other)
        )

    groups = {name: [moved(joint) for joint in getattr(tree, name)] for name in ("joints", "loops", "rejected")}
    return replace(tree, **groups)


def forward_kinematics(
    tree: KinematicTree,
    q: Tensor | Mapping[str, float | Sequence[float]],
    *,
    root_motion: Tensor | None = None,
) -> Tensor:
    """Motions [..., P, 4, 4] of all parts, in the order of `tree.part_ids`, from where they are at state 0.

    `q` [..., J]: the values of `tree.movable` one joint after the other, as many as it has degrees of freedom, or some
    of them by joint name, the others 0. `root_motion` [..., 4, 4]: of the root, by default the identity.
    Differentiable in `q` and `root_motion`.
    """
    movable = tree.movable
    dofs = [j.fit.dofs for j in movable]
    if isinstance(q, Mapping):
        if unknown := set(q) - {j.name for j in movable}:
            raise KeyError(f"no movable joint is named {sorted(unknown)}; there are {[j.name for j in movable]}")
        values = [torch.as_tensor(q.get(j.name, [0.0] * j.fit.dofs)).double().reshape(j.fit.dofs) for j in movable]
        q = torch.cat(values) if values else torch.zeros(0).double()
    if q.shape[-1] != sum(dofs):
        raise ValueError(f"a configuration of {q.shape[-1]} values for {sum(dofs)} of the movable joints")
    root = torch.eye(4).to(q) if root_motion is None else root_motion.to(q)
    root = root.expand(*np.broadcast_shapes(root.shape[:-2], q.shape[:-1]), 4, 4)  # see from_rotation_translation
    motions = {tree.root: root}
    values = {id(j): v for j, v in zip(movable, q.split(dofs, -1), strict=True)}
    for joint in tree.joints:
        value = values.get(id(joint), torch.zeros_like(root[..., 0, :1]))
        value = value[..., 0] if joint.fit.dofs <= 1 else value
        motions[joint.child] = motions[joint.parent] @ joint.fit.motion(value)
    return torch.stack([motions.get(p, root) for p in tree.part_ids], -3)
