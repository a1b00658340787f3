"""Round parts, which look alike however they turn about their axis of symmetry: knobs and wheels that seem to rest, and
rods that turn about hinges.

Nothing tells whether they turned, or only light by how much. A fixed joint would explain all that is seen, but nobody
labels a knob as a part of its own for it to be fixed: it hangs on a joint about its axis, of which nothing tells the
values, or the images do within their error.

Of two states, a rod on a hinge tells the plane in which it turned, but not whether it also turned about itself: however
far it did, some hinge explains it. The least turn against what it hangs on is about a line across the rod, as a
tripod's legs, a lamp's arms and an aerial hang.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from splatart_ns.geometry.se3 import adjoint, inverse, se3_exp, skew, so3_log
from splatart_ns.stages.articulate import KinematicTree
from splatart_ns.stages.joint_constraint import JointConstraint
from splatart_ns.stages.joint_fit import UNSEEN_ROTATION, JointFit, mean_distance
from splatart_ns.stages.joint_pairs import fit_pairs, stood_still
from splatart_ns.stages.unseen import as_seen, least_turn

HARDLY_SEEN = math.radians(5)
"""A turn that is known no better than this, where all others are, may explain why a part seems fixed."""
SURE = 2.0
"""So many standard deviations are a turn: the axis of a round part is given, and its value the one parameter."""


def turned_least(
    tree: KinematicTree,
    points: dict[int, Tensor],
    motions: Mapping[int, Tensor],
    object_radius: float,
    *,
    covariances: Mapping[int, Tensor],
    **settings: Any,
) -> tuple[KinematicTree, dict[int, Tensor], dict[int, Tensor]]:
    """The tree, motions [2, 4, 4] of its parts and covariances [2, 6, 6] by which to weigh these, where parts of whose
    turn about one axis nothing tells turn as little as may be against their parents.

    So they count as known to `HARDLY_SEEN`: less than all that is seen of other parts, but more than the noise, which
    any turn of theirs could make up for. Other arguments as in `turned_unseen`; `settings` as in `fit_pairs`. With more
    than two states the directions of a rod alone tell its hinge, and everything stays as it is.
    """
    motions, weighed = {p: T.double() for p, T in motions.items()}, dict(covariances)
    joints, turned = [], set()
    for joint in tree.joints:
        a, b = joint.parent, joint.child
        if len(motions[b]) == 2 and joint.fit.dofs > 0 and joint.fit.type != "free":
            twist = _unseen_twist(covariances[b][1].to(motions[b]))
            if twist is not None:
                relative = motions[b][1] @ inverse(motions[a][1])
                turn = se3_exp(torch.stack([0 * twist, least_turn(relative, twist[3:]) * twist]))
                motions[b] = turn @ motions[b]
                weighed[b] = as_seen(covariances[b]) + HARDLY_SEEN**2 * twist.outer(twist)
                turned.add(b)
            if turned & {a, b}:
                pair = [{p: of_parts[p] for p in (a, b)} for of_parts in (points, motions, weighed)]
                fit = fit_pairs(*pair[:2], object_radius, covariances=pair[2], types=[joint.fit.type], **settings)[a, b]
                shape = {"axis": fit.axis, "origin": fit.origin, "pitch": fit.pitch, "values": fit.values}
                joint = replace(joint, fit=replace(joint.fit, **shape))
        joints.append(joint)
    return replace(tree, joints=joints), motions, weighed


def _unseen_twist(covariance: Tensor) -> Tensor | None:
    """The twist [6] of unit rotation of the one turn that a covariance [6, 6] says is not seen; None if there is none,
    or more than one."""
    variances, directions = torch.linalg.eigh(covariance[3:, 3:].nan_to_num())
    if (variances > UNSEEN_ROTATION**2).sum() != 1:
        return None
    return covariance[:, 3:] @ directions[:, -1] / variances[-1]


def turned_unseen(
    tree: KinematicTree,
    points: Mapping[int, Tensor],
    motions: Mapping[int, Tensor],
    covariances: Mapping[int, Tensor],
    errors: Mapping[int, Tensor],
    constraints: Sequence[JointConstraint] = (),
) -> KinematicTree:
    """The tree, where parts that seem to rest on their parents, but may have turned about one axis, or did so by an
    angle that is hardly told, hang on joints about that.

    Args:
        tree: Joints that were fitted to what is seen.
        points: Of each part [N, 3], at state 0.
        motions: Observed motions [S, 4, 4] by part, canonical frame.
        covariances: Theirs [S, 6, 6], T_true = exp(d) T, d = (translation, rotation) about the world's origin.
        errors: The same with the noise of the points, which sees every turn.
        constraints: What the user knows of joints; one that is said to be fixed, or not to turn, stays as it is.
    """
    joints = []
    for joint in tree.joints:
        pair = {joint.parent, joint.child}
        told = {(c.type, c.forbidden) for c in constraints if {c.parent, c.child} == pair}
        rests = joint.fit.type in ("fixed", "revolute") and not joint.fit.values.any()
        if rests and not told & {("fixed", False), ("revolute", True)}:
            to_parent = adjoint(inverse(motions[joint.parent].double()))
            relative = errors[joint.child] + (0 if stood_still(joint.parent, motions) else errors[joint.parent])
            C, E = (to_parent @ x.to(to_parent) @ to_parent.mT for x in (covariances[joint.child], relative))
            T_rel = inverse(motions[joint.parent].double()) @ motions[joint.child].double()
            seen = points[joint.child].to(C), T_rel.to(C), C.nan_to_num(), E
            joint = replace(joint, fit=_about_unseen_axis(joint.fit, *seen))
        joints.append(joint)
    return replace(tree, joints=joints)


def _about_unseen_axis(fit: JointFit, points: Tensor, T_rel: Tensor, C: Tensor, errors: Tensor) -> JointFit:
    """The joint of a child with points [N, 3] that seems to rest, about the one axis about which its motion T_rel
    [S, 4, 4] hardly tells its turn, by the covariances C and errors [S, 6, 6] of that; `fit` if there is none, or more
    than one."""
    variances, directions = torch.linalg.eigh(C[:, 3:, 3:])
    state = int(variances[:, -1].argmax())
    axis, variance = directions[state, :, -1], variances[state, -1]
    values, sigma = so3_log(T_rel[:, :3, :3]) @ axis, variances[:, -1].sqrt()
    if values[values.abs().argmax()] < 0:
        axis, values = -axis, -values
    values = values.where((sigma < UNSEEN_ROTATION) & (values.abs() > SURE * sigma), 0)
    least = HARDLY_SEEN if values.any() else UNSEEN_ROTATION
    if (variances[state] > least**2).sum() != 1:
        return fit
    twist = C[state, :, 3:] @ axis / variance
    origin = torch.linalg.cross(axis, twist[:3])
    origin = origin + (points.mean(0) - origin) @ axis * axis
    # What else is uncertain moves the axis along with the part.
    rest = errors[state] - variance * twist.outer(twist)
    moves_axis = torch.cat([torch.zeros(3, 3).to(C), -skew(axis)], 1)
    moves_origin = (torch.eye(3).to(C) - axis.outer(axis)) @ torch.cat([torch.eye(3).to(C), -skew(origin)], 1)
    covariance = {
        "axis": moves_axis @ rest @ moves_axis.mT,
        "origin": moves_origin @ rest @ moves_origin.mT,
        "axis_origin": moves_axis @ rest @ moves_origin.mT,
        "values": (variances[:, -1] * (variances[:, -1] > least**2)).diag(),
    }
    known = "by how much it did is hardly told" if values.any() else "whether it did is undetermined"
    others = {other["type"]: other for other in fit.alternatives}
    others[fit.type] = {"type": fit.type, "residual": fit.residual, "score": fit.score}
    score = others.pop("revolute", {}).get("score", math.inf)
    turning = replace(fit, type="revolute", axis=axis, origin=origin, values=values)
    return replace(
        turning,
        residual=mean_distance(points, T_rel[1:], turning.motion(values[1:])),
        score=score,
        covariance={name: block.tolist() for name, block in covariance.items()},
        ambiguous=True,
        alternatives=sorted(others.values(), key=lambda other: other["score"]),
        undetermined=[f"The part looks alike however it turns about its axis, so {known}."],
    )
