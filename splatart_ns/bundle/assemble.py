"""From the results of the stages to a bundle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from typing import Any

import torch
from torch import Tensor

from splatart_ns.bundle.bundle import Bundle, Joint, Part
from splatart_ns.bundle.posing import configured_motions
from splatart_ns.splats.splat import Splat
from splatart_ns.stages import articulate
from splatart_ns.stages.articulate import KinematicTree


def assemble_bundle(
    tree: KinematicTree,
    splats: Mapping[int, Splat],
    motions: Mapping[int, Tensor],
    covariances: Mapping[int, Tensor],
    part_names: Mapping[int, str],
    states: Sequence[str],
    length_unit: str,
    provenance: dict[str, Any],
) -> Bundle:
    """Parts, joints and loops of a kinematic tree, all in the capture's unit and the canonical frame.

    A part that hangs on the tree moves at the observed states as its joints say; one that hangs on nothing keeps its
    own motion [S, 4, 4].
    """
    parts = [
        Part(p, part_names[p], splats[p], motions[p].double(), covariances[p].double()) for p in sorted(part_names)
    ]
    joints: list[Joint] = []
    for in_tree, of_tree in ((True, tree.joints), (False, tree.loops)):
        for joint in of_tree:
            joints.append(_joint(joint, part_names, {j.name for j in joints}, in_tree))
    bundle = Bundle(
        parts,
        joints,
        part_names[tree.root],
        list(states),
        length_unit,
        [
            _loop(tree, loop, joint.name, part_names)
            for loop, joint in zip(tree.loops, joints[len(tree.joints) :], strict=True)
        ],
        provenance,
    )
    hung = {part_names[tree.root], *(j.child for j in bundle.tree_joints)}
    for part in bundle.parts:
        if part.name in hung:
            part.motion = torch.stack([_observed(bundle, motions[tree.root], s)[part.name] for s in range(len(states))])
    return bundle


def _observed(bundle: Bundle, root_motion: Tensor, state: int) -> dict[str, Tensor]:
    """Motions of all parts at an observed state, by the joints."""
    q = {joint.name: joint.values[state] for joint in bundle.tree_joints}
    return {name: root_motion[state] @ T for name, T in configured_motions(bundle, q).items()}


def _joint(joint: articulate.Joint, names: Mapping[int, str], taken: Set[str], in_tree: bool) -> Joint:
    fit, name = joint.fit, f"{names[joint.parent]}_to_{names[joint.child]}"
    while name in taken or name in names.values():  # a joint also goes by the part that it moves
        name += "_joint"
    return Joint(
        name=name,
        type=fit.type,
        parent=names[joint.parent],
        child=names[joint.child],
        axis=fit.axis,
        origin=fit.origin,
        pitch=fit.pitch,
        values=fit.values,
        limits=fit.limits,
        in_tree=in_tree,
        residual=fit.residual,
        covariance=fit.covariance,
        ambiguous=fit.ambiguous or joint.other is not None,
        alternatives=fit.alternatives + ([] if joint.other is None else [_other_parent(joint.other, names)]),
    )


def _other_parent(joint: articulate.Joint, names: Mapping[int, str]) -> dict[str, Any]:
    fit = joint.fit
    return {"type": fit.type, "residual": fit.residual, "score": fit.score, "parent": names[joint.parent]}


def _loop(tree: KinematicTree, joint: articulate.Joint, name: str, names: Mapping[int, str]) -> dict[str, Any]:
    """The parts around the loop that a joint of that name closes, from its child up and down to its parent."""
    parents = {j.child: j.parent for j in tree.joints}

    def to_root(part: int) -> list[int]:
        path = [part]
        while path[-1] in parents:
            path.append(parents[path[-1]])
        return path

    up, down = to_root(joint.child), to_root(joint.parent)
    meeting = next(p for p in up if p in down)
    around = up[: up.index(meeting) + 1] + down[: down.index(meeting)][::-1]
    return {"joint": name, "parts": [names[p] for p in around]}
