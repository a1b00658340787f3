"""Whether the right parts hang together (docs/metrics.md, structure)."""

from __future__ import annotations

from typing import Any

from splatart_ns.bundle.bundle import Bundle
from splatart_ns.evaluation.ground_truth import GroundTruth


def structure_scores(ground_truth: GroundTruth, bundle: Bundle) -> dict[str, Any]:
    """`tree_exact` (root and every parent right), and precision and recall of the accepted graph's edges.

    The accepted graph holds the tree's joints and the loops', without directions; "free" joints connect nothing. True
    joints of parts without geometry are left out.
    """
    ids = {part.name: part.id for part in bundle.parts}
    joints = [joint for joint in bundle.joints if joint.type != "free"]
    tree = {(ids[joint.parent], ids[joint.child]) for joint in joints if joint.in_tree}
    true_tree = {
        (joint.parent, joint.child) for joint in ground_truth.joints if None not in (joint.parent, joint.child)
    }
    edges = {frozenset((ids[joint.parent], ids[joint.child])) for joint in joints}
    true_edges = {frozenset(edge) for edge in true_tree}
    right = len(edges & true_edges)
    return {
        "tree_exact": tree == true_tree and ids[bundle.root] == ground_truth.root,
        "edges_precision": right / len(edges) if edges else None,
        "edges_recall": right / len(true_edges) if true_edges else None,
    }
