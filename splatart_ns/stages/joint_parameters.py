"""Joints as numbers that a fit may change: the motions they make, and how these depend on each number."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from splatart_ns.geometry.screw import Screw
from splatart_ns.geometry.se3 import (
    adjoint,
    from_rotation_translation,
    inverse,
    se3_exp,
    skew,
    so3_exp,
)

JOINT_DOFS = {"fixed": 0, "prismatic": 1, "revolute": 1, "screw": 1, "cylindrical": 2, "spherical": 3, "free": 6}
"""Degrees of freedom by joint type, the simplest first."""
JOINT_LENGTHS = {"prismatic": 1, "cylindrical": 1, "free": 3}
"""How many of a joint's first values are lengths; the others are angles."""
Joints = tuple[Tensor, Tensor, Tensor, Tensor]
"""B joints of one type about their children's centroids: axes [B, 3], their points nearest the centroid [B, 3], pitches
[B], values [B, n, D] at the states 1 and up."""


def joint_motion(kind: str, axis: Tensor, origin: Tensor, pitch: float | Tensor, values: Tensor) -> Tensor:
    """Motions [..., 4, 4] of joints of type `kind` at values [...], or [..., D] for D > 1 degrees of freedom.

    Axes and origins [..., 3] broadcast to them.
    """
    if kind == "free":
        return se3_exp(values)
    if kind == "spherical":
        R = so3_exp(values)
        return from_rotation_translation(R, origin - (R @ origin[..., None])[..., 0])
    if kind == "cylindrical":
        slide, turn = values.unbind(-1)
    else:
        zero = torch.zeros_like(values)
        turn = zero if kind in ("prismatic", "fixed") else values
        slide = {"prismatic": values, "screw": pitch * values}.get(kind, zero)
    shape = (*turn.shape, 3)
    return Screw(axis.expand(shape), origin.expand(shape), turn, slide).motion()


def model_motions(kind: str, joints: Joints) -> Tensor:
    """Motions [B, n, 4, 4] of the children at the states 1 and up."""
    axis, point, pitch, values = joints
    return joint_motion(kind, axis[:, None], point[:, None], pitch[:, None], values_of(kind, values))


def values_of(kind: str, values: Tensor) -> Tensor:
    """Values [..., D] as `JointFit` has them: without the last dimension if it is one or none."""
    return values.sum(-1) if JOINT_DOFS[kind] <= 1 else values


def body_twists(kind: str, joints: Joints) -> Tensor:
    """How the body moves, seen from itself, by each of K parameters [B, n, 6, K].

    They are the axis's turns (2) and, if it turns, its shifts (2), or a centre's shifts (3); a screw's pitch; the
    values of every state.
    """
    axis, _, _, values = joints
    n, D = values.shape[1:]
    # Turning or shifting the joint conjugates the model: seen from the body, Ad(model^-1) - 1.
    conjugated = adjoint(inverse(model_motions(kind, joints))) - torch.eye(6).to(axis)
    columns = [conjugated @ _shape_twists(kind, joints)[:, None]]
    if kind == "screw":
        columns.append(pad(values * axis[:, None], (0, 3))[..., None])
    own = torch.eye(n).to(axis)[:, None, :, None] * _value_twists(kind, joints)[:, :, :, None]
    columns.append(own.reshape(*own.shape[:3], n * D))
    return torch.cat(columns, -1)


def _shape_twists(kind: str, joints: Joints) -> Tensor:
    """Twists [B, 6, K] of the joint itself: axis turns (2), axis shifts (2, if it turns); of a centre shifts (3)."""
    axis, point, _, _ = joints
    shifts = torch.eye(3).to(axis).expand(len(axis), 3, 3) if kind == "spherical" else across(axis)
    shifting = torch.cat([shifts, torch.zeros_like(shifts)], -2)
    turning = torch.cat([skew(point) @ shifts, shifts], -2)
    return {"prismatic": turning, "spherical": shifting}.get(kind, torch.cat([turning, shifting], -1))


