"""Of two parts that a third may hang on, both near to it, which is its parent."""

from dataclasses import replace

import pytest
import torch

from splatart_ns.stages.contact import Contact
from splatart_ns.stages.joint_fit import JointFit
from splatart_ns.stages.tree import build_tree

X, Y, Z = torch.eye(3, dtype=torch.float64)


def tree_found(joints: dict, gaps: dict, touching: torch.Tensor | None = None, required: dict | None = None):
    """Of parts 2 and 3 with these joints and gaps, one way round, on the root 1 and each other.

    `touching`: points [N, 3] that all parts have; by default the origin. `required`: parents by child.
    """
    touching = torch.zeros(2, 3).double() if touching is None else touching
    contacts = {pair: Contact(gap, touching, (touching, touching)) for pair, gap in gaps.items()}
    joints = joints | {(b, a): fit for (a, b), fit in joints.items()}
    return build_tree([1, 2, 3], joints, contacts, 1, 1.0, required)


def parents_found(*args) -> dict[int, int]:
    return {j.child: j.parent for j in tree_found(*args).joints}


@pytest.mark.parametrize(
    "kind, apart, closer, parent",
    [
        ("prismatic", 0.0, 0.07, 1),
        ("prismatic", 0.0, 0.15, 2),
        ("revolute", 0.0, 0.07, 1),
        ("revolute", 0.0, 0.15, 2),
        ("revolute", 0.2, 0.01, 1),
        ("revolute", 0.2, 0.05, 2),
    ],
)
def test_between_nearly_equal_parents_the_root_wins(kind, apart, closer, parent):
    """Part 3 moves against the root and against part 2, and is by `closer` radii nearer to part 2. Of slides along one
    way, and of hinges not `apart`, it takes more: two drawers, and two doors one above the other, show that they are
    neighbours, and not where they touch the body."""

    def move(values, y=0.0):
        return JointFit(kind, X, y * Y, 0.0, torch.tensor(values).double(), residual=0.0)

    joints = {(1, 2): move([0.0, 0.2]), (1, 3): move([0.0, 0.3], apart), (2, 3): move([0.0, 0.1])}
    gaps = {(1, 2): 0.02, (1, 3): 0.16, (2, 3): 0.16 - closer}
    on_both = torch.stack([0 * Y, apart * Y])
    assert parents_found(joints, gaps, on_both) == {2: 1, 3: parent}


@pytest.mark.parametrize("kind", ["prismatic", "revolute"])
@pytest.mark.parametrize(
    "residual, travel, parent",
    [(0.006, 0.2, 1), (0.0028, 0.2, 1), (0.0015, 0.2, 2), (0.002, 0.01, 1), (0.001, 0.01, 2)],
    ids=["nearly fixed", "hardly not fixed", "fixed", "two buttons", "fixed on a button"],
)
def test_of_two_that_moved_nearly_alike_none_hangs_on_the_other_but_a_handle_does(kind, residual, travel, parent):
    def move(value):
        held = [{"type": "fixed", "residual": value, "score": 1.0}]
        return JointFit(kind, X, 0 * X, 0.0, torch.tensor([0.0, value]).double(), residual=0.0, alternatives=held)

    fixed = JointFit("fixed", 0 * X, 0 * X, 0.0, torch.zeros(2).double(), residual=residual)
    joints = {(1, 2): move(travel), (1, 3): move(1.05 * travel), (2, 3): fixed}
    gaps = {(1, 2): 0.02, (1, 3): 0.09, (2, 3): 0.03}
    assert parents_found(joints, gaps) == {2: 1, 3: parent}


@pytest.mark.parametrize("aside, parent", [(0.0, 1), (0.003, 1), (0.006, 2)])
def test_of_two_drawers_that_slid_nearly_alike_none_slides_aside_on_the_other(aside, parent):
    def slide(x, y=0.0):
        way = torch.tensor([x, y, 0.0]).double()
        return JointFit("prismatic", way / way.norm(), 0 * X, 0.0, torch.stack([way[2], way.norm()]), residual=0)

    joints = {(1, 2): slide(0.4), (1, 3): slide(0.41, aside), (2, 3): slide(0.01, aside)}
    gaps = {(1, 2): 0.02, (1, 3): 0.09, (2, 3): 0.03}
    assert parents_found(joints, gaps) == {2: 1, 3: parent}


@pytest.mark.parametrize(
    "turns, parents", [((0.9, 1.8), {2: 1, 3: 2}), ((1.8, 0.9), {2: 3, 3: 1}), ((-0.9, 1.8), {2: 1, 3: 2})]
)
def test_of_three_in_a_row_about_one_pin_that_in_the_middle_turned_less_than_the_last(turns, parents):
    """A stapler's base, magazine and cover, of which contact tells next to nothing: here for the other order."""

    def turn(value):
        return JointFit("revolute", X, 0 * X, 0.0, torch.tensor([0.0, value]).double(), residual=0.0)

    joints = {(1, 2): turn(turns[0]), (1, 3): turn(turns[1]), (2, 3): turn(turns[1] - turns[0])}
    gaps = {(1, 2): 0.43, (1, 3): 0.43, (2, 3): 0.305}
    gaps[1, 2 if abs(turns[0]) > abs(turns[1]) else 3] -= 0.015
    assert parents_found(joints, gaps) == parents


