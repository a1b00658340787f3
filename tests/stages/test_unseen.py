import math

import pytest
import torch
from part_scene import box, motion

from splatart_ns.errors import InputError
from splatart_ns.geometry.se3 import inverse, transform_points
from splatart_ns.stages.joint_constraint import JointConstraint
from splatart_ns.stages.joint_pairs import fit_pairs
from splatart_ns.stages.tree import infer_tree
from splatart_ns.stages.unseen import place_unseen, relative_motion

EYE = torch.eye(4, dtype=torch.float64)
YES = torch.ones(3, dtype=torch.bool)
LID = (1, 1, 0.1), (0, 0, 0.55)
HIDDEN_FIRST = torch.tensor([False, True, True])


def about(T: torch.Tensor, at: tuple[float, float, float]) -> torch.Tensor:
    shift = motion((0, 0, 0), at)
    return shift @ T @ inverse(shift)


def scene(turntable: bool):
    """A foot, a body that may turn on it, a door and a drawer in the body; the drawer's motions count from state 1."""
    size = {
        1: ((1.2, 1.2, 0.06), -0.35),
        2: ((0.8, 0.8, 0.6), 0.0),
        3: ((0.04, 0.7, 0.5), 0.0),
        4: ((0.5, 0.5, 0.2), 0.0),
    }
    centre = {1: (0.0, 0.0), 2: (0.0, 0.0), 3: (0.43, 0.0), 4: (0.1, 0.0)}
    points = {p: box(1, s, (*centre[p], z)).means.double() for p, (s, z) in size.items()}
    body = torch.stack([EYE, *(motion((0, 0, a if turntable else 0), (0, 0, 0)) for a in (30, -20))])
    door = torch.stack([EYE, *(about(motion((0, 0, a), (0, 0, 0)), (0.43, 0.37, 0.0)) for a in (100, 60))])
    drawer = torch.stack([motion((0, 0, 0), (x, 0, 0)) for x in (0.0, 0.15, 0.4)])
    motions = {1: EYE.repeat(3, 1, 1), 2: body, 3: body @ door, 4: body @ drawer}
    motions[2] = body if turntable else EYE.repeat(3, 1, 1)
    # What the pose stage hands on: the drawer's points where they are at state 1, and motions since then.
    points[4] = transform_points(motions[4][1], points[4])
    motions[4] = torch.cat([EYE[None], motions[4][1:] @ inverse(motions[4][1])])
    covariances = {p: 1e-8 * torch.eye(6).double().repeat(3, 1, 1) for p in points}
    covariances[4][0] = torch.nan
    return points, motions, covariances


@pytest.mark.parametrize("turntable", [False, True])
def test_a_drawer_hidden_at_state_0_hangs_where_it_slides(turntable):
    points, motions, covariances = scene(turntable)
    tree = infer_tree(points, motions, covariances=covariances, root=1)
    joint = {j.child: j for j in tree.joints}[4]
    assert joint.fit.type == "prismatic"
    if turntable:
        assert joint.parent == 2
    assert abs(float(joint.fit.axis[0])) > 0.999
    assert torch.allclose(joint.fit.values.abs(), torch.tensor([0.0, 0.0, 0.25]).double(), atol=5e-3)


def test_what_is_not_seen_at_state_0_is_put_where_it_was_in_its_parent():
    points, motions, covariances = scene(turntable=True)
    tree = infer_tree(points, motions, covariances=covariances, root=1)
    known = {p: C.isfinite().flatten(1).all(-1) for p, C in covariances.items()}
    places, placed, _ = place_unseen(tree, motions, known)
    assert all(torch.equal(places[p], EYE) for p in (1, 2, 3))
    assert torch.equal(placed[4][0], EYE)
    for s in (1, 2):  # what is moved there is where it was seen
        assert torch.allclose(placed[4][s] @ places[4], motions[4][s], atol=1e-9)
    in_parent = transform_points(inverse(motions[2][1]), points[4])
    assert torch.allclose(transform_points(places[4], points[4]), in_parent, atol=1e-6)


def test_a_part_seen_in_one_state_alone_has_no_joint_that_is_sure():
    points, motions, covariances = scene(turntable=False)
    covariances[4][2], motions[4][2] = torch.nan, EYE
    tree = infer_tree(points, motions, covariances=covariances, root=1)
    fit = {j.child: j.fit for j in tree.joints}[4]
    assert fit.type == "fixed" and len(fit.undetermined) == 2


def hidden_after_state_0():
    """The scene's first two states; the drawer, in touch with the door, is not seen in the second."""
    points, motions, covariances = scene(turntable=False)
    points[4] = transform_points(motion((0, 0, 0), (-0.05, 0, 0)), points[4])
    motions = {p: T[:2] for p, T in motions.items()} | {4: EYE.repeat(2, 1, 1)}
    covariances = {p: C[:2].clone() for p, C in covariances.items()}
    covariances[4] = covariances[1].clone().index_fill(0, torch.tensor(1), torch.nan)
    return points, motions, covariances


