"""The configuration that images of the known object show."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from splatart_ns.bundle.bundle import JOINT_DOFS, JOINT_LENGTHS, Bundle, Joint
from splatart_ns.bundle.posing import configured_motions, joint_motion, normalized
from splatart_ns.capture.capture import Normalization
from splatart_ns.capture.view import View
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.part_pair import PartView, best_looks, huber_cost
from splatart_ns.stages.refinement import linearized

_COARSE, _FINE = (5, 1500), (12, 10000)
"""Views of a part, and the number of its pixels in each, in the search and in the refinement."""
_TURN_SAMPLES, _SLIDE_SAMPLES = 72, 61
_CLOSER, _FINER = 2, 5
"""How many times samples are taken again about the best, and how much closer to each other."""
_MAX_ITERATIONS = 20
_STEP = 2e-3
"""Forward differences: radians, and normalised lengths (the object has about unit size)."""


@dataclass(frozen=True)
class ConfigurationFit:
    """A configuration, and how well the images agree."""

    q: dict[str, Tensor]
    """Value of every tree joint with a freedom; as at state 0 where no label shows the part or what hangs on it."""
    converged: bool
    residual: dict[str, float]
    """Mean Huber cost per own pixel of each moving part that is seen, as `PartPair.cost`."""
    unseen: list[str]
    """Parts that no labelled view shows, or that have no Gaussians."""


@torch.no_grad()
def fit_configuration(bundle: Bundle, views: Sequence[View], normalization: Normalization) -> ConfigurationFit:
    """Find the joint values at which the bundle's parts look like labelled views of one configuration.

    Down the tree, each joint is swept over a full turn or its widened range, then about the best value (joints of
    several freedoms: over what was observed), each part compared on its own pixels and the background; then all values
    together are refined by Levenberg-Marquardt. The root stays where it is at state 0.

    Args:
        bundle: The object.
        views: Of one configuration, in the normalised world.
        normalization: Of the views' capture.
    """
    splats = {part.name: normalized(part.splat, normalization) for part in bundle.parts}
    coarse, fine = (
        {part.name: best_looks(views, part.id, *size) if len(part.splat) else () for part in bundle.parts}
        for size in (_COARSE, _FINE)
    )
    joints = [joint for joint in bundle.tree_joints if JOINT_DOFS[joint.type] > 0]
    q = {joint.name: torch.zeros_like(joint.values[0]) for joint in joints}
    for joint in joints:
        if not coarse[joint.child]:
            continue
        parent = configured_motions(bundle, q)[joint.parent]
        values = sweep_values(joint)
        # Closer and closer: what hangs on a part is looked for where that one is put.
        for _ in range(1 if values.ndim > 1 else 1 + _CLOSER):
            motions = parent @ joint_motion(joint, values)
            costs = _cost(splats[joint.child], coarse[joint.child], _to_normal(motions, normalization))
            q[joint.name] = values[int(costs.argmin())]
            if values.ndim == 1:
                values = q[joint.name] + (values[1] - values[0]) * torch.linspace(-1, 1, 2 * _FINER + 1).to(values)

    def motions_at(x: Tensor) -> dict[str, Tensor]:
        """Of a batch of all values [K, D]: T[part] [K, 4, 4] in the normalised world."""
        return {name: _to_normal(T, normalization) for name, T in configured_motions(bundle, _split(joints, x)).items()}

    unseen = [part.name for part in bundle.parts if not coarse[part.name]]
    moving = {joint.child: splats[joint.child] for joint in joints if fine[joint.child]}
    if not moving:
        return ConfigurationFit(q, True, {}, unseen)
    x = torch.cat([q[joint.name].reshape(-1) for joint in joints])
    scale = torch.cat([_units(joint, normalization) for joint in joints])
    x, converged = _refine(moving, fine, motions_at, x, scale)
    final = motions_at(x[None])
    residual = {name: float(_cost(splat, fine[name], final[name])[0]) for name, splat in moving.items()}
    return ConfigurationFit(_split(joints, x), converged, residual, unseen)


@torch.no_grad()
def appearance_residuals(
    bundle: Bundle, motions: Mapping[str, Tensor], views: Sequence[View], normalization: Normalization
) -> dict[str, float]:
    """`ConfigurationFit.residual` of all parts that views show, where the parts' motions T[part] are known."""
    residuals = {}
    for part in bundle.parts:
        if len(part.splat) and (looks := best_looks(views, part.id, *_FINE)):
            T = _to_normal(motions[part.name][None], normalization)
            residuals[part.name] = float(_cost(normalized(part.splat, normalization), looks, T)[0])
    return residuals


