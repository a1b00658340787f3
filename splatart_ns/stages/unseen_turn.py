"""Round parts that seem to rest: knobs and wheels, which look alike however they turn about their axis of symmetry.

Nothing tells whether they turned, or only light by how much. A fixed joint would explain all that is seen, but nobody
labels a knob as a part of its own for it to be fixed: it hangs on a joint about its axis, of which nothing tells the
values, or the images do within their error.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from splatart_ns.geometry.se3 import adjoint, inverse, skew, so3_log
from splatart_ns.stages.articulate import KinematicTree
from splatart_ns.stages.joint_constraint import JointConstraint
from splatart_ns.stages.joint_fit import UNSEEN_ROTATION, JointFit, mean_distance
from splatart_ns.stages.joint_pairs import stood_still

HARDLY_SEEN = math.radians(5)
"""A turn that is known no better than this, where all others are, may explain why a part seems fixed."""
SURE = 2.0
"""So many standard deviations are a turn: the axis of a round part is given, and its value the one parameter."""


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