def test_what_moved_does_not_hang_on_a_part_that_was_not_seen_when_it_did():
    points, motions, covariances = hidden_after_state_0()
    joints = {j.child: j for j in infer_tree(points, motions, covariances=covariances, root=1).joints}
    assert joints[3].parent != 4 and joints[3].fit.type == "revolute"
    assert joints[4].fit.type == "fixed" and joints[4].fit.ambiguous


def test_but_it_does_if_the_user_says_so():
    points, motions, covariances = hidden_after_state_0()
    told = [JointConstraint(4, 3)]
    tree = infer_tree(points, motions, covariances=covariances, root=1, constraints=told)
    assert {j.child: j.parent for j in tree.joints}[3] == 4


def test_a_part_that_a_state_hides_is_not_the_root_though_it_is_the_largest():
    points, motions, covariances = hidden_after_state_0()
    points[4] = 3 * points[4]
    assert infer_tree(points, motions, covariances=covariances).root in (1, 2)


def test_in_a_later_state_that_hides_a_part_it_moves_with_its_parent():
    a = torch.stack([EYE, motion((0, 0, 20), (0, 0, 0)), motion((0, 0, 50), (0.1, 0, 0))])
    slide = torch.stack([motion((0, 0, 0), (x, 0, 0)) for x in (0.0, 0.3, 0.1)])
    known = torch.tensor([True, True, False])
    b = a @ slide
    b[2] = EYE
    R, place, said = relative_motion(a, b, YES, known)
    assert torch.equal(place, EYE) and said.tolist() == [True, True, False]
    assert torch.allclose(R[1], slide[1]) and torch.equal(R[2], EYE)


@pytest.mark.parametrize("size", [1.0, 0.01])
def test_a_state_that_hides_a_part_admits_no_joint_that_explains_everything_whatever_the_unit(size):
    """The lid turned and slid, as a screw does, in the one state that shows it beside state 0; all show the rest."""
    boxes = {1: ((1, 1, 1), (0, 0, 0)), 2: LID, 3: ((1, 1, 0.1), (0, 0, -0.55))}
    points = {p: size * box(1, s, c).means.double() for p, (s, c) in boxes.items()}
    T = motion((0, 0, 70), (0.0, 0.0, 0.2))
    T[:3, 3] *= size
    motions = {1: EYE.repeat(3, 1, 1), 2: torch.stack([EYE, T, EYE]), 3: EYE.repeat(3, 1, 1)}
    certain = 1e-8 * torch.diag(torch.tensor([size**2] * 3 + [1.0] * 3)).double().repeat(3, 1, 1)
    covariances = {1: 0 * certain, 2: certain.clone(), 3: 0 * certain}
    covariances[2][2] = torch.nan
    fit = fit_pairs(points, motions, size, covariances=covariances)[1, 2]
    assert fit.type in ("fixed", "prismatic", "revolute") and not fit.accepted and fit.num_shown == 2
    assert list(infer_tree(points, motions, covariances=covariances, root=1).unattached) == [2]


@pytest.mark.parametrize("size", [1.0, 0.01])
def test_the_value_that_no_image_shows_is_unknown_whatever_the_unit_and_the_limits_are_of_the_others(size):
    points = {p: size * box(1, s, c).means.double() for p, (s, c) in {1: ((1, 1, 1), (0, 0, 0)), 2: LID}.items()}
    turn = about(motion((60, 0, 0), (0, 0, 0)), (0.0, -0.5, 0.5))
    turn[:3, 3] *= size
    motions = {1: EYE.repeat(3, 1, 1), 2: torch.stack([EYE, turn, EYE])}
    certain = 1e-8 * torch.diag(torch.tensor([size**2] * 3 + [1.0] * 3)).double().repeat(3, 1, 1)
    covariances = {1: 0 * certain, 2: certain.clone()}
    covariances[2][2] = torch.nan
    (joint,) = infer_tree(points, motions, covariances=covariances, root=1).joints
    sigma = torch.tensor(joint.fit.covariance["values"]).diagonal().sqrt()
    assert joint.fit.type == "revolute" and sigma[1] < 0.01 and sigma[2] > math.pi
    assert joint.fit.limits == pytest.approx((0, math.radians(60)), abs=0.01)
    covariances[2][1] = torch.nan
    told = [JointConstraint(1, 2, "revolute")]
    (joint,) = infer_tree(points, motions, covariances=covariances, root=1, constraints=told).joints
    assert joint.fit.limits == (-math.pi, math.pi)


def test_motions_that_are_all_known_are_only_compared():
    a = torch.stack([EYE, motion((0, 0, 20), (0, 0, 0)), motion((0, 0, 50), (0.1, 0, 0))])
    R, place, said = relative_motion(a, a @ motion((5, 0, 0), (0, 1, 0)), YES, YES)
    assert torch.equal(place, EYE) and said.all()
    assert torch.allclose(R, motion((5, 0, 0), (0, 1, 0)).expand(3, 4, 4))


def test_the_user_hangs_nothing_on_a_part_that_state_0_does_not_show():
    points, motions, covariances = scene(turntable=False)
    with pytest.raises(InputError, match="nothing can hang on tray, which state 0 does not show"):
        names = {1: "foot", 2: "body", 3: "door", 4: "tray"}
        told = [JointConstraint(4, 3)]
        infer_tree(points, motions, covariances=covariances, root=1, constraints=told, names=names)
