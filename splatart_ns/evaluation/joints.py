"""How far estimated joints are from the true ones (docs/metrics.md, joints)."""

from __future__ import annotations

import math
from typing import Any

import torch
from scipy.stats import chi2
from torch import Tensor

from splatart_ns.bundle.bundle import Bundle, Joint
from splatart_ns.bundle.posing import joint_motion
from splatart_ns.evaluation.ground_truth import GroundTruth, TrueJoint
from splatart_ns.geometry.se3 import inverse, transform_points

ERRORS = (
    "axis_angle",
    "axis_position",
    "pivot_offset",
    "motion_geodesic",
    "motion_value",
    "displacement",
    "displacement_percent",
)
"""Keys of a joint's record whose means are reported."""
_TURNING = ("revolute", "screw")
_PARALLEL = 1e-6


def axis_angle(a: Tensor, b: Tensor) -> float:
    """Angle between two directions [3] without sign, degrees in [0, 90]."""
    return math.degrees(math.atan2(float(torch.linalg.cross(a, b).norm()), abs(float(a @ b))))


def point_to_line(point: Tensor, axis: Tensor, origin: Tensor) -> float:
    """Distance of a point [3] from the line through `origin` along the unit `axis`, length."""
    return float(torch.linalg.cross(axis, point - origin).norm())


def line_distance(axis_a: Tensor, origin_a: Tensor, axis_b: Tensor, origin_b: Tensor) -> float:
    """Distance between two infinite lines with unit axes; of nearly parallel ones, origin_b's distance from line a."""
    normal = torch.linalg.cross(axis_a, axis_b)
    if float(normal.norm()) < _PARALLEL:
        return point_to_line(origin_b, axis_a, origin_a)
    return abs(float((origin_b - origin_a) @ normal / normal.norm()))


def rotation_error(R_a: Tensor, R_b: Tensor) -> Tensor:
    """Angles between rotations [..., 3, 3], degrees; from the chord, which keeps its digits at small angles."""
    chord = torch.linalg.matrix_norm(R_a - R_b) / math.sqrt(8)
    return torch.rad2deg(2 * torch.asin(chord.clamp(max=1.0)))


def displacement(points: Tensor, T_a: Tensor, T_b: Tensor) -> float:
    """Mean distance of points [N, 3] moved by two sets of motions [..., 4, 4] (ADD, Hinterstoisser et al. 2012)."""
    return float((transform_points(T_a, points) - transform_points(T_b, points)).norm(dim=-1).mean())


def covers(joint: Joint, axis: Tensor, origin: Tensor) -> bool | None:
    """Whether the joint's 95 % region of lines (of directions, for prismatic) holds a true line; None without one.

    The region is the ellipsoid of the joint's covariance of the axis and of the point where it is crossed by the
    plane through the joint's origin across it: 4 degrees of freedom, 2 for prismatic.
    """
    names = ("axis",) if joint.type == "prismatic" else ("axis", "axis_origin", "origin")
    types = (*_TURNING, "cylindrical", "prismatic")
    if joint.type not in types or any(joint.covariance.get(name) is None for name in names):
        return None
    blocks = {name: torch.as_tensor(joint.covariance[name], dtype=torch.float64) for name in names}
    across = torch.linalg.svd(joint.axis[None]).Vh[1:]
    cosine = float(axis @ joint.axis)
    if abs(cosine) < _PARALLEL:
        return False
    offset = across @ (axis / cosine)
    covariance = across @ blocks["axis"] @ across.mT
    if joint.type != "prismatic":
        crossing = origin + axis * ((joint.origin - origin) @ joint.axis / cosine)
        offset = torch.cat([offset, across @ (crossing - joint.origin)])
        mixed = across @ blocks["axis_origin"] @ across.mT
        covariance = torch.cat(
            [torch.cat([covariance, mixed], 1), torch.cat([mixed.mT, across @ blocks["origin"] @ across.mT], 1)]
        )
    variances, directions = torch.linalg.eigh((covariance + covariance.mT) / 2)
    distance2 = ((directions.mT @ offset) ** 2 / variances.clamp_min(1e-24)).sum()
    return bool(distance2 <= chi2.ppf(0.95, len(offset)))


def find_joint(bundle: Bundle, parent: str, child: str) -> Joint | None:
    """The estimated joint between two parts, in either direction; one of the tree before others."""
    found = [joint for joint in bundle.joints if {joint.parent, joint.child} == {parent, child}]
    return max(found, key=lambda joint: (joint.in_tree, joint.child == child), default=None)


