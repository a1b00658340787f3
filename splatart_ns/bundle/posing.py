"""A bundle in any configuration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from splatart_ns.bundle.bundle import JOINT_DOFS, Bundle, Joint
from splatart_ns.bundle.numbers import as_float64
from splatart_ns.capture.capture import Normalization
from splatart_ns.errors import InputError
from splatart_ns.records import LONGEST
from splatart_ns.splats.splat import Splat
from splatart_ns.stages import joint_parameters as stage

JointValue = float | Sequence[float] | Sequence[Sequence[float]] | np.ndarray | Tensor
"""Radians or length: [...] for a joint of one freedom, [..., D] for one of D, in the order of `Joint.values`."""


def joint_motion(joint: Joint, value: JointValue) -> Tensor:
    """The child's motion relative to its parent [..., 4, 4] float64, canonical frame, at values (0 gives the identity).

    On the CPU; differentiable in `value`. Raises InputError for values of a wrong shape, not finite or 1e18 and more.
    """
    try:
        value = as_float64(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"joint '{joint.name}': {value!r} are no numbers; give radians or lengths") from error
    dofs = JOINT_DOFS[joint.type]
    if dofs > 1 and value.shape[-1:] != (dofs,):
        found = f"is {joint.type} and takes {dofs} values, not shape {list(value.shape)}"
        raise InputError(f"joint '{joint.name}' {found}; give [{dofs}], or [B, {dofs}] for B configurations")
    if not value.isfinite().all():
        raise InputError(f"joint '{joint.name}' has a value that is not finite; give radians or lengths")
    if not bool((value.abs() < LONGEST).all()):
        raise InputError(f"joint '{joint.name}' has a value of {float(value.abs().max()):g}; give radians or lengths")
    return stage.joint_motion(joint.type, joint.axis, joint.origin, joint.pitch, value)


def configured_motions(bundle: Bundle, q: Mapping[str, JointValue]) -> dict[str, Tensor]:
    """T[part] [..., 4, 4] float64, canonical frame to the configuration `q` (joint to value; the others are 0).

    A joint goes by its name or by that of the part that it moves.

    The batches of the values broadcast. The root stays where it is at state 0, and so do parts that hang on nothing.
    Values beyond the limits are taken. Raises InputError for an unknown name, and as `joint_motion` does.
    """
    if not isinstance(q, Mapping):
        raise InputError(f"the configuration is {q!r}; give a dict of joints and their values")
    joints = bundle.tree_joints
    called = {name: bundle.tree_joint(name) for name in q}
    if unknown := [str(name) for name, joint in called.items() if joint is None]:
        known = ", ".join(joint.name for joint in joints) or "none"
        raise InputError(f"no tree joint is called {', '.join(sorted(unknown))}; there are {known}")
    values = {joint.name: q[name] for name, joint in called.items()}
    if len(values) < len(q):
        raise InputError(f"{', '.join(q)} name a joint twice, by itself and by the part that it moves; give it once")
    relative = {j.name: joint_motion(j, values.get(j.name, torch.zeros_like(j.values[0]))) for j in joints}
    try:
        batch = torch.broadcast_shapes(*(T.shape[:-2] for T in relative.values()))
    except RuntimeError as error:
        sizes = ", ".join(f"{name} {list(T.shape[:-2])}" for name, T in relative.items() if T.ndim > 2)
        raise InputError(f"the joints' values are of different batches: {sizes}; give as many of each") from error
    motions = {name: torch.eye(4, dtype=torch.float64).expand(*batch, 4, 4) for name in bundle.part_names}
    for joint in joints:
        motions[joint.child] = motions[joint.parent] @ relative[joint.name]
    return motions


def observed_motions(bundle: Bundle, state: int) -> dict[str, Tensor]:
    """T[part] [4, 4] float64 as estimated at an observed state."""
    return {part.name: part.motion[state] for part in bundle.parts}


def observed_values(bundle: Bundle, state: int) -> dict[str, Tensor]:
    """The configuration `q` of the tree joints at an observed state."""
    return {joint.name: joint.values[state] for joint in bundle.tree_joints}


def moved_splat(bundle: Bundle, motions: Mapping[str, Tensor]) -> Splat:
    """All parts' Gaussians, each moved by T[part]; in order of part id."""
    return Splat.cat([part.splat.transformed(motions[part.name]) for part in bundle.parts])


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