def sweep_values(joint: Joint) -> Tensor:
    """Values [K] or [K, D] among which to look for that of a joint: in all a turn, in a slide three times its range."""
    if JOINT_DOFS[joint.type] > 1:
        return joint.values
    ((low, high),) = joint.ranges
    if joint.type == "revolute":
        turn = torch.arange(_TURN_SAMPLES, dtype=torch.float64) * (2 * math.pi / _TURN_SAMPLES)
        middle = (low + high) / 2
        return middle + torch.remainder(turn + math.pi, 2 * math.pi) - math.pi
    return torch.linspace(2 * low - high, 2 * high - low, _SLIDE_SAMPLES, dtype=torch.float64)


def _cost(splat: Splat, looks: Sequence[PartView], T: Tensor) -> Tensor:
    """Mean Huber cost per own pixel of motions T [K, 4, 4]: [K] float64."""
    total = torch.zeros(len(T), dtype=torch.float64)
    for look in looks:
        total += huber_cost(*look.difference(splat, T))
    return total / max(sum(look.area / look.factor**2 for look in looks), 1.0)


def _refine(
    splats: Mapping[str, Splat],
    looks: Mapping[str, Sequence[PartView]],
    motions_at: Callable[[Tensor], dict[str, Tensor]],
    x: Tensor,
    scale: Tensor,
) -> tuple[Tensor, bool]:
    """Levenberg-Marquardt on the values x [D] in units of `scale`, with Huber weights; and whether it converged."""
    D, damping, converged = len(x), 1e-3, False
    steps = torch.cat([torch.zeros(1, D, dtype=x.dtype), _STEP * torch.diag(scale)])

    def equations(x: Tensor) -> tuple[Tensor, Tensor, float]:
        H, g, cost = torch.zeros(D, D, dtype=x.dtype), torch.zeros(D, dtype=x.dtype), 0.0
        motions = motions_at(x + steps)
        for name, splat in splats.items():
            moves = torch.tensor([not torch.equal(T, motions[name][0]) for T in motions[name][1:]])
            k = moves.nonzero()[:, 0]
            tried = motions[name][torch.cat([k.new_zeros(1), k + 1])]
            for look in looks[name]:
                part_H, part_g, part_cost = linearized(*look.difference(splat, tried), _STEP)
                H[k[:, None], k] += part_H
                g[k] += part_g
                cost += part_cost
        return H, g, cost

    H, g, cost = equations(x)
    for _ in range(_MAX_ITERATIONS):
        step = -torch.linalg.solve(H + damping * H.diagonal().clamp_min(1e-9).diag(), g)
        trial = equations(x + scale * step)
        if trial[2] < cost:
            x, damping = x + scale * step, damping * 0.3
            H, g, cost = trial
        else:
            damping = max(damping, 1e-3) * 10
        if float(step.abs().max()) < 0.1 * _STEP or damping > 1e4:
            converged = True
            break
    return x, converged


def _split(joints: Sequence[Joint], x: Tensor) -> dict[str, Tensor]:
    """The values x [..., D] of all joints side by side, joint by joint."""
    parts = x.split([joint.values[0].numel() for joint in joints], -1)
    return {j.name: v if j.values.ndim > 1 else v[..., 0] for j, v in zip(joints, parts, strict=True)}


def _units(joint: Joint, normalization: Normalization) -> Tensor:
    """What one unit of refinement is in each value: a radian, or a normalised length."""
    units = torch.ones(JOINT_DOFS[joint.type], dtype=torch.float64)
    units[: JOINT_LENGTHS.get(joint.type, 0)] = 1 / normalization.scale
    return units


def _to_normal(T: Tensor, normalization: Normalization) -> Tensor:
    return torch.from_numpy(normalization.motion_to_normal(T.numpy()))