def _value_twists(kind: str, joints: Joints) -> Tensor:
    """Twists [B, n, 6, D] of the body by each value."""
    axis, point, pitch, values = joints
    if kind == "spherical":
        # J_r of so3_exp: the translation of a motion with tangent (v, -phi) is J_l(-phi) v.
        eye = torch.eye(3).to(values)
        tangents = torch.cat([eye.expand(*values.shape, 3), -values[..., None, :].expand(*values.shape, 3)], -1)
        w = se3_exp(tangents)[..., :3, 3].mT
        return torch.cat([skew(point)[:, None] @ w, w], -2)
    slide, turn = pad(axis, (0, 3)), torch.cat([torch.linalg.cross(point, axis), axis], -1)
    twists = {
        "prismatic": [slide],
        "revolute": [turn],
        "screw": [turn + pitch[:, None] * slide],
        "cylindrical": [slide, turn],
    }[kind]
    return torch.stack(twists, -1)[:, None].expand(-1, values.shape[1], -1, -1)


def moved(kind: str, joints: Joints, step: Tensor, levers: Tensor | None = None) -> Joints:
    """The joints after a step of the parameters of `body_twists`.

    The axis turns about the centroid. With `levers` [B], lengths of the size of the children, an axis that is shifted
    away turns its child less, for the same travel at the lever: of a far axis the travel is known and the turn is not,
    so that steps of both at once would leave the valley that they are to follow.
    """
    axis, point, pitch, values = joints
    steps = step[:, -values[0].numel() :].reshape(values.shape)
    if kind == "spherical":
        return axis, point + step[:, :3], pitch, values + steps
    columns = across(axis)
    R = so3_exp((columns @ step[:, :2, None])[..., 0])
    if kind != "prismatic":
        shift = (columns @ step[:, 2:4, None])[..., 0]
        if levers is not None:
            arm, new_arm = ((x.square().sum(-1) + levers**2).sqrt()[:, None] for x in (point, point + shift))
            longer = (point * shift).sum(-1, keepdim=True) / arm
            turn = values[..., -1]
            kept = ((turn + steps[..., -1]) * arm + turn * longer) / new_arm - turn
            steps = torch.cat([steps[..., :-1], kept[..., None]], -1)
        point = (R @ (point + shift)[..., None])[..., 0]
    axis = (R @ axis[..., None])[..., 0]
    axis = axis / torch.linalg.vector_norm(axis, dim=-1, keepdim=True)
    point = point - (point * axis).sum(-1, keepdim=True) * axis
    if kind == "screw":
        pitch = pitch + step[:, 4]
    return axis, point, pitch, values + steps


def covariance_blocks(kind: str, axis: Tensor, values: Tensor, C: Tensor) -> dict[str, Tensor]:
    """What `JointFit.covariance` holds, from the covariances C [B, K, K] of the parameters of `body_twists`."""
    n, D = values.shape[1:]
    blocks = {"values": pad(C[:, -n * D :, -n * D :], (D, 0, D, 0))}
    if kind == "spherical":
        return blocks | {"origin": C[:, :3, :3]}
    columns = across(axis)
    to_axis = -skew(axis) @ columns  # a turn w of the axis moves it by w x axis
    blocks["axis"] = to_axis @ C[:, :2, :2] @ to_axis.mT
    if kind != "prismatic":
        blocks["origin"] = columns @ C[:, 2:4, 2:4] @ columns.mT
        blocks["axis_origin"] = to_axis @ C[:, :2, 2:4] @ columns.mT
    return blocks


def across(axis: Tensor) -> Tensor:
    """Two orthonormal directions across each axis, as columns [B, 3, 2]."""
    return torch.linalg.svd(axis[:, None]).Vh[:, 1:].mT


def inverse_left_jacobian(x: Tensor) -> Tensor:
    """The inverse left Jacobian of SE(3) [..., 6, 6] at small tangents x [..., 6], to second order.

    log(exp(d) exp(x)) is x plus its product with a tiny d.
    """
    turned = skew(x[..., 3:])
    ad = torch.cat([torch.cat([turned, skew(x[..., :3])], -1), torch.cat([torch.zeros_like(turned), turned], -1)], -2)
    return torch.eye(6).to(x) - ad / 2 + ad @ ad / 12
