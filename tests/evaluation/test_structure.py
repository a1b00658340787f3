from dataclasses import replace

import pytest
import torch

from splatart_ns.bundle import Joint
from splatart_ns.evaluation.structure import structure_scores


def extra(parent: str, child: str, kind: str = "revolute") -> Joint:
    axis = torch.tensor([0.0, 0, 1], dtype=torch.float64)
    values = torch.zeros(2, dtype=torch.float64)
    return Joint("extra", kind, parent, child, axis, 0 * axis, values, (0.0, 0.0), in_tree=False)


def test_the_true_tree_is_exact(truth, bundle):
    assert structure_scores(truth, bundle) == {"tree_exact": True, "edges_precision": 1.0, "edges_recall": 1.0}


def test_a_loop_joint_that_is_none_costs_precision(truth, bundle):
    bundle.joints.append(extra("body", "latch"))
    scores = structure_scores(truth, bundle)
    assert scores["tree_exact"] and scores["edges_recall"] == 1
    assert scores["edges_precision"] == pytest.approx(2 / 3)


def test_free_joints_connect_nothing(truth, bundle):
    bundle.joints.append(extra("body", "latch", "free"))
    assert structure_scores(truth, bundle)["edges_precision"] == 1


def test_another_parent_breaks_the_tree(truth, bundle):
    bundle.joints[1].parent = "body"
    assert structure_scores(truth, bundle) == {"tree_exact": False, "edges_precision": 0.5, "edges_recall": 0.5}


def test_another_root_breaks_the_tree_but_not_the_edges(truth, bundle):
    bundle.root = "door"
    bundle.joints[0].parent, bundle.joints[0].child = "door", "body"
    assert structure_scores(truth, bundle) == {"tree_exact": False, "edges_precision": 1.0, "edges_recall": 1.0}


def test_joints_of_parts_without_geometry_do_not_count(truth, bundle):
    truth.joints[1] = replace(truth.joints[1], child=None)
    bundle.joints.pop(1)
    assert structure_scores(truth, bundle) == {"tree_exact": True, "edges_precision": 1.0, "edges_recall": 1.0}


def test_a_part_below_one_without_geometry_hangs_on_the_next_one_above(truth, bundle):
    """As a bottle's cap, which slides by one joint and turns by another."""
    door = truth.joints[0]
    slide = replace(door, name="slide", child=None, child_name="helper", type="prismatic")
    turn = replace(door, parent=None, parent_name="helper")
    truth.joints[:1] = [turn, slide]
    assert structure_scores(truth, bundle) == {"tree_exact": True, "edges_precision": 1.0, "edges_recall": 1.0}
    bundle.joints[0].parent = "latch"
    assert not structure_scores(truth, bundle)["tree_exact"]


def test_a_part_with_nothing_but_parts_without_geometry_above_it_hangs_on_none(truth, bundle):
    ring = replace(truth.joints[0], parent=None, parent_name="a")
    a, b = (replace(ring, child=None, child_name=x, parent_name=y) for x, y in ("ab", "ba"))
    truth.joints[:1] = [ring, a, b]
    scores = structure_scores(truth, bundle)
    assert not scores["tree_exact"] and scores["edges_recall"] == 1 and scores["edges_precision"] == 0.5


def test_no_joints_have_no_precision(truth, bundle):
    bundle.joints.clear()
    assert structure_scores(truth, bundle) == {"tree_exact": False, "edges_precision": None, "edges_recall": 0.0}
