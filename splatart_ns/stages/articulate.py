"""Stage 5: an articulated object in any configuration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from splatart_ns.stages.joint import JointFit


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
    """Parts that hang on nothing, each with the reason. They move with the root."""

    @property
    def movable(self) -> list[Joint]:
        """The joints of the tree that have a value: the order of a configuration's entries."""
        return [j for j in self.joints if j.fit.type != "fixed"]

    def observed(self) -> Tensor:
        """The configurations [S, J] of the observed states; a tree without joints has but one."""
        states = len(self.joints[0].fit.values) if self.joints else 1
        return (
            torch.stack([j.fit.values for j in self.movable], -1) if self.movable else torch.zeros(states, 0).double()
        )


def forward_kinematics(
    tree: KinematicTree,
    q: Tensor | Mapping[str, float],
    *,
    root_motion: Tensor | None = None,
    clamp: bool = False,
) -> Tensor:
    """Motions [..., P, 4, 4] of all parts, in the order of `tree.part_ids`, from where they are at state 0.

    `q` [..., J]: the values of `tree.movable`, or some of them by joint name, the others 0. `root_motion`
    [..., 4, 4]: of the root, by default the identity. `clamp` keeps the values within the observed limits.
    Differentiable in `q` and `root_motion`.
    """
    movable = tree.movable
    if isinstance(q, Mapping):
        if unknown := set(q) - {j.name for j in movable}:
            raise KeyError(f"no movable joint is named {sorted(unknown)}; there are {[j.name for j in movable]}")
        q = torch.tensor([q.get(j.name, 0.0) for j in movable], dtype=torch.float64)
    if q.shape[-1] != len(movable):
        raise ValueError(f"a configuration of {q.shape[-1]} values for {len(movable)} movable joints")
    if clamp:
        limits = torch.tensor([j.fit.limits for j in movable]).reshape(-1, 2).to(q)
        q = q.clamp(limits[:, 0], limits[:, 1])
    root = torch.eye(4).to(q) if root_motion is None else root_motion.to(q)
    root = root.expand(*torch.broadcast_shapes(root.shape[:-2], q.shape[:-1]), 4, 4)
    motions = {tree.root: root}
    column = {id(j): k for k, j in enumerate(movable)}
    for joint in tree.joints:
        value = q[..., column[id(joint)]] if id(joint) in column else torch.zeros_like(root[..., 0, 0])
        motions[joint.child] = motions[joint.parent] @ joint.fit.motion(value)
    return torch.stack([motions.get(p, root) for p in tree.part_ids], -3)
