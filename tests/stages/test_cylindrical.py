import math

import pytest
import torch
from tree_scene import X, Z, box, edges, four_bar, motions_of, rod, true_joint

from splatart_ns.geometry.se3 import from_rotation_translation, se3_exp, so3_exp
from splatart_ns.stages.articulate import KinematicTree
from splatart_ns.stages.joint_constraint import JointConstraint
from splatart_ns.stages.tree import infer_tree

CHANGE = [0.07, 1.2, 0.4]


def chair(states: int = 2):
    """A column on a foot (1), a seat (2) that turns and slides on it, and a back (3) hinged to the seat."""
    points = {
        1: torch.cat([box((0, 0, 0), (1, 1, 0.1), 1), rod((0, 0, 0), (0, 0, 0.85), 0.1, 4)]),
        2: box((0.1, 0, 0.9), (0.8, 0.7, 0.1), 2),
        3: box((0.5, 0, 1.3), (0.05, 0.7, 0.7), 3),
    }
    joints = [true_joint(1, 2, "cylindrical", Z, (0, 0, 0.9)), true_joint(2, 3, "revolute", (0, 1, 0), (0.5, 0, 0.95))]
    truth = KinematicTree([1, 2, 3], 1, joints)
    q = torch.tensor([[0.0] * 3, CHANGE, [-0.05, 0.5, 0.2], [0.05, -0.6, 0.7]], dtype=torch.float64)[:states]
    return points, truth, motions_of(truth, q)


def test_a_seat_that_turned_and_slid_hangs_on_the_column_with_all_it_carries():
    points, truth, motions = chair()
    tree = infer_tree(points, motions)
    assert tree.root == 1 and edges(tree) == edges(truth) and not tree.unattached
    fits = {j.child: j.fit for j in tree.joints}
    assert fits[2].type == "cylindrical" and fits[3].type == "revolute"
    assert float(fits[2].axis @ Z) == pytest.approx(1, abs=1e-9)
    assert torch.linalg.cross(fits[2].origin, Z).norm() < 1e-9
    assert torch.allclose(fits[2].values, torch.tensor([[0, 0], CHANGE[:2]]).double(), atol=1e-9)
    assert fits[2].ambiguous and "touch" in fits[2].undetermined[-1]
    assert {other["type"] for other in fits[2].alternatives} == {"fixed", "prismatic", "revolute"}


def test_a_part_thrown_elsewhere_is_on_no_cylinder():
    points, _, motions = chair()
    for throw in ([0.3, 0.2, 0.9, 0.3, 0.2, 0.5], [0.0, 1.0, 0.3, 0.7, 0, 0], [0.02, 0.3, 0.1, 0, 1.1, 0.4]):
        thrown = torch.stack([torch.eye(4).double(), se3_exp(torch.tensor(throw).double())])
        tree = infer_tree(points, {1: motions[1], 2: motions[2], 3: thrown}, root=1)
        assert edges(tree) == {(1, 2)} and list(tree.unattached) == [3], throw


@pytest.mark.parametrize("height, hung", [(0.9, True), (1.2, False)])
def test_what_turns_and_slides_about_a_part_s_line_must_be_in_touch(height, hung):
    points, _, motions = chair()
    tree = infer_tree({1: points[1], 2: box((0.1, 0, height), (0.8, 0.7, 0.1), 2)}, {1: motions[1], 2: motions[2]})
    assert bool(tree.joints) == hung and bool(tree.unattached) != hung


@pytest.mark.parametrize("turn", [-math.pi / 2, math.pi / 2])
def test_a_die_that_rolled_over_a_plate_hangs_on_it_only_if_told(turn):
    """It lies on the plate in both states, but turned about a line above it, or below."""
    points = {1: box((0, 0, -0.05), (1.6, 1.6, 0.1), 1), 2: box((0.3, 0.4, 0.1), (0.2, 0.2, 0.2), 2)}
    before, after = torch.tensor([[0.3, 0.4, 0.1], [-0.3, -0.4, 0.1]], dtype=torch.float64)
    R = so3_exp(torch.tensor([turn, 0, 0], dtype=torch.float64))
    rolled = from_rotation_translation(R, after - R @ before)
    still = torch.eye(4, dtype=torch.float64)
    motions = {1: torch.stack([still, still]), 2: torch.stack([still, rolled])}
    tree = infer_tree(points, motions)
    assert not tree.joints and tree.unattached
    told = [JointConstraint(1, 2)]
    (joint,) = infer_tree(points, motions, constraints=told).joints
    assert joint.fit.type == "cylindrical" and joint.fit.residual < 1e-9
    told.append(JointConstraint(1, 2, "cylindrical", forbidden=True))
    (joint,) = infer_tree(points, motions, constraints=told).joints
    assert joint.fit.type == "free"


def test_the_user_may_rule_the_cylinder_out():
    points, _, motions = chair()
    told = [JointConstraint(1, 2, "cylindrical", forbidden=True)]
    tree = infer_tree(points, motions, root=1, constraints=told)
    assert {j.fit.type for j in tree.joints} == {"free", "revolute"} and tree.unattached


def test_of_more_states_the_cylinder_is_no_guess():
    points, truth, motions = chair(4)
    tree = infer_tree(points, motions)
    assert edges(tree) == edges(truth)
    fit = next(j.fit for j in tree.joints if j.child == 2)
    assert fit.type == "cylindrical" and not fit.ambiguous and not fit.undetermined


def test_a_linkage_closes_beside_a_joint_of_two_freedoms():
    points, motions = four_bar([0.6, 1.2, 2.0, 2.9])
    slide = true_joint(1, 5, "cylindrical", X, (1.5, 0, 0))
    points[5] = rod((1.2, 0, 0), (1.8, 0, 0), 0.4, 5)
    values = torch.tensor([[0, 0], [0.2, 0.5], [-0.3, 0.9], [0.1, -0.4]], dtype=torch.float64)
    motions[5] = slide.fit.motion(values)
    tree = infer_tree(points, motions, root=1)
    assert len(tree.joints) == 4 and len(tree.loops) == 1
    assert next(j.fit.type for j in tree.joints if j.child == 5) == "cylindrical"