@pytest.mark.parametrize("in_doubt, parent", [((2, 3), 1), ((3,), 2), ((2,), 2), ((), 2)])
def test_of_two_knobs_that_seem_to_rest_none_hangs_on_the_other_but_one_on_a_door_does(in_doubt, parent):
    """Part 3 is nearer to part 2 than to what is seen of the root; those `in_doubt` may have turned unseen."""

    def fixed(child):
        fit = JointFit("fixed", 0 * X, 0 * X, 0.0, torch.zeros(2).double(), residual=0.0)
        return replace(fit, ambiguous=child in in_doubt)

    joints = {(1, 2): fixed(2), (1, 3): fixed(3), (2, 3): fixed(3)}
    assert parents_found(joints, {(1, 2): 0.02, (1, 3): 0.12, (2, 3): 0.05}) == {2: 1, 3: parent}


@pytest.mark.parametrize(
    "axis, closer, parent",
    [(Y, 0.07, 1), (Y, 0.15, 2), (Z, 0.07, 2)],
    ids=["parallel", "parallel, much closer", "not parallel"],
)
def test_of_two_doors_that_turned_by_one_angle_none_slides_on_the_other(axis, closer, parent):
    turn = torch.tensor([0.0, 0.4]).double()
    joints = {
        (1, 2): JointFit("revolute", Y, 0 * X, 0.0, turn, residual=0.0),
        (1, 3): JointFit("revolute", axis, 0.3 * Z, 0.0, turn, residual=0.0),
        (2, 3): JointFit("prismatic", X, 0 * X, 0.0, 0.3 * turn, residual=0.0),
    }
    on_both = torch.stack([0 * Z, 0.3 * Z])
    gaps = {(1, 2): 0.02, (1, 3): 0.16, (2, 3): 0.16 - closer}
    assert parents_found(joints, gaps, on_both) == {2: 1, 3: parent}


def links(gaps):
    """Three links about parallel lines, 2 on the root 1, and 3 on either, by their gaps."""

    def turn(value, y):
        return JointFit("revolute", X, y * Y, 0.0, torch.tensor([0.0, value]).double(), residual=0.0)

    joints = {(1, 2): turn(0.2, 0.0), (1, 3): turn(0.5, 0.4), (2, 3): turn(0.3, 0.2)}
    return joints, dict(zip(((1, 2), (1, 3), (2, 3)), gaps, strict=True)), torch.stack([0 * Y, 0.2 * Y, 0.4 * Y])


def other_parents(tree):
    return {j.child: None if j.other is None else j.other.parent for j in tree.joints}


@pytest.mark.parametrize(
    "gaps, parent, others",
    [
        ((0.01, 0.2, 0.175), 2, {2: None, 3: 1}),
        ((0.01, 0.2, 0.185), 1, {2: None, 3: 2}),
        ((0.01, 0.2, 0.15), 2, {2: None, 3: None}),
        ((0.01, 0.2, 0.21), 1, {2: None, 3: None}),
        ((0.17, 0.18, 0.01), 2, {2: 3, 3: 1}),
    ],
    ids=["hardly", "hardly the root", "clearly", "clearly the root", "either of two that hang together"],
)
def test_a_part_that_may_as_well_hang_on_another_is_said_to(gaps, parent, others):
    tree = tree_found(*links(gaps))
    assert {j.child: j.parent for j in tree.joints} == {2: 1, 3: parent}
    assert other_parents(tree) == others
    for joint in tree.joints:
        assert joint.other is None or joint.other.child == joint.child


def test_where_the_user_says_the_parent_no_other_is_as_likely():
    assert other_parents(tree_found(*links((0.01, 0.2, 0.175)), {3: 2})) == {2: None, 3: None}
    assert other_parents(tree_found(*links((0.01, 0.2, 0.175)), {3: 1})) == {2: None, 3: None}


def test_a_part_that_only_one_parent_explains_has_no_other():
    joints, gaps, touching = links((0.01, 0.2, 0.2))
    del joints[1, 3]
    assert other_parents(tree_found(joints, gaps, touching)) == {2: None, 3: None}


def beside_one_at_rest(kind, closer):
    """Part 3 moves against the root and against part 2, which rests on it and is nearer by `closer` radii."""
    move = JointFit(kind, X, 0 * X, 0.0, torch.tensor([0.0, 0.2]).double(), residual=0.0)
    still = JointFit("fixed", 0 * X, 0 * X, 0.0, torch.zeros(2).double(), residual=0.0)
    return tree_found({(1, 2): still, (1, 3): move, (2, 3): move}, {(1, 2): 0.02, (1, 3): 0.17, (2, 3): 0.17 - closer})


@pytest.mark.parametrize(
    "kind, closer, parent, other",
    [
        ("prismatic", 0.05, 1, 2),
        ("prismatic", 0.15, 2, 1),
        ("prismatic", -0.05, 1, None),
        ("revolute", 0.01, 1, 2),
        ("revolute", 0.05, 2, 1),
        ("revolute", 0.13, 2, None),
    ],
)
def test_a_part_beside_one_at_rest_may_as_well_hang_on_it(kind, closer, parent, other):
    """As a drawer does on a closed one above it: no motion tells which of the two bears it."""
    tree = beside_one_at_rest(kind, closer)
    assert {j.child: j.parent for j in tree.joints} == {2: 1, 3: parent}
    assert other_parents(tree) == {2: None, 3: other}
