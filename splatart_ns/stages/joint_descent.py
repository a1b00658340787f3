"""The SPLATART paper's joint estimation: gradient descent on the ADD loss, kept for comparison.

Paper, section "Joint Estimation". A revolute joint is a centre c, an axis a and a fixed transform r from the centre
(12 numbers, of which only 5 matter to the motion); a prismatic one a fixed transform c and an axis a; each has one
value per state. `stages.joint` finds the same joints in milliseconds, with their uncertainty.
"""

from __future__ import annotations

import torch
from torch import Tensor

from splatart_ns.geometry.se3 import from_rotation_translation, inverse, se3_exp, so3_exp, transform_points, translation
from splatart_ns.stages.joint_fit import JointFit, mean_distance
from splatart_ns.stages.joint_parameters import joint_motion


def descend_joint(
    kind: str, T_rel: Tensor, points: Tensor, *, steps: int = 3000, learning_rate: float = 1e-2, max_points: int = 500
) -> JointFit:
    """A revolute or prismatic joint by Adam; arguments as in `fit_joint`, the result without covariance and score.

    The loss is the mean distance of (at most `max_points`) points over all states; the rate falls to 1 % of its start.
    """
    if kind not in ("revolute", "prismatic"):
        raise ValueError(f'"{kind}" joints are not fitted by descent, only "revolute" and "prismatic"')
    T_rel, points = T_rel.double(), points.to(T_rel.device).double()
    centroid = points.mean(0)
    used = points[:: -(-len(points) // max_points)] - centroid
    about = translation(centroid)
    targets = transform_points(inverse(about) @ T_rel @ about, used)

    centre = torch.zeros(3).to(T_rel).requires_grad_()
    axis = torch.ones(3).to(T_rel).requires_grad_()
    fixed = torch.zeros(6).to(T_rel).requires_grad_()
    # Off zero: where no joint moves, its axis has no gradient.
    values = (0.1 * torch.arange(len(T_rel)).to(T_rel)).requires_grad_()
    parameters = [axis, fixed, values] + ([centre] if kind == "revolute" else [])
    optimizer = torch.optim.Adam(parameters, lr=learning_rate)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.01 ** (1 / max(steps, 1)))
    for _ in range(steps):
        optimizer.zero_grad()
        unit = axis / torch.linalg.vector_norm(axis)
        if kind == "revolute":
            turns = so3_exp(values[:, None] * unit)
            model = from_rotation_translation(turns, centre.expand(len(values), 3)) @ se3_exp(fixed)
        else:
            slides = translation(values[:, None] * unit)
            model = se3_exp(fixed) @ slides
        loss = torch.linalg.vector_norm(transform_points(model, used) - targets, dim=-1).mean()
        loss.backward()
        optimizer.step()
        schedule.step()

    with torch.no_grad():
        unit = axis / torch.linalg.vector_norm(axis)
        # Relative to state 0, r drops out of a revolute joint, and c turns the axis of a prismatic one.
        direction = unit if kind == "revolute" else so3_exp(fixed[3:]) @ unit
        travel = values - values[0]
        sign = -1.0 if travel[travel.abs().argmax()] < 0 else 1.0
        direction, travel = sign * direction, sign * travel
        origin = centroid + centre - (centre @ direction) * direction
        model = joint_motion(kind, direction, origin, 0.0, travel)
        residual = mean_distance(points, T_rel[1:], model[1:])
    return JointFit(kind, direction, origin, 0.0, travel, residual, converged=False, iterations=steps)
