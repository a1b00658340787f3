"""Whether the right parts hang together (docs/metrics.md, structure)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from splatart_ns.bundle.bundle import Bundle
from splatart_ns.evaluation.ground_truth import GroundTruth, TrueJoint


def structure_scores(ground_truth: GroundTruth, bundle: Bundle) -> dict[str, Any]:
    """`tree_exact` (root and every parent right), and precision and recall of the accepted graph's edges.

    The accepted graph holds the tree's joints and the loops', without directions; "free" joints connect nothing. In the
    true tree a part hangs on the nearest one above it with geometry: no image shows the others.
    """
    ids = {part.name: part.id for part in bundle.parts}
    joints = [joint for joint in bundle.joints if joint.type != "free"]
    tree = {(ids[joint.parent], ids[joint.child]) for joint in joints if joint.in_tree}
    true_tree = _tree_of_parts(ground_truth.joints)
    edges = {frozenset((ids[joint.parent], ids[joint.child])) for joint in joints}
    true_edges = {frozenset(edge) for edge in true_tree}
    right = len(edges & true_edges)
    return {
        "tree_exact": tree == true_tree and ids[bundle.root] == ground_truth.root,
        "edges_precision": right / len(edges) if edges else None,
        "edges_recall": right / len(true_edges) if true_edges else None,
    }


def _tree_of_parts(joints: Sequence[TrueJoint]) -> set[tuple[int, int]]:
    """Parents and children, by label id, of the parts with geometry."""
    above = {joint.child_name: joint for joint in joints}
    tree = set()
    for joint in joints:
        parent, name, passed = joint.parent, joint.parent_name, {joint.child_name}
        while parent is None and name in above and name not in passed:  # a file may tell of a ring
            passed.add(name)
            parent, name = above[name].parent, above[name].parent_name
        if None not in (parent, joint.child):
            tree.add((parent, joint.child))
    return tree
