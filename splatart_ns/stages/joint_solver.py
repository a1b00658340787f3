"""The best joint of a given type: the closed form (common screw axis of all states), then Levenberg-Marquardt.

What is made least are the distances between the child's points moved by the observed and by the modelled motion (ADD).
To second order their mean square is a quadratic form in the small motion between the two, so no step visits the
points. Where a covariance of the motion is known it takes the place of that form: it says which directions the images
left open.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from splatart_ns.geometry.se3 import adjoint, inverse, se3_exp, se3_log, so3_log
from splatart_ns.stages.joint_fit import JointFit, mean_distance
from splatart_ns.stages.joint_parameters import (
    Joints,
    across,
    body_twists,
    covariance_blocks,
    inverse_left_jacobian,
    model_motions,
    moved,
    values_of,
)

_MAX_ITERATIONS = 100
_HOPELESS = 1e3  # chi^2 per observed number of a fit that is not worth many digits
_MAX_HOPELESS = 30  # nor many iterations
_CREEP = 1e-3  # chi^2
_PRIOR = 1e-14
"""What is known beforehand of each parameter, as a share of what the data say of it."""


def best_joints(kind: str, T: Tensor, whiten: Tensor, unseen: Tensor, points: list[Tensor]) -> list[JointFit]:
    """The best joints of one type for motions T [B, n, 4, 4] of states 1 and up; the centroid is the origin.

    They have no score, and their covariances are tensors still. `whiten` [B, n, 6, 6] turns small motions into standard
    deviations; `points`: those of each child [N, 3], for the residual. `unseen` [B, n, 6, 6] takes from a small motion
    what nothing shows. Along it the motions may be anywhere, far beyond where a covariance means something: they are
    put where the joint has them.
    """
    levers = torch.stack([x.square().sum(-1).mean().sqrt() for x in points]).clamp_min(1e-9)
    joints, iterations, converged = _descended(kind, _closed_form(kind, T), T, whiten, levers)
    if unseen.any():
        back = se3_exp(-(unseen @ _left_over(kind, joints, T)[..., None])[..., 0])
        T, whiten = T @ back, whiten @ adjoint(back)
        joints, more, converged = _descended(kind, joints, T, whiten, levers)
        iterations = iterations + more
    cost = _whitened(whiten, _left_over(kind, joints, T)).square().sum(-1)
    return _results(kind, joints, T, whiten, points, cost, iterations, converged)


def _closed_form(kind: str, T: Tensor) -> Joints:
    """The common axis of all states: the principal direction of their turns (or slides), and its least-squares line.

    Of spherical joints the least-squares centre.
    """
    R, t = T[..., :3, :3], T[..., :3, 3]
    zero, up = torch.zeros_like(t[:, 0]), torch.tensor([0.0, 0.0, 1.0]).to(t).expand_as(t[:, 0])
    if kind == "fixed":
        return up, zero, zero[:, 0], t[..., :0]
    if kind == "spherical":
        return up, _fixed_point(R, t, torch.eye(3).to(t).expand(len(t), 3, 3)), zero[:, 0], so3_log(R)
    along = t if kind == "prismatic" else so3_log(R)
    axis = torch.linalg.svd(along).Vh[:, 0]
    values = along @ axis[..., None]
    if kind == "prismatic":
        return axis, zero, zero[:, 0], values
    slides = t @ axis[..., None]
    pitch = zero[:, 0]
    if kind == "screw":
        pitch = (slides * values).sum((-2, -1)) / (values * values).sum((-2, -1)).clamp_min(1e-300)
    point = _fixed_point(R, t - slides * axis[:, None], across(axis))
    return axis, point, pitch, torch.cat([slides, values], -1) if kind == "cylindrical" else values


def _narrowest(turns: Tensor) -> Tensor:
    """Turns [B, n, 1] about one axis, each told but for whole ones, so that with the 0 of state 0 they span least: none
    lies in the widest gap that they leave of the circle."""
    ring = pad(turns[..., 0], (1, 0)).remainder(2 * math.pi)
    around = ring.sort(1).values
    gaps = torch.cat([around[:, 1:], around[:, :1] + 2 * math.pi], 1) - around
    last = around.gather(1, gaps.argmax(1, keepdim=True))
    return torch.where(ring > last, ring - 2 * math.pi, ring)[:, 1:, None]


def _fixed_point(R: Tensor, t: Tensor, span: Tensor) -> Tensor:
    """The points [B, 3] in the span of columns [B, 3, K] that the motions (R, t) [B, n] move least."""
    A = ((torch.eye(3).to(R) - R) @ span[:, None]).flatten(1, 2)
    # The tiny constants matter to directions without a turn across them only: the point is then next to the centroid.
    H = A.mT @ A
    tiny = 1e-28 + 1e-14 * H.diagonal(dim1=-2, dim2=-1).sum(-1)
    damped = H + tiny[:, None, None] * torch.eye(H.shape[-1]).to(H)
    return (span @ torch.linalg.solve(damped, A.mT @ t.flatten(1, 2)[..., None]))[..., 0]


def _descended(kind: str, joints: Joints, T: Tensor, whiten: Tensor, levers: Tensor) -> tuple[Joints, Tensor, Tensor]:
    """Joints of least cost by Levenberg-Marquardt, its iterations [B], and whether they converged [B]."""
    joints = tuple(a.clone() for a in joints)
    x = _left_over(kind, joints, T)
    cost, damping = _whitened(whiten, x).square().sum(-1), torch.full_like(T[:, 0, 0, 0], 1e-6)
    observed = x[0].numel()
    last_gain = torch.full_like(cost, math.inf)
    iterations = torch.zeros_like(cost, dtype=torch.long)
    converged = torch.full_like(iterations, kind == "fixed", dtype=torch.bool)
    for k in range(_MAX_ITERATIONS):
        hopeless = cost > _HOPELESS * observed
        open_ = (~converged & ~(hopeless & (k >= _MAX_HOPELESS))).nonzero()[:, 0]
        if len(open_) == 0:
            break
        now, x_now, whiten_now = tuple(a[open_] for a in joints), x[open_], whiten[open_]
        J = _jacobian(kind, now, x_now, whiten_now)
        H, g, scale = normal_equations(J, _whitened(whiten_now, x_now))
        step = torch.linalg.solve(H + damping[open_, None, None] * torch.eye(H.shape[-1]).to(H), -g) / scale
        trial = moved(kind, now, step, levers[open_])
        x_trial = _left_over(kind, trial, T[open_])
        trial_cost = _whitened(whiten_now, x_trial).square().sum(-1)
        better, gain = trial_cost <= cost[open_], cost[open_] - trial_cost
        # Where no step goes down any more only rounding is left. Far axes creep along their valley to no purpose.
        tolerance = torch.where(hopeless[open_], 1e-4, 1e-8)
        creeps = (gain > 0.25 * last_gain[open_]) & (gain <= _CREEP * (cost[open_] / observed).clamp_min(1))
        done = creeps | (gain <= tolerance * cost[open_] + 1e-16)
        converged[open_] = torch.where(better, done, damping[open_] > 1e6)
        last_gain[open_] = torch.where(better, gain, last_gain[open_])
        damping[open_] = torch.where(better, (damping[open_] / 10).clamp_min(1e-12), damping[open_] * 10)
        iterations[open_] += 1
        found = open_[better]
        for a, b in zip((*joints, x, cost), (*trial, x_trial, trial_cost), strict=True):
            a[found] = b[better]
    return joints, iterations, converged


def _left_over(kind: str, joints: Joints, T: Tensor) -> Tensor:
    """The small motions x [B, n, 6] that the model leaves: T = model exp(x)."""
    return se3_log(inverse(model_motions(kind, joints)) @ T)


def _whitened(whiten: Tensor, x: Tensor) -> Tensor:
    """Residuals [B, 6 n]: small motions in standard deviations."""
    return (whiten @ x[..., None]).flatten(1)


def _jacobian(kind: str, joints: Joints, x: Tensor, whiten: Tensor) -> Tensor:
    """Derivatives [B, 6 n, K] of the residuals, where x is left over, by the parameters of `body_twists`."""
    return -(whiten @ inverse_left_jacobian(x) @ body_twists(kind, joints)).flatten(1, 2)


def normal_equations(J: Tensor, r: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """J^T J and J^T r for columns of unit length, and their lengths: so that metres and radians weigh the same."""
    scale = torch.linalg.vector_norm(J, dim=-2).clamp_min(1e-60)
    J = J / scale[..., None, :]
    return J.mT @ J, (J.mT @ r[..., None])[..., 0], scale


def inverse_hessian(J: Tensor) -> Tensor:
    """(J^T J)^-1 [..., K, K]; a direction that the data do not see comes out large, not infinite."""
    H, _, scale = normal_equations(J, J[..., 0])
    C = torch.linalg.inv(H + _PRIOR * torch.eye(H.shape[-1]).to(H))
    return C / (scale[..., :, None] * scale[..., None, :])


def spread_of_solution(J: Tensor, spread: Tensor) -> Tensor:
    """The covariance [K, K] of a least-squares solution of derivatives J [R, K], from that of J^T r, `spread` [K, K].

    It is large, too, in a direction that the data do not see.
    """
    H_inv, scale = inverse_hessian(J), normal_equations(J, J[..., 0])[2]
    return H_inv @ (spread + _PRIOR * scale.square().diag()) @ H_inv


def _results(
    kind: str,
    joints: Joints,
    T: Tensor,
    whiten: Tensor,
    points: list[Tensor],
    cost: Tensor,
    iterations: Tensor,
    converged: Tensor,
) -> list[JointFit]:
    axis, point, pitch, values = joints
    model = model_motions(kind, joints)
    if kind in ("revolute", "cylindrical"):
        values = torch.cat([values[..., :-1], _narrowest(values[..., -1:])], -1)
    sign = torch.ones_like(cost)[:, None]
    if kind not in ("fixed", "spherical"):
        last = values[..., -1]
        sign = torch.where(last.gather(1, last.abs().argmax(1, keepdim=True)) < 0, -sign, sign)
    covariances = [{}] * len(points) if kind == "fixed" else _covariances(kind, joints, T, whiten, cost, sign)
    axis, values = axis * sign, values_of(kind, pad(values * sign[..., None], (0, 0, 1, 0)))
    return [
        JointFit(
            type=kind,
            axis=axis[i],
            origin=point[i],
            pitch=float(pitch[i]),
            values=values[i],
            residual=mean_distance(points[i], T[i], model[i]),
            chi2=float(cost[i]),
            converged=bool(converged[i]),
            iterations=int(iterations[i]),
            covariance=covariances[i],
        )
        for i in range(len(points))
    ]


def _covariances(
    kind: str, joints: Joints, T: Tensor, whiten: Tensor, cost: Tensor, sign: Tensor
) -> list[dict[str, Tensor]]:
    """Blocks of the inverse Hessian. A direction that the data do not see comes out large, not zero.

    `sign` [B, 1]: -1 where axis and values are to be turned round.
    """
    axis, _, _, values = joints
    J = _jacobian(kind, joints, _left_over(kind, joints, T), whiten)
    freedom = J.shape[1] - J.shape[2]
    inflation = (cost / freedom).clamp_min(1) if freedom > 0 else torch.ones_like(cost)
    C = inflation[:, None, None] * inverse_hessian(J)
    blocks = covariance_blocks(kind, axis, values, C)
    if "axis_origin" in blocks:
        blocks["axis_origin"] = sign[..., None] * blocks["axis_origin"]
    return [{name: block[i] for name, block in blocks.items()} for i in range(len(J))]
