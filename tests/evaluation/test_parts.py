import math

import pytest
import torch

from splatart_ns.evaluation.parts import part_pose_errors
from splatart_ns.geometry.se3 import from_rotation_translation, so3_exp

D = torch.float64


def motion(rotation, translation):
    return from_rotation_translation(so3_exp(torch.tensor(rotation, dtype=D)), torch.tensor(translation, dtype=D))


def test_a_perfect_estimate_has_no_error_in_any_gauge(truth, bundle):
    G = motion([0.3, 1.0, -2.0], [5.0, 6.0, 7.0])
    for part in bundle.parts:
        part.motion = torch.stack([part.motion[0], G @ part.motion[1]])
    records = part_pose_errors(truth, bundle)
    assert [(r["name"], r["state"]) for r in records] == [("door", "state_01"), ("latch", "state_01")]
    for record in records:
        assert record["part_rotation"] == pytest.approx(0, abs=1e-6)
        assert record["part_translation"] == pytest.approx(0, abs=1e-9)


def test_a_turn_about_the_centroid_is_no_translation(truth, bundle):
    centroid = truth.points[2].mean(0)
    turn = motion([0.0, 0.2, 0.0], [0.0, 0.0, 0.0])
    turn[:3, 3] = centroid - turn[:3, :3] @ centroid
    bundle.parts[1].motion = bundle.parts[1].motion @ turn
    record = part_pose_errors(truth, bundle)[0]
    assert record["part_rotation"] == pytest.approx(math.degrees(0.2))
    assert record["part_translation"] == pytest.approx(0, abs=1e-9)


def test_a_shift_is_its_length(truth, bundle):
    bundle.parts[2].motion = motion([0.0, 0.0, 0.0], [0.0, 0.3, 0.4]) @ bundle.parts[2].motion
    record = part_pose_errors(truth, bundle)[1]
    assert record["part_rotation"] == pytest.approx(0, abs=1e-6)
    assert record["part_translation"] == pytest.approx(0.5)


@pytest.mark.parametrize(("missing", "known"), [(2, ["door"]), (0, [])])
def test_what_the_estimate_lacks_is_null(truth, bundle, missing, known):
    bundle.parts.pop(missing)
    records = part_pose_errors(truth, bundle)
    assert len(records) == 2
    assert [r["name"] for r in records if r["part_rotation"] is not None] == known
