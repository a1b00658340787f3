"""Why parts hang on nothing, or not as the user told: sentences about fitted joints."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from splatart_ns.geometry.se3 import transform_points
from splatart_ns.stages.joint_fit import JointFit


def why_unattached(
    part: int,
    reached: set[int],
    joints: Mapping[tuple[int, int], JointFit],
    apart: Mapping[tuple[int, int], float],
    object_radius: float,
    names: Mapping[int, str],
) -> str:
    """Of a part that none of the `joints` by (parent, child) explains on a part of the tree, those `reached`.

    `apart`: the gaps (length) of pairs that move as by a joint, but are too far from each other for one.
    """
    # Either way round, as the parts' points differ; what one leaves may be within the limit.
    tried = [
        (max(fit.residual, joints.get((c, p), fit).residual) / object_radius, p, fit.type)
        for (p, c), fit in joints.items()
        if c == part and p in reached
    ]
    gaps = [(gap, p) for pair, gap in apart.items() if part in pair for p in reached.intersection(pair)]
    if gaps and not tried:
        gap, parent = min(gaps)
        told = f"--joint '{names[part]}:{names[parent]}'"
        return (
            f"{names[part]} moves as by a joint on {names[parent]}, but is {gap / object_radius:.0%} of the object's "
            f"radius away from it: {told} hangs it there."
        )
    if not tried:
        return f"No joint was fitted between {names[part]} and any part of the tree."
    residual, parent, kind = min(tried)
    return (
        f"No joint explains how {names[part]} moves: the best, {kind} on {names[parent]}, leaves {residual:.1%} of the "
        "object's radius, more than the limit and than noise would."
    )


def fits_far_worse(told: JointFit, free: JointFit) -> bool:
    """Whether a joint of the type that the user told is none that would be accepted, but one of another type is."""
    return not told.accepted and free.accepted and free.type != told.type


def why_contradicted(
    edge: tuple[int, int], told: JointFit, free: JointFit, object_radius: float, names: Mapping[int, str]
) -> str:
    """Of a joint (parent, child) whose type the user told, beside the best of another type."""
    parent, child = (names[p] for p in edge)
    return (
        f"--joint '{child}:{parent}={told.type}' leaves {told.residual / object_radius:.1%} of the object's radius "
        f"unexplained; {free.type} would leave {free.residual / object_radius:.1%}."
    )


def exchange_hint(
    part: int, points: Mapping[int, Tensor], motions: Mapping[int, Tensor], names: Mapping[int, str]
) -> str:
    """What to say where `part` and another, in some state, each lie nearer to where the other was in the first one than
    to where they were themselves; "" where none does. By the parts' points [N, 3] and motions [S, 4, 4]."""
    centres = {p: x.double().mean(0) for p, x in points.items()}
    places = {p: transform_points(motions[p].double(), centre[None])[:, 0] for p, centre in centres.items()}

    def nearer(a: int, b: int) -> Tensor:
        return (places[a] - centres[b]).norm(dim=-1) < (places[a] - centres[a]).norm(dim=-1)

    other = next((p for p in points if p != part and bool((nearer(part, p) & nearer(p, part)).any())), None)
    if other is None:
        return ""
    return f" In some state it lies where {names[other]} was, and {names[other]} where it was: are their ids exchanged?"
