import math
from dataclasses import replace

import pytest
import torch
from part_scene import box, motion, photograph

from splatart_ns.capture.hull import project
from splatart_ns.geometry.se3 import inverse, se3_log
from splatart_ns.splats.splat import Splat
from splatart_ns.stages import pose_evidence
from splatart_ns.stages.free_space import FreeSpace, strays, without_haze
from splatart_ns.stages.part_pair import part_pair
from splatart_ns.stages.pose_evidence import refine_poses

MOTION = motion((0.0, 0.0, -40.0), (0.05, 0.1, 0.0))
POSES = torch.eye(4).double().repeat(2, 2, 1, 1)
POSES[1, 1] = MOTION
COUNT = 15


@pytest.fixture(scope="module")
def scene():
    """A base (part 1) and a plate (part 2) that turns: splats, of which the first has haze at an edge of the plate, and
    views, which show none."""
    base = box(1, (0.9, 0.6, 0.3), (0.0, 0.0, -0.3))
    plate = box(2, (0.7, 0.4, 0.12), (0.1, 0.0, 0.2))
    row = torch.linspace(-0.2, 0.2, COUNT)
    haze = replace(
        plate.select(torch.arange(COUNT)),
        means=torch.stack([torch.full_like(row, -0.38), row, torch.full_like(row, 0.2)], -1),
        log_scales=torch.full((COUNT, 3), math.log(0.05)),
        opacity_logits=torch.full((COUNT,), 0.0),
    )
    clean = Splat.cat([base, plate]), Splat.cat([base, plate.transformed(MOTION)])
    return (Splat.cat([clean[0], haze]), clean[1]), tuple(photograph(s, 24, 96) for s in clean)


def test_gaussians_that_end_in_the_background_of_some_view_reach_free_space(scene):
    splats, views = scene
    reached = FreeSpace.of(views[0]).reached_by(splats[0])
    assert reached[-COUNT:].all()
    assert not reached[:-COUNT].any()


@pytest.mark.parametrize("without", ["alpha", "labels"])
def test_labels_or_silhouettes_alone_tell_what_is_empty(scene, without):
    splats, views = scene
    space = FreeSpace.of([replace(v, **{without: None}) for v in views[0]])
    reached = space.reached_by(splats[0])
    assert reached[-COUNT:].all()
    assert not reached[:-COUNT].any()


def test_views_that_tell_no_background_show_nothing_to_be_empty(scene):
    splats, views = scene
    assert not FreeSpace.of([replace(v, alpha=None, labels=None) for v in views[0]]).reached_by(splats[0]).any()


def test_pixels_that_a_mask_leaves_out_are_not_known_to_be_empty(scene):
    splats, views = scene
    masked = [replace(v, mask=torch.zeros_like(v.alpha, dtype=torch.bool)) for v in views[0]]
    assert not FreeSpace.of(masked).reached_by(splats[0]).any()


def test_of_many_views_some_are_asked(scene):
    _, views = scene
    assert len(FreeSpace.of(views[0] * 10).views) == 40


def test_a_pair_is_compared_without_haze(scene):
    splats, views = scene
    pair = part_pair(splats, views, 2, 10, 10**6, near=True)
    free = FreeSpace.of(views[0]), FreeSpace.of(views[1])
    clearer = without_haze(pair, MOTION, free)
    torch.testing.assert_close(clearer.splats[0].means, pair.splats[0].means[:-COUNT])
    assert len(clearer.splats[1]) == len(pair.splats[1])
    assert without_haze(clearer, MOTION, free) is clearer


def test_where_the_motion_is_quite_wrong_nothing_counts_as_haze(scene):
    splats, views = scene
    pair = part_pair(splats, views, 2, 10, 10**6, near=True)
    far = motion((0.0, 0.0, 0.0), (0.9, 0.0, 0.0)) @ MOTION
    assert without_haze(pair, far, tuple(map(FreeSpace.of, views))) is pair


def test_what_rests_fits_though_haze_comes_to_light(scene, monkeypatch):
    """What hides it in the first state is gone in the other."""
    hazy = scene[0][0].select(scene[0][0].part_ids == 2)
    cover, plate = box(1, (0.3, 0.6, 0.4), (-0.45, 0.0, 0.2)), hazy.select(torch.arange(len(hazy)) < len(hazy) - COUNT)
    away = motion((0.0, 0.0, 0.0), (-1.0, 0.0, 0.0))
    shut, opened = Splat.cat([cover, hazy]), Splat.cat([cover.transformed(away), plate])
    views = tuple(photograph(s, 24, 96) for s in (shut, opened))
    poses = torch.eye(4).double().repeat(2, 2, 1, 1)
    poses[1, 0] = away

    def misfits():
        return bool(refine_poses((shut, opened), views, poses, torch.ones(2, 2) > 0)[2].any())

    monkeypatch.setattr(pose_evidence, "MISFIT", 0.004)  # there is little haze
    assert not misfits()
    monkeypatch.setattr(pose_evidence, "without_haze", lambda pair, T, free: pair)
    assert misfits()


def test_haze_at_one_edge_pulls_no_part(scene, monkeypatch):
    splats, views = scene
    frozen = torch.tensor([[True, True], [True, False]])

    def error():
        T, *_ = refine_poses(splats, views, POSES, frozen)
        return float(se3_log(inverse(MOTION) @ T[1, 1]).norm())

    clear = error()
    monkeypatch.setattr(pose_evidence, "without_haze", lambda pair, T, free: pair)
    assert clear < 0.5 * error()


def test_what_one_state_hides_and_another_shows_in_free_space_is_a_stray():
    """A drawer's tail lies in its cabinet while it is open, and sticks out behind once it is shut."""
    shut = motion((0, 0, 0), (0.0, 0.5, 0.0))
    cabinet, drawer = box(1, (0.6, 0.9, 0.5), (0.0, 0.0, 0.0)), box(2, (0.4, 0.4, 0.3), (0.0, -0.5, 0.0))
    tail = box(2, (0.3, 0.06, 0.2), (0.0, 0.15, 0.0))
    tail = tail.select(torch.arange(0, len(tail), len(tail) // 12))
    poses = torch.eye(4).double().repeat(2, 2, 1, 1)
    poses[1, 1] = shut
    views = [photograph(Splat.cat([cabinet, drawer.transformed(T)]), 24, 96) for T in (torch.eye(4).double(), shut)]
    free, known = [FreeSpace.of(of_state) for of_state in views], torch.ones(2, 2, dtype=torch.bool)
    splat = Splat.cat([cabinet, drawer, tail])
    found = strays(splat, free, poses, known)
    assert found[-len(tail) :].all() and not found[: -len(tail)].any()
    unknown = known.index_put((torch.tensor(1), torch.tensor(1)), torch.tensor(False))
    assert not strays(splat, free, poses, unknown).any()
    # A pose that brings a fifth of a part there is not believed.
    poses[1, 1] = motion((0, 0, 0), (0.3, 0.5, 0.0))
    assert not strays(splat, free, poses, known).any()


def test_what_hangs_where_few_views_look_is_a_stray_if_they_show_nothing_there():
    thing = box(1, (0.6, 0.9, 0.5), (0.0, 0.0, 0.0))
    views = photograph(thing, 24, 96)
    above = torch.tensor([[0.0, 0.0, 5.0], [0.0, 0.0, 6.0]])
    assert sum(project(view, above)[3].int() for view in views).tolist() == [2, 2]
    free = FreeSpace.of(views)
    assert free.holds(above).all() and not free.holds(thing.means).any()
    assert not FreeSpace.of(views[:0]).holds(above).any()  # where nobody looks, nothing is known
