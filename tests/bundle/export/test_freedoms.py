import math

import numpy as np
import pytest
import torch

from splatart_ns.bundle import JOINT_DOFS, joint_motion
from splatart_ns.bundle.export.freedoms import freedom_names, freedom_values, freedoms, joint_value
from splatart_ns.bundle.export.glb import local_motion
from splatart_ns.bundle.export.robot import Joint as RobotJoint


def chain_of(joint, scale=1.0, margin=0.0):
    return freedoms(joint, freedom_names(joint), scale, margin)


def complete(chain, rng):
    values = {f.name: rng.uniform(*f.limits) for f in chain}
    for f in chain:
        if f.mimic is not None:
            values[f.name] = f.mimic[1] * values[f.mimic[0]]
    return values


@pytest.mark.parametrize("kind", list(JOINT_DOFS))
@pytest.mark.parametrize("scale", [1.0, 0.01])
def test_a_chain_moves_as_the_joint_does(objects, kind, scale):
    joint = objects.joint("j", kind, "a", "b", 1)
    chain = chain_of(joint, scale)
    rng = np.random.default_rng(0)
    for _ in range(20):
        values = complete(chain, rng)
        shift, turn = local_motion(RobotJoint("j", "a", "b", chain, (), "j"), values)
        T = joint_motion(joint, joint_value(joint, [values[f.name] for f in chain], scale)).numpy()
        origin = joint.origin.numpy()
        np.testing.assert_allclose(turn.as_matrix(), T[:3, :3], atol=1e-12)
        np.testing.assert_allclose(shift, scale * (T[:3, :3] @ origin + T[:3, 3] - origin), atol=1e-12)


@pytest.mark.parametrize("kind", list(JOINT_DOFS))
def test_the_observed_states_lie_within_the_limits(objects, kind):
    joint = objects.joint("j", kind, "a", "b", 1)
    chain = chain_of(joint, scale=0.1)
    for value in joint.values:
        numbers = freedom_values(joint, value, 0.1)
        assert all(f.limits[0] <= x <= f.limits[1] for f, x in zip(chain, numbers, strict=True))
        again = joint_motion(joint, joint_value(joint, numbers, 0.1))
        torch.testing.assert_close(again, joint_motion(joint, value), atol=1e-12, rtol=0)


def test_limits_are_wider_by_the_margin_of_the_range(objects):
    (hinge,) = chain_of(objects.joint("j", "revolute", "a", "b", 1), margin=0.1)
    assert hinge.limits == pytest.approx((-0.12, 1.32))


def test_lengths_are_scaled_and_angles_are_not(objects):
    slide, turn = chain_of(objects.joint("j", "cylindrical", "a", "b", 1), scale=0.1)
    assert slide.limits == pytest.approx((-0.01, 0.02))
    assert turn.limits == pytest.approx((0.0, 1.0))


def test_a_screw_slides_as_it_turns(objects):
    turn, slide = chain_of(objects.joint("j", "screw", "a", "b", 1), scale=10.0)
    assert slide.mimic == (turn.name, pytest.approx(0.3))
    assert slide.limits == pytest.approx((0.0, 1.2))


def test_a_joint_that_did_not_move_has_no_freedom(objects):
    still = torch.zeros(3, dtype=torch.float64)
    for limits in [(0.0, 0.0), None]:
        assert chain_of(objects.joint("j", "revolute", "a", "b", 1, values=still, limits=limits)) == ()


def test_without_limits_the_values_give_the_range(objects):
    (hinge,) = chain_of(objects.joint("j", "revolute", "a", "b", 1, limits=None))
    assert hinge.limits == pytest.approx((0.0, 1.2))


def test_a_direction_that_did_not_move_keeps_a_range_that_is_not_empty(objects):
    values = torch.tensor([[0.0, 0.0], [0.0, 1.0], [0.0, 0.5]], dtype=torch.float64)
    slide, turn = chain_of(objects.joint("j", "cylindrical", "a", "b", 1, values=values))
    assert slide.limits[0] < 0 < slide.limits[1] and slide.limits[1] - slide.limits[0] < 1e-5
    assert turn.limits == (0.0, 1.0)


def test_a_ball_in_gimbal_lock_is_where_it_was(objects):
    values = torch.tensor([[0.0, 0, 0], [0.0, math.pi / 2, 0], [0, 0, math.pi]], dtype=torch.float64)
    joint = objects.joint("j", "spherical", "a", "b", 1, values=values)
    for value in values:
        again = joint_motion(joint, joint_value(joint, freedom_values(joint, value, 1.0), 1.0))
        torch.testing.assert_close(again, joint_motion(joint, value), atol=1e-7, rtol=0)
