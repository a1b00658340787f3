import math
from dataclasses import replace

import pytest
import torch

from splatart_ns.bundle import Joint, joint_motion
from splatart_ns.evaluation.joints import (
    ERRORS,
    axis_angle,
    covers,
    displacement,
    joint_errors,
    line_distance,
    mean_errors,
    point_to_line,
    rotation_error,
)
from splatart_ns.geometry.se3 import inverse, so3_exp

D = torch.float64


def v(*x: float) -> torch.Tensor:
    return torch.tensor(x, dtype=D)


X, Z, ORIGIN = v(1, 0, 0), v(0, 0, 1), v(0, 0, 0)


@pytest.mark.parametrize(
    ("other", "expected"),
    [(Z, 0.0), (-Z, 0.0), (X, 90.0), (v(0, 0.5, math.sqrt(3) / 2), 30.0), (v(0, 0.5, -math.sqrt(3) / 2), 30.0)],
)
def test_axis_angle_is_folded(other, expected):
    assert axis_angle(Z, other) == pytest.approx(expected, abs=1e-12)


def test_axis_angle_keeps_the_digits_of_small_angles():
    assert axis_angle(Z, v(1e-9, 0, 1)) == pytest.approx(math.degrees(1e-9), rel=1e-6)


def test_line_distance_of_skew_lines():
    assert line_distance(Z, ORIGIN, X, v(5, 2, 7)) == pytest.approx(2.0)


def test_line_distance_of_parallel_lines_falls_back_to_the_point():
    assert line_distance(Z, ORIGIN, Z, v(3, 4, 9)) == pytest.approx(5.0)
    nearly = v(1e-7, 0, 1)
    assert line_distance(nearly / nearly.norm(), ORIGIN, Z, v(3, 4, 0)) == pytest.approx(5.0)


def test_pivot_offset_sees_what_line_distance_misses():
    axis = so3_exp(0.1 * X) @ Z
    assert line_distance(axis, ORIGIN, Z, v(0, 1, 0)) == pytest.approx(0.0, abs=1e-12)
    assert point_to_line(v(0, 1, 0), axis, ORIGIN) == pytest.approx(math.cos(0.1))


@pytest.mark.parametrize("along", [-3.0, 0.5, 100.0])
def test_moving_a_pivot_along_its_axis_changes_nothing(along):
    axis, origin, true_axis, true_origin = so3_exp(v(0.3, 0.2, 0.1)) @ Z, v(1, 2, 3), Z, v(0.5, 0, 0)
    moved = origin + along * axis
    assert point_to_line(true_origin, axis, moved) == pytest.approx(point_to_line(true_origin, axis, origin))
    expected = line_distance(axis, origin, true_axis, true_origin)
    assert line_distance(axis, moved, true_axis, true_origin) == pytest.approx(expected)
    assert line_distance(axis, origin, true_axis, true_origin + along * true_axis) == pytest.approx(expected)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 0.5, 3.0, math.pi])
def test_rotation_error_is_the_angle_between(angle):
    R = so3_exp(v(0.2, -0.4, 0.9))
    error = rotation_error(R @ so3_exp(angle * X), R)
    assert float(error) == pytest.approx(math.degrees(angle), rel=1e-6, abs=1e-7)


def test_displacement_of_a_slide_is_its_length():
    T = torch.eye(4, dtype=D)
    T[:3, 3] = v(0, 3, 4)
    assert displacement(torch.rand(10, 3, dtype=D), T[None], torch.eye(4, dtype=D)[None]) == pytest.approx(5.0)


def record_of(truth, bundle, index):
    return joint_errors(truth.joints[index], truth, bundle)


def assert_no_error(record):
    """Nor an error that is unknown, but for a slide's line."""
    lines = {"axis_position", "pivot_offset"} if record["type"] == "prismatic" else set()
    for key in ERRORS:
        assert record[key] == (None if key in lines else pytest.approx(0, abs=1e-6)), key


@pytest.mark.parametrize("index", [0, 1])
def test_a_perfect_estimate_has_no_error(truth, bundle, index):
    record, note = record_of(truth, bundle, index)
    assert note is None
    assert record["type_correct"] and record["parent_correct"]
    assert_no_error(record)


@pytest.mark.parametrize("index", [0, 1])
def test_the_sign_of_axis_and_value_is_a_matter_of_taste(truth, bundle, index):
    joint = bundle.joints[index]
    joint.axis, joint.values = -joint.axis, -joint.values
    record, _ = record_of(truth, bundle, index)
    assert record["type_correct"] and record["parent_correct"]
    assert_no_error(record)
    joint.values = -joint.values  # the other way, which no motion takes for the same
    record, _ = record_of(truth, bundle, index)
    assert record["axis_angle"] == pytest.approx(0, abs=1e-6)
    assert record["motion_geodesic"] == pytest.approx(2 * [math.degrees(0.5), 0.3][index])