def joint_errors(truth: TrueJoint, ground_truth: GroundTruth, bundle: Bundle) -> tuple[dict[str, Any], str | None]:
    """One record of `metrics.json` and a note on what in it is null.

    The estimated joint between the true pair of parts counts, in either direction. If the child hangs on another
    part instead, there is no axis to compare: the motion errors then come from the estimated motions of the true
    pair. If the child or its parent is unknown, or the child hangs on nothing, all errors are null; so is whether type
    and parent are correct if one of them has no geometry.
    """
    names = {part.id: part.name for part in bundle.parts}
    parent, child = names.get(truth.parent), names.get(truth.child)
    record: dict[str, Any] = {
        "child": truth.child_name,
        "parent": truth.parent_name,
        "type": truth.type,
        "type_correct": False,
        "parent_correct": False,
        **dict.fromkeys(ERRORS),
        "covered_95": None,
    }
    if truth.parent is None or truth.child is None:
        return record | {
            "type_correct": None,
            "parent_correct": None,
        }, "a part of it has no geometry, so no image shows it"
    if parent is None or child is None:
        return record, "the estimate lacks a part of this joint"
    joint = find_joint(bundle, parent, child)
    other = next((j for j in bundle.joints if j.child == child and j.in_tree), None)
    if joint is None and (other is None or other.type == "free"):
        return record, "the estimate has no joint for this child"

    record["type_correct"] = (joint or other).type == truth.type
    record["parent_correct"] = joint is not None and joint.in_tree and joint.child == child
    moved = slice(1, None)
    true_motion = ground_truth.relative_motion(truth)[moved]
    if joint is None:
        T = torch.linalg.solve(bundle.part(parent).motion, bundle.part(child).motion)[moved]
        note = f"the estimate hangs it on {other.parent}: no axis, motions from the part poses"
    else:
        T = joint_motion(joint, joint.values[moved])
        T = T if joint.child == child else inverse(T)
        note = _compare_axes(record, joint, truth)
    if len(T) > 0:
        _compare_motions(record, joint, truth, T, true_motion, ground_truth)
    return record, note


def _compare_axes(record: dict[str, Any], joint: Joint, truth: TrueJoint) -> str | None:
    if truth.type == "fixed":
        return None
    if joint.type not in (*_TURNING, "prismatic", "cylindrical"):
        record["covered_95"] = False
        return f"a {joint.type} joint has no axis"
    record["axis_angle"] = axis_angle(joint.axis, truth.axis)
    record["covered_95"] = covers(joint, truth.axis, truth.origin) if joint.type == truth.type else False
    if truth.type not in _TURNING:
        return None
    if joint.type == "prismatic":
        return "a prismatic joint has no axis line"
    record["axis_position"] = 10 * line_distance(joint.axis, joint.origin, truth.axis, truth.origin)
    record["pivot_offset"] = point_to_line(truth.origin, joint.axis, joint.origin)
    return None


def _compare_motions(
    record: dict[str, Any],
    joint: Joint | None,
    truth: TrueJoint,
    T: Tensor,
    true_motion: Tensor,
    ground_truth: GroundTruth,
) -> None:
    """Fill in the errors of the motions [S - 1, 4, 4] of the later states, means over these states."""
    points = ground_truth.points[truth.child]
    centroid = points.mean(0)[None]
    slide, true_slide = ((transform_points(X, centroid) - centroid)[:, 0] for X in (T, true_motion))
    true_travel = truth.values[1:].abs()
    if truth.type == "prismatic":
        record["motion_geodesic"] = float((slide - true_slide).norm(dim=-1).mean())
        travel = slide.norm(dim=-1)
        same_unit = joint is None or joint.type in ("prismatic", "fixed")
    else:
        record["motion_geodesic"] = float(rotation_error(T[:, :3, :3], true_motion[:, :3, :3]).mean())
        true_travel = torch.rad2deg(true_travel)
        travel = rotation_error(T[:, :3, :3], torch.eye(3).to(T).expand(len(T), 3, 3))
        same_unit = joint is None or joint.type in (*_TURNING, "fixed")
    if joint is not None and same_unit:
        travel = joint.values[1:].abs() if truth.type == "prismatic" else torch.rad2deg(joint.values[1:].abs())
    if same_unit:
        record["motion_value"] = float((travel - true_travel).abs().mean())
    record["displacement"] = displacement(points, T, true_motion)
    record["displacement_percent"] = 100 * record["displacement"] / ground_truth.radius


def mean_errors(records: list[dict[str, Any]]) -> dict[str, dict[str, float | None]]:
    """Means over the joints that have a value, revolute and prismatic apart."""
    means: dict[str, dict[str, float | None]] = {}
    for kind in ("revolute", "prismatic"):
        of_kind = [record for record in records if record["type"] == kind]
        means[kind] = {}
        for key in (*ERRORS, "covered_95"):
            values = [float(record[key]) for record in of_kind if record[key] is not None]
            means[kind][key] = sum(values) / len(values) if values else None
    return means
