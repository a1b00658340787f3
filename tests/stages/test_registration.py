import numpy as np
import pytest
import torch
from part_scene import angle_deg, box, motion

from splatart_ns.stages.registration import PartPoints, distinct, part_points, point_to_plane, register


def wedge(count: int = 800, seed: int = 0) -> PartPoints:
    """Points on a part without symmetry, coloured along its length."""
    rng = np.random.default_rng(seed)
    t = rng.random((count, 2))
    bar = np.stack([t[:, 0], 0.1 * t[:, 1], np.zeros(count)], axis=1)
    arm = np.stack([0.1 * t[:, 1], 0.5 * t[:, 0], 0.3 * t[:, 0] ** 2], axis=1)
    xyz = np.where((np.arange(count) % 2 == 0)[:, None], bar, arm)
    return PartPoints(xyz, np.stack([t[:, 0], 1 - t[:, 0], np.full(count, 0.5)], axis=1), np.ones(count))


def moved(points: PartPoints, T: torch.Tensor, noise: float = 0.0) -> PartPoints:
    T = T.numpy()
    xyz = points.xyz @ T[:3, :3].T + T[:3, 3] + np.random.default_rng(1).normal(0, noise, points.xyz.shape)
    return PartPoints(xyz, points.rgb, points.weight)


def displacement(T: np.ndarray, truth: torch.Tensor, points: PartPoints) -> float:
    difference = T[:3] - truth.numpy()[:3]
    return float(np.linalg.norm(difference @ np.append(points.centroid, 1)) / points.radius)


@pytest.mark.parametrize("rotation", [(0, 0, 0), (0, 0, 90), (100, 60, -120), (170, 0, 0), (0, 180, 0)])
def test_a_motion_is_recovered_however_far_the_part_turned(rotation):
    truth = motion(rotation, (0.7, -2.0, 0.3))
    source = wedge()
    best = register(source, moved(source, truth, noise=0.005))[0]
    assert angle_deg(torch.from_numpy(best), truth) < 1
    assert displacement(best, truth, source) < 0.01


def test_a_part_half_hidden_in_one_state_is_still_found():
    truth = motion((0, 0, 40), (0.5, 0.2, 0.0))
    source = wedge()
    target = moved(source, truth, noise=0.003)
    seen = source.xyz[:, 0] < 0.75
    target = PartPoints(target.xyz[seen], target.rgb[seen], target.weight[seen])
    best = register(source, target)[0]
    assert angle_deg(torch.from_numpy(best), truth) < 5
    assert displacement(best, truth, source) < 0.1


def test_a_drawer_that_was_shut_is_found_by_its_front():
    """Nothing but the front is seen of it at first; then the inside, too."""
    rng = np.random.default_rng(0)
    front = np.stack([np.zeros(400), *(rng.random((2, 400)) - 0.5)], axis=1) * [0.0, 1.0, 0.5]
    sides = np.stack([-rng.random(900), *np.sign(rng.random((2, 900)) - 0.5) / 2], axis=1)
    sides[:450, 1], sides[450:, 2] = rng.random(450) - 0.5, rng.random(450) - 0.5
    back = front[:300] - [1.0, 0.0, 0.0]
    opened = np.concatenate([front, sides * [1.0, 1.0, 0.5], back])
    rgb = np.full(opened.shape, 0.4)
    rgb[:400, 0], rgb[:400, 1] = 0.8, 0.5 + 0.4 * np.sign(front[:, 1])
    truth = motion((0, 0, 0), (0.8, 0.0, 0.0))
    shut = PartPoints(front, rgb[:400], np.ones(400))
    found = register(shut, moved(PartPoints(opened, rgb, np.ones(len(opened))), truth, noise=0.004))
    slides = [T for T in found if np.allclose(T[:3, :3], np.eye(3))]
    assert min(displacement(T, truth, shut) for T in slides) < 0.05


def test_colours_tell_the_ends_of_a_bar_apart():
    rng = np.random.default_rng(0)
    xyz = rng.random((500, 3)) * [1.0, 0.1, 0.1]
    bar = PartPoints(xyz, np.repeat(xyz[:, :1], 3, axis=1), np.ones(500))
    truth = motion((0, 0, 170), (0.0, 0.0, 0.0))
    found = register(bar, moved(bar, truth))
    R = torch.from_numpy(found[0, :3, :3])
    # Its turn about its own axis shows in nothing, but which end is which does.
    assert (R @ torch.tensor([1.0, 0, 0]).double() - truth[:3, 0]).norm() < 0.1


def test_candidates_are_distinct():
    source = wedge()
    found = register(source, moved(source, motion((0, 0, 30), (0, 0, 0))))
    assert 1 < len(found) <= 24
    assert distinct(found, np.arange(len(found)), source.centroid, source.radius) == list(range(len(found)))


def test_registration_repeats_exactly():
    source = wedge()
    target = moved(source, motion((10, 20, 30), (0, 0, 0)), noise=0.01)
    assert np.array_equal(register(source, target, seed=3), register(source, target, seed=3))


def test_point_to_plane_refines_a_start_nearby():
    truth = motion((0, 0, 30), (0.3, 0.1, 0.0))
    splat = box(1, (1.0, 0.6, 0.2), (0.0, 0.0, 0.0))
    plate = part_points(splat, torch.ones(len(splat)), 1)
    start = (truth @ motion((2, -2, 3), (0.02, 0.0, 0.01))).numpy()
    (refined,) = point_to_plane(plate, moved(plate, truth), start[None])
    assert angle_deg(torch.from_numpy(refined), truth) < 0.5
    assert displacement(refined, truth, plate) < 0.01


def test_hidden_gaussians_and_other_parts_are_not_registered():
    splat = box(1, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    splat.part_logits[5:, 1], splat.part_logits[5:, 2] = -8.0, 0.0
    seen = torch.ones(len(splat))
    seen[0] = 0
    assert len(part_points(splat, seen, 1).xyz) == 4