@pytest.mark.parametrize("index", [0, 1])
def test_a_joint_the_other_way_round_has_the_wrong_parent_and_no_other_error(truth, bundle, index):
    joint = bundle.joints[index]
    joint.parent, joint.child, joint.values = joint.child, joint.parent, -joint.values
    record, _ = record_of(truth, bundle, index)
    assert record["type_correct"] and not record["parent_correct"]
    assert_no_error(record)


def test_of_two_joints_of_a_pair_the_trees_counts_and_a_loops_makes_no_parent(truth, bundle):
    bundle.joints.insert(0, replace(bundle.joints[0], name="again", in_tree=False, axis=X))
    assert_no_error(record_of(truth, bundle, 0)[0])
    bundle.joints.pop(1)
    record, _ = record_of(truth, bundle, 0)
    assert record["axis_angle"] == pytest.approx(90) and not record["parent_correct"]


def test_travel_beyond_half_a_turn_counts_in_full(truth, bundle):
    hinge = bundle.joints[0]
    truth.joints[0].values[1] = 4.0
    truth.motions[2][1] = joint_motion(hinge, 4.0)
    hinge.values = v(0, 4.1)
    record, _ = record_of(truth, bundle, 0)
    assert record["motion_value"] == pytest.approx(math.degrees(0.1)) == record["motion_geodesic"]


def test_errors_of_a_turned_and_shifted_hinge(truth, bundle):
    hinge = bundle.joints[0]
    hinge.axis = so3_exp(0.1 * X) @ Z
    hinge.origin = v(0.2, 0.4, 0)
    hinge.values = v(0, 0.7)
    record, _ = record_of(truth, bundle, 0)
    assert record["axis_angle"] == pytest.approx(math.degrees(0.1))
    assert record["axis_position"] == pytest.approx(10 * 0.2)
    assert record["pivot_offset"] == pytest.approx(0.2)
    assert record["motion_value"] == pytest.approx(math.degrees(0.2))
    assert math.degrees(0.2) < record["motion_geodesic"] < math.degrees(0.3)
    assert record["displacement_percent"] == pytest.approx(100 * record["displacement"] / truth.radius)


def test_errors_of_a_slide_in_the_wrong_direction(truth, bundle):
    bundle.joints[1].axis = v(-0.8, 0.6, 0)
    record, _ = record_of(truth, bundle, 1)
    assert record["axis_angle"] == pytest.approx(90)
    assert record["motion_value"] == pytest.approx(0)
    assert record["motion_geodesic"] == pytest.approx(0.3 * math.sqrt(2))
    assert record["displacement"] == pytest.approx(0.3 * math.sqrt(2))


def test_a_world_that_moved_with_the_root_changes_nothing(truth, bundle):
    G = torch.eye(4, dtype=D)
    G[:3, :3], G[:3, 3] = so3_exp(v(1, 2, 0.5)), v(3, -1, 2)
    truth.motions.update({part: torch.stack([T[0], G @ T[1]]) for part, T in truth.motions.items()})
    record, _ = record_of(truth, bundle, 0)
    assert record["displacement"] == pytest.approx(0, abs=1e-9)


def test_another_parent_leaves_the_motion_of_the_true_pair(truth, bundle):
    bundle.joints[1].parent = "body"
    record, note = record_of(truth, bundle, 1)
    assert "body" in note
    assert record["type_correct"] and not record["parent_correct"]
    assert record["axis_angle"] is None and record["covered_95"] is None
    for key in ("motion_geodesic", "motion_value", "displacement"):
        assert record[key] == pytest.approx(0, abs=1e-9)


def test_a_part_that_hangs_on_nothing_has_null_errors(truth, bundle):
    bundle.joints.pop(1)
    record, note = record_of(truth, bundle, 1)
    assert "no joint" in note
    assert not record["type_correct"] and not record["parent_correct"]
    assert all(record[key] is None for key in ERRORS)


def test_a_missing_part_has_null_errors(truth, bundle):
    bundle.parts.pop(2)
    bundle.joints.pop(1)
    record, note = record_of(truth, bundle, 1)
    assert "lacks a part" in note
    assert (record["child"], record["parent"]) == ("latch", "door")
    assert all(record[key] is None for key in ERRORS)


