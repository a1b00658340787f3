import itertools
import math

import pytest
import torch
from tree_scene import X, Y, Z, box, edges, four_bar, motions_of, rod, true_joint

from splatart_ns.errors import InputError
from splatart_ns.geometry.se3 import from_rotation_translation, inverse, se3_exp, so3_exp, transform_points, translation
from splatart_ns.stages.articulate import KinematicTree, forward_kinematics
from splatart_ns.stages.contact import find_contacts
from splatart_ns.stages.joint import NOISE
from splatart_ns.stages.joint_constraint import JointConstraint
from splatart_ns.stages.joint_pairs import fit_pairs, surface_error
from splatart_ns.stages.tree import _free_groups, choose_root, infer_tree, object_radius


def arm():
    """Seven turning joints in a row and two sliding fingers, as a robot arm has them."""
    places = [
        (0, 0, 0),
        (0, 0, 0.3),
        (0.1, 0, 0.6),
        (0.1, 0, 0.9),
        (0.35, 0, 1.0),
        (0.6, 0, 1.0),
        (0.7, 0, 0.8),
        (0.7, 0, 0.6),
    ]
    axes = [(0, 0, 1), (0, 1, 0), (0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    points = {1: box((0, 0, -0.1), (0.3, 0.3, 0.2), 1)}
    for k in range(7):
        points[k + 2] = rod(places[k], places[k + 1], 0.1, k + 2)
    points[8] = torch.cat([points[8], box((0.7, 0, 0.57), (0.06, 0.25, 0.06), 20)])
    for part, side in ((9, 1), (10, -1)):
        points[part] = box((0.7, 0.06 * side, 0.5), (0.03, 0.02, 0.09), part)
    joints = [true_joint(k + 1, k + 2, "revolute", axes[k], places[k]) for k in range(7)]
    joints += [true_joint(8, part, "prismatic", (0, side, 0), (0.7, 0, 0.5)) for part, side in ((9, 1), (10, -1))]
    return points, KinematicTree(sorted(points), 1, joints)


ARM_CHANGE = [0.5, 0.45, -0.4, 0.55, -0.5, 0.5, 0.7, 0.05, 0.04]


@pytest.mark.parametrize("seed", [0, 1])
def test_an_arm_of_seven_turns_and_two_slides_from_two_noisy_states(seed):
    points, truth = arm()
    q = torch.tensor([[0.0] * 9, ARM_CHANGE], dtype=torch.float64)
    radius = object_radius(points)
    motions = motions_of(truth, q, points, seed, math.radians(0.3), 0.003 * radius)
    tree = infer_tree(points, motions)
    assert tree.root == 1 and edges(tree) == edges(truth)
    assert {j.child: j.fit.type for j in tree.joints} == {j.child: j.fit.type for j in truth.joints}
    assert not tree.loops and not tree.unattached
    # Contact was needed: some false pair moves like a joint, too.
    assert tree.rejected
    for joint in tree.joints:
        true = next(j for j in truth.joints if j.child == joint.child)
        if joint.fit.type == "revolute":
            assert float((joint.fit.axis @ true.fit.axis).abs()) > math.cos(math.radians(4))
        assert abs(float(joint.fit.values[1])) == pytest.approx(abs(ARM_CHANGE[joint.child - 2]), abs=0.03)


def test_two_states_leave_a_planar_chain_to_contact():
    """With parallel axes any two links move like a joint; only touch tells which are neighbours."""
    points = {k: rod((k, 0, 0), (k + 1, 0, 0), 0.1, k) for k in range(1, 7)}
    joints = [true_joint(k, k + 1, "revolute", Z, (k + 1, 0, 0)) for k in range(1, 6)]
    truth = KinematicTree(sorted(points), 1, joints)
    q = torch.tensor([[0, 0, 0, 0, 0], [0.4, 0.5, 0.3, 0.2, 0.3]], dtype=torch.float64)
    motions = motions_of(truth, q)
    fits = fit_pairs(points, motions, object_radius(points))
    assert all(f.residual < 1e-9 and f.type == "revolute" for f in fits.values())
    tree = infer_tree(points, motions, root=1)
    assert edges(tree) == edges(truth) and not tree.loops
    assert {(1, 3), (2, 4)} <= {(j.parent, j.child) for j in tree.rejected}
    assert not {(1, 6), (1, 5)} & {(j.parent, j.child) for j in tree.rejected}  # too far apart


def test_parts_far_apart_are_joined_by_the_user_alone():
    """A seat that turns and slides on its column moves as about a hinge of a castor that rolled as far as it slid."""
    points = {
        1: box((0, 0, 0), (0.4, 0.4, 0.4), 1),
        2: box((0.3, 0, 0), (0.2, 0.2, 0.2), 2),
        3: box((-1.2, 0, 0), (0.3, 0.3, 0.3), 3),
    }
    seat = true_joint(2, 3, "revolute", Z, (-1.2, 0, 0))
    truth = KinematicTree([1, 2, 3], 1, [true_joint(1, 2, "prismatic", Z, (0, 0, 0)), seat])
    motions = motions_of(truth, torch.tensor([[0, 0], [0.2, 0.7]], dtype=torch.float64))
    assert fit_pairs(points, motions, object_radius(points))[2, 3].accepted
    names = {1: "column", 2: "castor", 3: "seat"}
    tree = infer_tree(points, motions, root=1, names=names)
    assert edges(tree) == {(1, 2)} and tree.unattached[3].startswith("No joint explains how seat moves: the best, ")
    assert any(f" on {name}, leaves" in tree.unattached[3] for name in ("column", "castor"))
    assert edges(infer_tree(points, motions, root=1, constraints=[JointConstraint(2, 3)])) == edges(truth)
    other = JointConstraint(2, 3, "prismatic", forbidden=True)
    assert edges(infer_tree(points, motions, root=1, constraints=[other])) == {(1, 2)}


def test_a_part_that_moves_as_by_a_joint_far_away_is_told_how_to_be_hung_there():
    """A hook on a cable too thin to be seen."""
    points = {1: box((0, 0, 0), (0.4, 0.4, 0.4), 1), 2: box((0, 0, -1.2), (0.4, 0.4, 0.4), 2)}
    truth = KinematicTree([1, 2], 1, [true_joint(1, 2, "prismatic", Z, (0, 0, 0))])
    motions = motions_of(truth, torch.tensor([[0], [-0.3]], dtype=torch.float64))
    tree = infer_tree(points, motions, root=1, names={1: "trolley", 2: "hook"})
    gap = find_contacts(points, motions)[1, 2].gap / object_radius(points)
    assert not tree.joints and tree.unattached == {
        2: f"hook moves as by a joint on trolley, but is {gap:.0%} of the object's radius away from it: "
        "--joint 'hook:trolley' hangs it there."
    }
    assert edges(infer_tree(points, motions, root=1, constraints=[JointConstraint(1, 2)])) == {(1, 2)}


def drawers(states):
    points = {
        1: torch.cat(
            [box((0, y, 0), (1, 0.05, 2), k) for k, y in enumerate((-0.5, 0.5))] + [box((0, 0, 0), (1, 1, 0.05), 8)]
        ),
        2: box((0, 0, 0.5), (0.95, 0.9, 0.9), 5),
        3: box((0, 0, -0.5), (0.95, 0.9, 0.9), 6),
    }
    truth = KinematicTree([1, 2, 3], 1, [true_joint(1, k, "prismatic", X, (0, 0, 0)) for k in (2, 3)])
    return points, truth, torch.tensor([[0.0, 0.0], [0.5, 0.2], [0.1, 0.6], [0.3, 0.0]], dtype=torch.float64)[:states]


@pytest.mark.parametrize("states", [2, 4])
def test_two_drawers_hang_on_the_body_and_close_no_loop(states):
    """They slide along each other, side by side, in every configuration."""
    points, truth, q = drawers(states)
    tree = infer_tree(points, motions_of(truth, q))
    assert edges(tree) == {(1, 2), (1, 3)} and all(j.fit.type == "prismatic" for j in tree.joints)
    assert not tree.loops and [{j.parent, j.child} for j in tree.rejected] == [{2, 3}]


def test_levers_that_turned_alike_from_one_state_to_another_close_no_loop():
    """One slides along the other then, but it would not if they had turned otherwise."""
    pins = [box((x, 0, 0), (0.12, 0.12, 0.5), k) for k, x in enumerate((-0.3, 0.3))]
    points = {
        1: torch.cat([*pins, box((0, 0, -0.3), (1.6, 1, 0.1), 4)]),
        2: box((0.1, 0, -0.05), (0.8, 0.3, 0.12), 5, count=1000),
        3: box((-0.1, 0, 0.05), (0.8, 0.3, 0.12), 6, count=1000),
    }
    joints = [true_joint(1, k, "revolute", Z, (x, 0, 0)) for k, x in ((2, -0.3), (3, 0.3))]
    motions = motions_of(KinematicTree([1, 2, 3], 1, joints), torch.tensor([[0, 0], [0.3, 0.3]]).double())
    tree = infer_tree(points, motions, root=1)
    assert edges(tree) == {(1, 2), (1, 3)} and not tree.loops
    assert [j.fit.type for j in tree.rejected] == ["prismatic"]


@pytest.mark.parametrize("states", [2, 3])
def test_doors_above_each_other_hang_on_the_body_even_if_nearer_to_each_other(states):
    """They turn about one line, so that the lower could hang on the upper as well."""
    points = {
        1: box((0.46, 0.5, 0), (0.8, 0.04, 2), 1, count=2000),
        2: box((0, 0.04, 0.5), (0.05, 0.9, 1), 5, count=2000),
        3: box((0, 0.04, -0.5), (0.05, 0.9, 1), 6, count=2000),
    }
    truth = KinematicTree([1, 2, 3], 1, [true_joint(1, k, "revolute", Z, (0, 0.49, 0)) for k in (2, 3)])
    q = torch.tensor([[0.0, 0.0], [0.5, 0.6], [0.9, 0.8]], dtype=torch.float64)[:states]
    contacts = find_contacts(points, motions_of(truth, q))
    assert contacts[2, 3].gap < contacts[1, 3].gap
    assert edges(infer_tree(points, motions_of(truth, q))) == {(1, 2), (1, 3)}


def test_a_hinge_elsewhere_than_its_parents_hangs_on_it():
    """The second half of a folding door turns about a line beside that of the first."""
    points = {
        1: box((0.3, 0, 0), (0.6, 1.2, 2), 1),
        2: box((-0.05, 0.35, 0), (0.04, 0.5, 1.9), 2),
        3: box((-0.05, -0.15, 0), (0.04, 0.5, 1.9), 3),
    }
    joints = [true_joint(1, 2, "revolute", Z, (-0.05, 0.6, 0)), true_joint(2, 3, "revolute", Z, (-0.05, 0.1, 0))]
    truth = KinematicTree([1, 2, 3], 1, joints)
    q = torch.tensor([[0.0, 0.0], [-0.7, 1.2]], dtype=torch.float64)
    assert edges(infer_tree(points, motions_of(truth, q))) == {(1, 2), (2, 3)}


@pytest.mark.parametrize(
    ("states", "images", "of_errors", "of_weights"),
    [(2, True, 0.1, 0.3), (4, True, 0.1, 0.3 / 9), (4, False, 1.0, 1.0)],
)
def test_points_count_for_less_beside_images_least_where_many_motions_are_weighed(
    monkeypatch, states, images, of_errors, of_weights
):
    told = {}

    def watched(tree, points, motions, errors, weighed_by):
        told.update(errors=errors, weighed_by=weighed_by)
        return tree

    monkeypatch.setattr("splatart_ns.stages.tree.refine_tree", watched)
    points, truth, q = drawers(states)
    motions = motions_of(truth, q)
    seen = 1e-10 * torch.eye(6, dtype=torch.float64).repeat(states, 1, 1)
    infer_tree(points, motions, covariances={p: seen for p in points} if images else None)
    for name, share in (("errors", of_errors), ("weighed_by", of_weights)):
        noise = surface_error(points[2].double(), motions[2].double(), share * NOISE, object_radius(points))
        torch.testing.assert_close(told[name][2], noise + seen if images else noise)


def test_more_states_reject_more_false_pairs():
    points, truth = arm()
    generator = torch.Generator().manual_seed(3)
    factors = 3 * torch.rand(4, 9, generator=generator, dtype=torch.float64) - 1.5
    q = torch.cat([torch.zeros(1, 9, dtype=torch.float64), factors * torch.tensor(ARM_CHANGE, dtype=torch.float64)])
    radius = object_radius(points)
    noise = {"points": points, "rotation": math.radians(0.3), "translation": 0.003 * radius}
    five, two = (infer_tree(points, motions_of(truth, q[:n], **noise)) for n in (5, 2))
    assert edges(five) == edges(truth) and len(five.rejected) < len(two.rejected)


def test_a_linkage_has_a_tree_and_one_loop():
    tree = infer_tree(*four_bar([0.6, 1.2, 2.0, 2.9]))
    ring = [{1, 2}, {2, 3}, {3, 4}, {1, 4}]
    assert tree.root == 1 and len(tree.joints) == 3 and len(tree.loops) == 1
    assert all({j.parent, j.child} in ring for j in tree.joints + tree.loops)


def test_a_part_that_no_joint_explains_is_left_out_with_the_reason():
    points, truth, q = drawers(2)
    motions = motions_of(truth, q)
    points[7] = box((0, 3, 0), (0.5, 0.5, 0.5), 9)
    thrown = se3_exp(torch.tensor([0.2, 0.1, 1.5, 0, 0, 1.0], dtype=torch.float64))
    motions[7] = torch.stack([torch.eye(4, dtype=torch.float64), thrown])
    tree = infer_tree(points, motions, root=1)
    assert edges(tree) == {(1, 2), (1, 3)} and list(tree.unattached) == [7]
    assert "part 7" in tree.unattached[7] and "of the object's radius" in tree.unattached[7]


def test_parts_that_stay_together_are_fixed():
    points = {1: box((0, 0, 0), (1, 1, 1), 1), 2: box((0, 0, 0.6), (1, 1, 0.2), 2)}
    still = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    tree = infer_tree(points, {1: still, 2: still})
    assert edges(tree) == {(1, 2)} and tree.joints[0].fit.type == "fixed" and not tree.movable


def test_the_root_is_the_largest_part_that_stood_still():
    points = {1: box((0, 0, 0), (0.2, 0.2, 0.2), 1), 2: box((0, 0, 1), (2, 2, 1), 2), 3: box((0, 0, 2), (5, 5, 1), 3)}
    still = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    moved = still.clone()
    moved[1, 0, 3] = 2.0
    assert choose_root(points, {1: still, 2: still, 3: moved}, 3.0) == 2
    nudged = still.clone()
    nudged[1, 0, 3] = 1.0
    assert choose_root(points, {1: nudged, 2: moved, 3: moved}, 3.0) == 1


def test_the_given_root_decides_which_way_joints_point():
    points, truth, q = drawers(2)
    motions = motions_of(truth, q)
    tree = infer_tree(points, motions, root=2)
    assert edges(tree) == {(2, 1), (1, 3)}
    # Whatever the root, the tree reproduces the relative motions it was fitted to.
    T = dict(
        zip(tree.part_ids, forward_kinematics(tree, tree.observed(), root_motion=motions[2]).unbind(1), strict=True)
    )
    for part in points:
        assert torch.allclose(
            transform_points(T[part], points[part]), transform_points(motions[part], points[part]), atol=1e-9
        )


def test_a_single_part_is_its_own_tree():
    tree = infer_tree({3: box((0, 0, 0), (1, 1, 1), 0)}, {3: torch.eye(4).repeat(2, 1, 1)})
    assert tree.root == 3 and tree.joints == [] and tree.observed().shape == (1, 0)


def test_rendering_ratios_and_covariances_reach_the_fits():
    points, truth, q = drawers(2)
    motions = motions_of(truth, q)
    turned = fit_pairs(points, motions, 1.0, render_ratios={(2, 1): 5.0})
    assert turned[1, 2].type == turned[2, 1].type == "revolute" and turned[1, 3].type == "prismatic"
    loose = {p: torch.eye(6, dtype=torch.float64).repeat(2, 1, 1) for p in points}
    assert fit_pairs(points, motions, 1.0, covariances=loose)[1, 2].type == "fixed"
    assert set(find_contacts(points, motions)) == {(1, 2), (1, 3), (2, 3)}


def test_a_part_that_stood_still_lends_its_joint_no_error():
    """A blade turned about a hinge far from the origin, and seems to have slid by its own uncertainty; a turn of its
    parent, which stood still, would explain the slide as a tilt."""
    generator = torch.Generator().manual_seed(0)
    points = {p: X + torch.rand(200, 3, generator=generator, dtype=torch.float64) * 0.1 for p in (1, 2)}
    eye = torch.eye(4, dtype=torch.float64)
    hinge = from_rotation_translation(eye[:3, :3], X)
    turned = hinge @ from_rotation_translation(so3_exp(0.8 * Z), 1e-3 * Z) @ inverse(hinge)
    motions = {1: torch.stack([eye, eye]), 2: torch.stack([eye, turned])}
    sigmas = {1: [1e-3] * 3 + [0.1] * 3, 2: [1e-3] * 3 + [1e-4] * 3}
    covariances = {p: (torch.tensor(s).double() ** 2).diag().repeat(2, 1, 1) for p, s in sigmas.items()}
    fits = fit_pairs(points, motions, 1.0, covariances=covariances, noise=1e-5, types=["revolute"])
    for fit in fits.values():
        assert math.degrees(math.asin(float(torch.linalg.vector_norm(fit.axis[:2])))) < 0.01


def test_a_joint_is_no_surer_than_what_it_hangs_on():
    points = {p: box((0.7 * p, 0, 0), (0.5, 0.4, 0.3), p) for p in (1, 2, 3)}
    truth = KinematicTree([1, 2, 3], 1, [true_joint(k, k + 1, "revolute", Z, (0.7 * k, 0, 0)) for k in (1, 2)])
    motions = motions_of(truth, torch.tensor([[0, 0], [0.7, 0.5]]).double())

    def deviation(of_parent):
        sigmas = {1: 1e-4, 2: of_parent, 3: 1e-4}
        covariances = {p: sigma**2 * torch.eye(6).double().repeat(2, 1, 1) for p, sigma in sigmas.items()}
        fit = fit_pairs(points, motions, 1.0, covariances=covariances, noise=1e-5, types=["revolute"])[2, 3]
        return fit.covariance["values"][1][1] ** 0.5

    assert deviation(1e-2) > 0.5e-2 > 10 * deviation(1e-4)


def test_parts_that_hang_together_but_on_nothing_else_are_carried_by_a_free_joint():
    """Scissors thrown across the room: how they open is not lost, and that no joint explains the throw is said."""
    points, truth, q = drawers(4)
    motions = motions_of(truth, q)
    points |= {7: rod((0, 3, 0), (1, 3, 0), 0.1, 9), 8: rod((0, 3, 0), (-1, 3.2, 0), 0.1, 10)}
    throws = torch.randn(3, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    motions[7] = torch.cat([torch.eye(4).double()[None], se3_exp(throws)])
    hinge = true_joint(7, 8, "revolute", Z, (0, 3, 0)).fit.motion(torch.tensor([0.0, 0.4, -0.3, 0.8]).double())
    motions[8] = motions[7] @ hinge
    tree = infer_tree(points, motions, root=1)
    (base,) = tree.unattached
    other = {7: 8, 8: 7}[base]
    assert edges(tree) == {(1, 2), (1, 3), (1, base), (base, other)}
    assert {j.child: j.fit.type for j in tree.joints if j.child > 3} == {base: "free", other: "revolute"}
    assert f"No joint explains how part {base} moves" in tree.unattached[base]
    assert f"on part {other}, leaves" not in tree.unattached[base]  # it hangs on the base itself
    assert tree.observed().shape == (4, 1 + 1 + 6 + 1)
    T = forward_kinematics(tree, tree.observed(), root_motion=motions[1])
    for k, part in enumerate(tree.part_ids):
        assert torch.allclose(T[:, k], motions[part], atol=1e-9)


def test_what_hangs_on_the_root_joins_no_group_that_no_joint_explains():
    """Part 3 hangs on the root, but nothing on it, as of one that state 0 hides; part 2 seems jointed to it."""
    points = {p: box((0.3 * p, 0, 0), (0.3, 0.3, 0.3), p) for p in (1, 2, 3)}
    hinge = true_joint(1, 3, "revolute", Z, (0.75, 0, 0)).fit
    still = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    motions = {
        1: still,
        2: hinge.motion(torch.tensor([0.0, 0.9]).double()),
        3: hinge.motion(torch.tensor([0.0, 0.4]).double()),
    }
    joints = {(1, 3): hinge, (2, 3): hinge}
    contacts = find_contacts(points, motions, {(1, 3), (2, 3)})
    assert _free_groups(points, motions, joints, contacts, 1, 1.0, {}) == {}


def test_two_hinges_in_a_row_are_not_one_ball_joint():
    """A wrist of three concurrent axes: across two hinges the hand moves as about a ball, and the tree has hinges."""
    points = {k: rod(*ends, 0.1, k) for k, ends in {1: ((-1, 0, 0), (0, 0, 0)), 3: ((0, 0, 0), (1, 0, 0))}.items()}
    points[2] = box((0, 0, 0), (0.15, 0.15, 0.15), 2)
    joints = [true_joint(1, 2, "revolute", Z, (0, 0, 0)), true_joint(2, 3, "revolute", Y, (0, 0, 0))]
    q = torch.tensor([[0, 0], [0.5, 0.6], [-0.4, 0.9], [0.8, -0.5], [-0.6, -0.7]], dtype=torch.float64)
    truth = KinematicTree([1, 2, 3], 1, joints)
    motions = motions_of(truth, q)
    assert fit_pairs(points, motions, 1.0)[1, 3].type == "spherical"
    tree = infer_tree(points, motions, root=1)
    assert edges(tree) == edges(truth) and {j.fit.type for j in tree.joints} == {"revolute"}
    assert [(j.parent, j.child) for j in tree.rejected] == [(1, 3)] and not tree.loops


def test_the_user_decides_what_hangs_on_what():
    points, truth, q = drawers(4)
    motions = motions_of(truth, q)
    assert edges(infer_tree(points, motions)) == {(1, 2), (1, 3)}
    tree = infer_tree(points, motions, constraints=[JointConstraint(2, 3)])
    assert edges(tree) == {(1, 2), (2, 3)}
    excluded = [JointConstraint(1, 3, forbidden=True), JointConstraint(1, 3, "screw", forbidden=True)]
    tree = infer_tree(points, motions, constraints=excluded)
    assert edges(tree) == {(1, 2), (2, 3)}
    # The root that would be chosen is somebody's child now.
    tree = infer_tree(points, motions, constraints=[JointConstraint(2, 1)])
    assert tree.root != 1 and (2, 1) in edges(tree) and len(tree.joints) == 2
    with pytest.raises(InputError, match="hangs the root"):
        infer_tree(points, motions, root=1, constraints=[JointConstraint(2, 1)])
    with pytest.raises(InputError, match="part 9"):
        infer_tree(points, motions, constraints=[JointConstraint(1, 9)])
    with pytest.raises(InputError, match="--joint: handle has no Gaussians"):
        infer_tree(points, motions, constraints=[JointConstraint(1, 9)], names={1: "body", 9: "handle"})


@pytest.mark.parametrize("kind", ["fixed", "revolute", "screw", "cylindrical", "spherical", "free"])
def test_the_user_decides_of_which_type_a_joint_is(kind):
    points, truth, q = drawers(4)
    tree = infer_tree(points, motions_of(truth, q), constraints=[JointConstraint(1, 3, kind)])
    assert {j.child: j.fit.type for j in tree.joints} == {2: "prismatic", 3: kind} and not tree.unattached


def test_a_type_that_explains_the_motion_far_worse_than_another_is_told():
    points = {1: box((0, 0, 0), (1, 1, 0.2), 1), 2: box((0, 0, 0.15), (1, 1, 0.1), 2)}
    truth = KinematicTree([1, 2], 1, [true_joint(1, 2, "revolute", X, (0, -0.5, 0.1))])
    motions, names = motions_of(truth, torch.tensor([[0.0], [1.2]]).double()), {1: "base", 2: "lid"}
    tree = infer_tree(points, motions, root=1, constraints=[JointConstraint(1, 2, "prismatic")], names=names)
    assert [j.fit.type for j in tree.joints] == ["prismatic"]
    left = tree.joints[0].fit.residual / object_radius(points)
    assert tree.contradicted == {
        2: f"--joint 'lid:base=prismatic' leaves {left:.1%} of the object's radius unexplained; revolute would leave "
        "0.0%."
    }
    for told in (JointConstraint(1, 2, "revolute"), JointConstraint(1, 2, "free"), JointConstraint(1, 2)):
        assert not infer_tree(points, motions, root=1, constraints=[told]).contradicted


def test_ids_that_may_be_exchanged_in_a_state_are_told_where_no_joint_explains_them():
    points, truth, q = drawers(2)
    motions = motions_of(truth, q)
    assert not infer_tree(points, motions).unattached
    throw = se3_exp(torch.tensor([0.0, 0, 0, 0.3, 0.4, -0.5]).double())
    for part, other in ((2, 3), (3, 2)):
        about = [translation(points[p].mean(0)) for p in (other, part)]
        motions[part] = torch.stack([torch.eye(4).double(), about[0] @ throw @ inverse(about[1])])
    tree = infer_tree(points, motions, root=1, names={1: "body", 2: "upper", 3: "lower"})
    assert tree.unattached[2].endswith("it lies where lower was, and lower where it was: are their ids exchanged?")


def test_a_type_can_be_excluded():
    points, truth, q = drawers(4)
    excluded = JointConstraint(1, 3, "prismatic", forbidden=True)
    tree = infer_tree(points, motions_of(truth, q), constraints=[JointConstraint(1, 3), excluded])
    (joint,) = (j for j in tree.joints if j.child == 3)
    assert joint.parent == 1 and joint.fit.type == "cylindrical" and joint.fit.residual < 1e-3


def hinged_lid(angle: float):
    """A lid on a box, and its motion about the box's edge."""
    points = {1: box((0, 0, 0), (1, 1, 0.2), 1), 2: box((0, 0, 0.15), (1, 1, 0.1), 2)}
    truth = KinematicTree([1, 2], 1, [true_joint(1, 2, "revolute", X, (0, -0.5, 0.1))])
    return points, motions_of(truth, torch.tensor([[0.0], [angle]]).double())


@pytest.mark.parametrize("kinds", list(itertools.permutations(["revolute", "prismatic", "fixed"])))
def test_types_that_are_excluded_one_by_one_are_all_excluded(kinds):
    points, motions = hinged_lid(1.2)
    for count in (1, 2, 3):
        excluded = [JointConstraint(1, 2, kind, forbidden=True) for kind in kinds[:count]]
        for told in ([], [JointConstraint(1, 2)]):
            tree = infer_tree(points, motions, root=1, constraints=[*excluded, *told])
            assert not {j.fit.type for j in tree.joints} & set(kinds[:count])
            assert len(tree.joints) == 1 or not told


@pytest.mark.parametrize("kind", ["revolute", "prismatic", "screw", "cylindrical"])
def test_the_axis_of_a_joint_that_did_not_move_is_not_known_whatever_its_type(kind):
    points, motions = hinged_lid(0.0)
    tree = infer_tree(points, motions, root=1, constraints=[JointConstraint(1, 2, kind)])
    axis = torch.tensor(tree.joints[0].fit.covariance["axis"], dtype=torch.float64)
    assert float(torch.linalg.eigvalsh(axis)[-1]) > math.pi**2


def test_a_required_joint_that_nothing_explains_is_free():
    points, truth, q = drawers(4)
    motions = motions_of(truth, q)
    throws = torch.randn(3, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    motions[3] = torch.cat([torch.eye(4).double()[None], se3_exp(throws)])
    assert list(infer_tree(points, motions).unattached) == [3]
    tree = infer_tree(points, motions, constraints=[JointConstraint(1, 3)])
    assert {j.child: j.fit.type for j in tree.joints} == {2: "prismatic", 3: "free"} and not tree.unattached


@pytest.mark.parametrize("x", [0.17, 0.14])
def test_knobs_beside_each_other_hang_on_the_panel_behind_them(x):
    """Only their faces are seen, and the panel not behind them; the relative motion turns about a line between them."""
    centres = {2: torch.tensor([-x, 0, 0.06]).double(), 3: torch.tensor([x, 0, 0.06]).double()}
    panel = box((0, 0, 0), (1.6, 1.2, 0), seed=0, count=4000)
    hidden = torch.stack([torch.linalg.vector_norm((panel - c)[:, :2], dim=-1) < 0.15 for c in centres.values()])
    points = {1: panel[~hidden.any(0)]}
    for part, centre in centres.items():
        face = box((0, 0, 0.05), (0.24, 0.24, 0.1), seed=part, count=1500)
        points[part] = centre + face[torch.linalg.vector_norm(face[:, :2], dim=-1) < 0.12]
    truth = KinematicTree([1, 2, 3], 1, [true_joint(1, p, "revolute", Z, c) for p, c in centres.items()])
    motions = motions_of(truth, torch.tensor([[0.0, 0.0], [-0.6, 0.6]]))
    assert edges(infer_tree(points, motions)) == {(1, 2), (1, 3)}


def test_a_thin_part_that_images_show_turning_about_its_length_turns():
    points = {1: box((0, 0, -0.5), (2, 2, 1), seed=0), 2: rod((0, 0, 0), (0, 0, 0.3), 0.06, seed=1)}
    truth = KinematicTree([1, 2], 1, [true_joint(1, 2, "revolute", Z, torch.zeros(3))])
    motions = motions_of(truth, torch.tensor([[0.0], [math.radians(21)]]))
    seen = torch.diag(torch.tensor([1e-4] * 3 + [2e-3] * 3).double() ** 2).repeat(2, 1, 1)
    (joint,) = infer_tree(points, motions, covariances={1: 0 * seen, 2: seen}).joints
    assert joint.fit.type == "revolute"
    assert abs(float(joint.fit.values[1])) == pytest.approx(math.radians(21), abs=1e-3)


@pytest.mark.parametrize(("sigma", "doubted"), [(1e-4, True), (1e-2, False)])
def test_a_joint_that_leaves_more_than_the_poses_uncertainty_explains_is_in_doubt(sigma, doubted):
    points = {1: box((0, 0, 0), (1, 1, 1), 1), 2: box((0, 0, 0.75), (0.5, 0.5, 0.5), 2)}
    turned = se3_exp(torch.cat([0.012 * Z, 0.5 * Z]))  # that much along the axis no hinge lets it go
    motions = {1: torch.eye(4).double().repeat(2, 1, 1), 2: torch.stack([torch.eye(4).double(), turned])}
    covariances = {p: sigma**2 * torch.eye(6).double().repeat(2, 1, 1) for p in points}
    (joint,) = infer_tree(points, motions, covariances=covariances, root=1).joints
    assert joint.fit.type == "revolute" and joint.fit.ambiguous == doubted
