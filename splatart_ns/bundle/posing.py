"""A bundle in any configuration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from splatart_ns.bundle.bundle import JOINT_DOFS, Bundle, Joint
from splatart_ns.capture.capture import Normalization
from splatart_ns.splats.splat import Splat
from splatart_ns.stages import joint as stage

JointValue = float | Sequence[float] | Tensor
"""Radians or length; as many numbers as the joint has degrees of freedom, in the order of `Joint.values`."""


def joint_motion(joint: Joint, value: JointValue) -> Tensor:
    """The child's motion relative to its parent [4, 4] float64, canonical frame, at a value (0 gives the identity)."""
    value = torch.as_tensor(value, dtype=torch.float64)
    dofs = JOINT_DOFS[joint.type]
    if value.shape not in ({torch.Size([])} if dofs <= 1 else {torch.Size([dofs])}):
        raise ValueError(f"joint '{joint.name}' is {joint.type} and takes {dofs} values, not shape {list(value.shape)}")
    return stage.joint_motion(joint.type, joint.axis, joint.origin, joint.pitch, value)


def configured_motions(bundle: Bundle, q: Mapping[str, JointValue]) -> dict[str, Tensor]:
    """T[part] [4, 4] float64, canonical frame to the configuration `q` (joint name to value; the others are 0).

    The root stays where it is at state 0, and so do parts that hang on nothing. Raises KeyError for an unknown name.
    """
    if unknown := set(q) - {joint.name for joint in bundle.tree_joints}:
        raise KeyError(f"no tree joint is called {', '.join(sorted(unknown))}")
    motions = {name: torch.eye(4, dtype=torch.float64) for name in bundle.part_names}
    for joint in bundle.tree_joints:
        value = q.get(joint.name, torch.zeros_like(joint.values[0]))
        motions[joint.child] = motions[joint.parent] @ joint_motion(joint, value)
    return motions


def observed_motions(bundle: Bundle, state: int) -> dict[str, Tensor]:
    """T[part] [4, 4] float64 as estimated at an observed state."""
    return {part.name: part.motion[state] for part in bundle.parts}


def observed_values(bundle: Bundle, state: int) -> dict[str, Tensor]:
    """The configuration `q` of the tree joints at an observed state."""
    return {joint.name: joint.values[state] for joint in bundle.tree_joints}


def moved_splat(bundle: Bundle, motions: Mapping[str, Tensor]) -> Splat:
    """All parts' Gaussians, each moved by T[part]; in order of part id, SH padded to the highest degree."""
    width = max(part.splat.sh.shape[1] for part in bundle.parts)
    moved = []
    for part in bundle.parts:
        splat = part.splat.transformed(motions[part.name])
        splat.sh = torch.nn.functional.pad(splat.sh, (0, 0, 0, width - splat.sh.shape[1]))
        moved.append(splat)
    return Splat.cat(moved)


def posed_splat(bundle: Bundle, q: Mapping[str, JointValue]) -> Splat:
    """The object's Gaussians in the configuration `q` (see `configured_motions`), in order of part id."""
    return moved_splat(bundle, configured_motions(bundle, q))


def normalized(splat: Splat, normalization: Normalization) -> Splat:
    """A splat of the capture's world in the normalised world."""
    centre = torch.as_tensor(normalization.centre).to(splat.means)
    return replace(
        splat,
        means=normalization.scale * (splat.means - centre),
        log_scales=splat.log_scales + math.log(normalization.scale),
    )


def part_features(bundle: Bundle) -> Tensor:
    """One-hot part per Gaussian [N, P] float32, in the order of `moved_splat`: features to render part images."""
    counts = torch.tensor([len(part.splat) for part in bundle.parts])
    return torch.eye(len(counts)).repeat_interleave(counts, dim=0)