def test_a_joint_of_a_part_without_geometry_has_null_errors(truth, bundle):
    record, note = joint_errors(replace(truth.joints[1], parent=None), truth, bundle)
    assert "no geometry" in note
    assert record["type_correct"] is None and record["parent_correct"] is None
    assert (record["child"], record["parent"], record["displacement"]) == ("latch", "door", None)


def test_a_hinge_taken_for_a_slide_has_no_line(truth, bundle):
    bundle.joints[0].type = "prismatic"
    record, note = record_of(truth, bundle, 0)
    assert "no axis line" in note
    assert not record["type_correct"] and record["covered_95"] is False
    assert record["axis_position"] is None and record["pivot_offset"] is None and record["motion_value"] is None
    assert record["motion_geodesic"] == pytest.approx(math.degrees(0.5))


def test_a_joint_taken_for_fixed_missed_all_of_the_motion(truth, bundle):
    for joint in bundle.joints:
        joint.type, joint.values = "fixed", torch.zeros(2, dtype=D)
    hinge, slide = (record_of(truth, bundle, index)[0] for index in (0, 1))
    for key in ("motion_value", "motion_geodesic"):
        assert hinge[key] == pytest.approx(math.degrees(0.5))
        assert slide[key] == pytest.approx(0.3)


def estimate(kind: str = "revolute") -> tuple[Joint, torch.Tensor]:
    """A joint with a covariance, and a square root of the covariance of (two turns, two shifts)."""
    axis = so3_exp(v(0.5, -0.2, 0.3)) @ Z
    across = torch.linalg.svd(axis[None]).Vh[1:].mT
    root = 0.02 * torch.randn(4, 4, generator=torch.Generator().manual_seed(0), dtype=D)
    C = root @ root.mT
    blocks = {
        "axis": across @ C[:2, :2] @ across.mT,
        "axis_origin": across @ C[:2, 2:] @ across.mT,
        "origin": across @ C[2:, 2:] @ across.mT,
    }
    covariance = {name: block.tolist() for name, block in blocks.items()}
    joint = Joint("j", kind, "a", "b", axis, v(1, 2, 3), torch.zeros(2, dtype=D), (0, 0), covariance=covariance)
    return joint, torch.block_diag(across, across) @ root


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_the_region_covers_95_percent_of_what_the_covariance_says(kind):
    joint, root = estimate(kind)
    noise = torch.randn(1000, 4, generator=torch.Generator().manual_seed(1), dtype=D) @ root.mT
    hits = 0
    for k, x in enumerate(noise):
        axis = joint.axis + x[:3]
        origin = joint.origin + x[3:] + (k % 7) * axis
        hits += covers(joint, (-1) ** k * axis / axis.norm(), origin)
    assert 930 < hits < 970


@pytest.mark.parametrize("sign", [1, -1])
def test_the_region_leans_as_axis_and_origin_err_together(bundle, sign):
    """A tilt towards x goes with a shift along y or against it: one without the other is outside."""
    joint, across = bundle.joints[0], torch.diag(v(1, 1, 0))
    leaning = torch.zeros(3, 3, dtype=D)
    leaning[0, 1] = 0.99 * sign * 0.01 * 0.1
    blocks = {"axis": 0.01**2 * across, "origin": 0.1**2 * across, "axis_origin": leaning}
    joint.covariance = {name: block.tolist() for name, block in blocks.items()}
    axis = v(0.02, 0, 1) / v(0.02, 0, 1).norm()
    assert covers(joint, axis, joint.origin + v(0, 0.2 * sign, 0))
    assert not covers(joint, axis, joint.origin - v(0, 0.2 * sign, 0))


def test_the_region_does_not_hold_an_axis_across(truth):
    joint, _ = estimate()
    assert covers(joint, torch.linalg.svd(joint.axis[None]).Vh[1], joint.origin) is False


def test_without_a_covariance_there_is_no_region():
    joint, _ = estimate()
    joint.covariance = {**joint.covariance, "origin": None}
    assert covers(joint, joint.axis, joint.origin) is None


def test_means_keep_types_apart_and_leave_out_nulls(truth, bundle):
    records = [joint_errors(joint, truth, bundle)[0] for joint in truth.joints]
    records.append({**records[0], "axis_angle": 4.0, "displacement": None})
    means = mean_errors(records)
    assert means["revolute"]["axis_angle"] == pytest.approx(2.0)
    assert means["revolute"]["displacement"] == pytest.approx(0, abs=1e-9)
    assert means["prismatic"]["axis_position"] is None
    assert means["prismatic"]["axis_angle"] == pytest.approx(0)


def test_the_inverse_convention_of_relative_motion(truth):
    T = truth.relative_motion(truth.joints[1])
    torch.testing.assert_close(T, inverse(truth.motions[2]) @ truth.motions[3])
