import numpy as np
import pytest
import torch

from splatart_ns.evaluation import geometry
from splatart_ns.evaluation.geometry import chamfer, chamfer_centres, chamfer_mesh, farthest_points
from splatart_ns.geometry.se3 import so3_exp


def test_chamfer_sums_mean_squared_distances_of_both_directions():
    a = np.array([[0.0, 0, 0]])
    b = np.array([[1.0, 0, 0], [0, 2, 0]])
    assert chamfer(a, b) == pytest.approx(1000 * (1 + (1 + 4) / 2))
    assert chamfer(b, a) == chamfer(a, b)
    assert chamfer(b, b) == 0


def test_farthest_points_take_the_middle_then_the_ends():
    line = np.array([[float(x), 0, 0] for x in (0, 1, 2, 3, 4, 9, 10)])
    chosen = farthest_points(line, 3)
    assert line[chosen, 0].tolist() == [4.0, 10.0, 0.0]


def test_farthest_points_are_all_points_where_there_are_few():
    assert farthest_points(np.zeros((3, 3)), 5).tolist() == [0, 1, 2]


def test_farthest_points_ignore_density():
    rng = np.random.default_rng(0)
    points = np.concatenate([0.1 * rng.random((5000, 3)), [2.0, 0, 0] + 0.1 * rng.random((50, 3))])
    chosen = farthest_points(points, 40)
    assert len(set(chosen)) == 40
    assert (points[chosen, 0] > 1).sum() > 10


def test_centres_on_the_true_points_have_no_distance(truth, bundle):
    values = chamfer_centres(truth, bundle)
    for at in (values, values["last"]):
        for key in ("CD-s", "CD-m", "CD-w"):
            assert at[key] == pytest.approx(0, abs=1e-9)


def test_a_shifted_part_counts_in_its_own_and_the_whole(truth, bundle):
    bundle.parts[1].splat.means[:, 0] += 0.01
    values = chamfer_centres(truth, bundle)
    assert values["CD-s"] == pytest.approx(0, abs=1e-9)
    # No point has another one nearer than its own twin at 0.01.
    assert values["parts"]["door"] == pytest.approx(1000 * 2 * 0.01**2, rel=0.2)
    assert values["CD-m"] == pytest.approx(values["parts"]["door"] / 2, rel=1e-6)
    assert values["CD-w"] == pytest.approx(values["parts"]["door"] / 3, rel=0.2)


def test_a_wrong_motion_shows_at_the_last_state_alone(truth, bundle):
    bundle.parts[2].motion = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    values = chamfer_centres(truth, bundle)
    assert values["CD-m"] == pytest.approx(0, abs=1e-9)
    assert values["last"]["parts"]["latch"] > 1
    assert values["last"]["parts"]["door"] == pytest.approx(0, abs=1e-9)


def test_the_last_state_is_seen_from_the_true_root(truth, bundle):
    """In whatever world the estimate has it, and whatever it takes for its root."""
    G = torch.eye(4, dtype=torch.float64)
    G[:3, :3], G[:3, 3] = so3_exp(torch.tensor([0.3, 1.0, -2.0])), torch.tensor([5.0, 6, 7])
    for part in bundle.parts:
        part.motion[1] = G @ part.motion[1]
    bundle.root = "door"
    last = chamfer_centres(truth, bundle)["last"]
    assert [last[key] for key in ("CD-s", "CD-m", "CD-w")] == pytest.approx([0, 0, 0], abs=1e-6)


def test_a_missing_part_is_null(truth, bundle):
    bundle.parts.pop(2)
    values = chamfer_centres(truth, bundle)
    assert values["parts"]["latch"] is None
    assert values["parts"]["door"] == 0 and values["CD-m"] is None  # it would seem the better for it


def test_the_mesh_is_scored_at_both_ends(truth, bundle):
    values = chamfer_mesh(truth, bundle)
    for at in (values, values["last"]):
        # Sixty true points in each half of a unit: no surface around them lies further off than their spread.
        assert all(0 < at[key] < 1000 * 2 * 0.3**2 for key in ("CD-s", "CD-m", "CD-w"))
    bundle.parts[2].motion = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    wrong = chamfer_mesh(truth, bundle)
    # Where the latch is tells what it hides of the others.
    assert wrong["parts"] == pytest.approx(values["parts"], rel=0.05)
    assert wrong["last"]["parts"]["latch"] > values["last"]["parts"]["latch"] + 1
    assert wrong["last"]["CD-s"] == pytest.approx(values["last"]["CD-s"], rel=0.05)


def test_the_mesh_is_closed_where_no_camera_looked_as_in_exports(truth, bundle, monkeypatch):
    seen_by, made = [], geometry.part_surface
    monkeypatch.setattr(geometry, "part_surface", lambda *given: seen_by.append(given[1]) or made(*given))
    bundle.provenance["cameras"] = [[[0.0, 0.0, 9.0]], [[0.0, 9.0, 0.0]]]
    chamfer_mesh(truth, bundle)
    assert [len(cameras) for cameras in seen_by] == [2] * len(bundle.parts)


def test_a_part_that_nobody_sees_has_no_mesh(truth, bundle):
    bundle.parts[2].splat.opacity_logits[:] = -10
    values = chamfer_mesh(truth, bundle)
    assert values["parts"]["latch"] is None
    assert values["parts"]["door"] > 0 and values["CD-m"] is None
