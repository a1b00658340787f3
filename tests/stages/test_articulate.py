from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from splatart_ns.geometry.se3 import se3_exp
from splatart_ns.stages.articulate import Joint, KinematicTree, forward_kinematics, shifted
from splatart_ns.stages.joint_fit import JointFit


def joint(parent, child, kind, axis, origin, limits=(0.0, 1.0), pitch=0.0):
    axis = torch.tensor(axis, dtype=torch.float64)
    return Joint(
        parent,
        child,
        JointFit(kind, axis, torch.tensor(origin, dtype=torch.float64), pitch, torch.tensor([0.0, *limits]), 0.0),
    )


def tree() -> KinematicTree:
    """Base 4, arm 2 turning on it, tool 9 sliding on the arm, lid 3 fixed to the tool, cap 5 screwed on; 8 loose."""
    joints = [
        joint(4, 2, "revolute", [0, 0, 1], [1, 0, 0], (-1, 1)),
        joint(2, 9, "prismatic", [0, 1, 0], [0, 0, 0], (0, 0.5)),
        joint(9, 3, "fixed", [0, 0, 1], [0, 0, 0]),
        joint(4, 5, "screw", [1, 0, 0], [0, 0, 2], (0, 3), pitch=0.2),
    ]
    return KinematicTree([2, 3, 4, 5, 8, 9], 4, joints, unattached={8: "loose"})


def turn(rotvec, origin):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    T[:3, 3] = origin - T[:3, :3] @ origin
    return T


def shift(t):
    T = np.eye(4)
    T[:3, 3] = t
    return T


def test_motions_are_products_along_the_chain():
    q = torch.tensor([0.7, 0.3, 1.5], dtype=torch.float64)
    T = forward_kinematics(tree(), q).numpy()
    arm = turn([0, 0, 0.7], np.array([1.0, 0, 0]))
    tool = arm @ shift([0, 0.3, 0])
    cap = turn([1.5, 0, 0], np.array([0, 0, 2.0])) @ shift([0.3, 0, 0])
    for found, expected in zip(T, [arm, tool, np.eye(4), cap, np.eye(4), tool], strict=True):
        assert np.allclose(found, expected, atol=1e-14)


def test_batches_root_motion_and_names():
    q = torch.rand(2, 5, 3, dtype=torch.float64)
    T = forward_kinematics(tree(), q)
    assert T.shape == (2, 5, 6, 4, 4)
    assert torch.allclose(T[1, 3], forward_kinematics(tree(), q[1, 3]))
    root = se3_exp(torch.tensor([1.0, 2, 3, 0.1, 0.2, 0.3], dtype=torch.float64))
    assert torch.allclose(forward_kinematics(tree(), q, root_motion=root), root @ T)
    by_name = forward_kinematics(tree(), {"joint_2_9": 0.25})
    assert torch.allclose(by_name, forward_kinematics(tree(), torch.tensor([0, 0.25, 0], dtype=torch.float64)))
    with pytest.raises(KeyError, match="joint_9_9"):
        forward_kinematics(tree(), {"joint_9_9": 0.25})
    with pytest.raises(ValueError, match="4 values for 3"):
        forward_kinematics(tree(), torch.zeros(4))


def test_gradients_reach_values_and_root_also_at_zero():
    q = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    root = torch.eye(4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda q, root: forward_kinematics(tree(), q, root_motion=root), (q, root))


def test_observed_configurations_come_from_the_fits():
    assert tree().observed().tolist() == [[0, 0, 0], [-1, 0, 0], [1, 0.5, 3]]


def test_a_tree_without_movable_joints_stays():
    still = KinematicTree([1, 2], 1, [joint(1, 2, "fixed", [0, 0, 1], [0, 0, 0])])
    T = forward_kinematics(still, torch.zeros(7, 0))
    assert torch.equal(T, torch.eye(4).expand(7, 2, 4, 4))
    assert still.observed().shape == (3, 0)


def test_joints_of_more_freedom_take_their_values_side_by_side():
    still = torch.zeros(3, dtype=torch.float64)
    z = torch.tensor([0, 0, 1.0], dtype=torch.float64)
    values = {
        "cylindrical": torch.tensor([[0.0, 0], [0.3, 0.5]], dtype=torch.float64),
        "spherical": torch.tensor([[0.0, 0, 0], [0.1, 0.2, 0.3]], dtype=torch.float64),
        "free": torch.tensor([[0.0] * 6, [1.0, 2, 3, 0.1, 0.2, 0.3]], dtype=torch.float64),
    }
    joints = [Joint(1, k + 2, JointFit(kind, z, still, 0.0, v, 0.0)) for k, (kind, v) in enumerate(values.items())]
    nod = torch.tensor([0.0, -0.4], dtype=torch.float64)
    joints.insert(1, Joint(2, 9, JointFit("revolute", z, still, 0.0, nod, 0.0)))
    tree = KinematicTree([1, 2, 3, 4, 9], 1, joints)
    q = tree.observed()
    assert q[1].tolist() == pytest.approx([0.3, 0.5, -0.4, 0.1, 0.2, 0.3, 1.0, 2, 3, 0.1, 0.2, 0.3])
    T = forward_kinematics(tree, q)
    assert torch.allclose(T[1, 4], torch.tensor(turn([0, 0, 0.1], np.zeros(3)) @ shift([0, 0, 0.3])))
    assert torch.allclose(T[1, 2], torch.tensor(turn([0.1, 0.2, 0.3], np.zeros(3))))
    assert torch.allclose(T[1, 3], se3_exp(q[1, -6:]))
    by_name = forward_kinematics(tree, {"joint_1_3": [0.1, 0.2, 0.3]})
    assert torch.allclose(by_name[2], T[1, 2]) and torch.equal(by_name[1], torch.eye(4).double())


def test_a_tree_in_a_shifted_world_moves_its_points_alike():
    z, ball, free = torch.eye(3).double()[2], torch.zeros(2, 3).double(), torch.zeros(2, 6).double()
    ball[1], free[1] = torch.tensor([0.3, -0.2, 0.5]), torch.tensor([0.1, 0.2, 0.3, 0.4, -0.5, 0.6])
    joints = [replace(j, fit=replace(j.fit, values=j.fit.values[:2].double())) for j in tree().joints]
    joints += [
        Joint(4, 6, JointFit("spherical", z, torch.tensor([3.0, 1.0, 0.0]).double(), 0.0, ball, 0.0)),
        Joint(4, 8, JointFit("free", z, torch.zeros(3).double(), 0.0, free, 0.0)),
    ]
    joints[0] = replace(joints[0], other=joints[1])
    here = KinematicTree([2, 3, 4, 5, 6, 8, 9], 4, joints)
    by = torch.tensor([100.0, -50.0, 7.0]).double()
    there = shifted(here, by)
    shift_there, back = (torch.from_numpy(shift(x)) for x in (by.numpy(), -by.numpy()))
    expected = shift_there @ forward_kinematics(here, here.observed()) @ back
    torch.testing.assert_close(forward_kinematics(there, there.observed()), expected)
    torch.testing.assert_close(there.joints[0].other.fit.origin, joints[1].fit.origin + by)
