import math
from dataclasses import replace

import pytest
import torch
from part_scene import angle_deg, box, photograph

from splatart_ns.capture.capture import UNLABELLED
from splatart_ns.geometry.se3 import from_rotation_translation, inverse, so3_exp, transform_points
from splatart_ns.splats.splat import Splat
from splatart_ns.stages import pose_evidence
from splatart_ns.stages.flush import (
    REACH,
    TRACE,
    border_against_others,
    compared_by_seen,
    in_sight,
    is_flush,
    surface_depths,
    without_neighbours,
)
from splatart_ns.stages.part_pair import part_pair
from splatart_ns.stages.pose_evidence import refine_poses

HINGE = torch.tensor([0.25, -0.3, 0.0], dtype=torch.float64)


def turned(degrees: float) -> torch.Tensor:
    """[4, 4] of the door about its hinge, which is upright."""
    R = so3_exp(torch.tensor([0.0, 0.0, math.radians(-degrees)], dtype=torch.float64))
    return from_rotation_translation(R, HINGE - R @ HINGE)


OPENED = turned(70)
POSES = torch.stack([torch.eye(4).double(), torch.eye(4).double(), torch.eye(4).double(), OPENED]).view(2, 2, 4, 4)


@pytest.fixture(scope="module")
def cupboard():
    """A case (part 1) with a door (part 2) in its front, shut and open: splats and views."""
    case = box(1, (0.5, 1.0, 0.8), (0.0, 0.0, 0.0), 0.03)
    x, y, z = case.means.unbind(-1)
    front = case.select(~((x > 0.24) & (y.abs() < 0.28) & (z.abs() < 0.23)))
    door = box(2, (0.03, 0.55, 0.45), (0.235, 0.0, 0.0), 0.03)
    face = door.select(door.means[:, 0] > 0.249)
    # Nothing keeps what the face hides: some of its Gaussians reach far into the case.
    lengths, means = face.log_scales.clone(), face.means.clone()
    lengths[::8, 0] = math.log(0.08)
    means[::8, 0] -= 0.1
    hazy = replace(face, means=means, log_scales=lengths)
    splats = Splat.cat([front, hazy]), Splat.cat([front, door.transformed(OPENED)])
    photographed = Splat.cat([front, face]), splats[1]
    return splats, tuple(photograph(s, 24, 128) for s in photographed)


def test_a_shut_door_is_flush_and_an_open_one_and_its_case_are_not(cupboard):
    _, (shut, opened) = cupboard
    assert is_flush(shut, 2)
    assert not is_flush(opened, 2)
    assert not is_flush(shut, 1)


def test_pixels_without_a_label_are_no_border(cupboard):
    _, (shut, _) = cupboard
    unlabelled = [replace(v, labels=torch.where(v.labels == 1, UNLABELLED, v.labels)) for v in shut]
    assert not is_flush(unlabelled, 2)
    assert not is_flush([replace(v, labels=None) for v in shut], 2)


def test_border_against_others_counts_pixel_edges_in_all_labelled_views(cupboard):
    _, (view, *_) = cupboard[1]
    labels = torch.zeros_like(view.labels)
    labels[4:8, 4:8], labels[4:8, 8:12] = 1, 2  # a square of 16 edges, 4 of them against another
    seen = replace(view, labels=labels, alpha=(labels > 0).to(view.alpha))
    assert border_against_others([seen, replace(seen, labels=None)], 1) == pytest.approx(4 / 16)
    assert border_against_others([replace(seen, labels=None)], 1) == 0


@pytest.fixture(scope="module")
def depths(cupboard):
    return [surface_depths(splat, views) for splat, views in zip(*cupboard, strict=True)]


def shows_best(views, part):
    return max(range(len(views)), key=lambda k: int((views[k].labels == part).sum()))


def test_what_lies_flush_around_a_part_is_emptied_and_nothing_else(cupboard, depths):
    shut = cupboard[1][0]
    k = shows_best(shut, 2)
    view, emptied = shut[k], without_neighbours(shut[k], depths[0][k], 2)
    own = (view.labels == 2).float()[None, None]
    near = torch.nn.functional.max_pool2d(own, 2 * REACH + 1, 1, REACH)[0, 0] > 0
    changed = emptied.labels != view.labels
    assert (view.labels[changed] == 1).all() and (emptied.labels[changed] == 0).all()
    assert (emptied.alpha[changed] == 0).all()
    torch.testing.assert_close(emptied.alpha[~changed], view.alpha[~changed])
    assert not (changed & ~near).any()
    beside = torch.nn.functional.max_pool2d(own, 3, 1, 1)[0, 0] > 0
    assert changed[beside & (view.labels == 1)].all()


def test_what_lies_before_a_part_or_has_no_known_depth_stays(cupboard, depths):
    shut = cupboard[1][0]
    k = shows_best(shut, 2)
    view, depth = shut[k], depths[0][k]
    before = torch.where(view.labels == 1, depth - 0.3, depth)
    assert torch.equal(without_neighbours(view, before, 2).labels, view.labels)
    unknown = torch.where(view.labels == 1, torch.inf, depth)
    assert torch.equal(without_neighbours(view, unknown, 2).labels, view.labels)


def test_pixels_without_a_label_stay_so(cupboard, depths):
    shut = cupboard[1][0]
    k = shows_best(shut, 2)
    unlabelled = replace(shut[k], labels=torch.where(shut[k].labels == 1, UNLABELLED, shut[k].labels))
    assert torch.equal(without_neighbours(unlabelled, depths[0][k], 2).labels, unlabelled.labels)


def test_a_view_without_labels_alpha_or_the_part_is_no_error(cupboard, depths):
    shut = cupboard[1][0]
    k = shows_best(shut, 2)
    bare = replace(shut[k], labels=None)
    assert without_neighbours(bare, depths[0][k], 2) is bare
    hidden = next(n for n, v in enumerate(shut) if not (v.labels == 2).any())
    assert without_neighbours(shut[hidden], depths[0][hidden], 2) is shut[hidden]
    emptied = without_neighbours(replace(shut[k], alpha=None), depths[0][k], 2)
    assert emptied.alpha is None and (emptied.labels != shut[k].labels).any()


def test_gaussians_that_reach_into_what_no_view_shows_are_not_in_sight(cupboard, depths):
    splats, views = cupboard
    face = splats[0].select(splats[0].part_ids == 2)
    seen = in_sight(face, views[0], depths[0], 2)
    hazy = torch.arange(len(face)) % 8 == 0
    assert not seen[hazy].any()
    assert seen[~hazy].float().mean() > 0.95


def test_gaussians_that_reach_over_the_border_are_not_in_sight(cupboard, depths):
    splats, views = cupboard
    face = splats[0].select(splats[0].part_ids == 2)
    longer = face.log_scales.clone()
    longer[:, 1] = math.log(0.1)
    seen = in_sight(replace(face, log_scales=longer), views[0], depths[0], 2)
    straight = torch.arange(len(face)) % 8 != 0
    middle = face.means[:, 1].abs() < 0.05
    assert seen[straight & middle].float().mean() > 0.9
    assert not seen[face.means[:, 1].abs() > 0.2].any()


def test_views_without_labels_show_ends_but_not_whose_they_are(cupboard, depths):
    splats, views = cupboard
    face = splats[0].select(splats[0].part_ids == 2)
    hazy = torch.arange(len(face)) % 8 == 0
    bare = [replace(v, labels=None) for v in views[0]]
    silent = [replace(v, labels=torch.full_like(v.labels, UNLABELLED)) for v in views[0]]
    few = [v if k == shows_best(views[0], 2) else b for k, (v, b) in enumerate(zip(views[0], bare, strict=True))]
    for some in (bare, silent, few):
        seen = in_sight(face, some, depths[0], 2)
        assert not seen[hazy].any() and seen[~hazy].float().mean() > 0.95


def test_pixels_that_show_what_was_not_in_sight_do_not_count(cupboard, depths):
    splats, views = cupboard
    pair = part_pair(splats, views, 2, 10, 10**6, near=True)
    seen = [in_sight(s, v, d, 2) for s, v, d in zip(pair.splats, views, depths, strict=True)]
    compared = compared_by_seen(pair, OPENED, seen)
    gone = 0
    for before, after in zip(pair.views[1], compared.views[1], strict=True):
        trace = before.share(pair.splats[0].transformed(OPENED), ~seen[0])
        torch.testing.assert_close(after.weight, before.weight * (1 - trace / TRACE).clamp(0, 1))
        gone += int((before.weight > after.weight + 0.5).sum())
    assert gone > 200
    everything = [torch.ones_like(s) for s in seen]
    for before, after in zip(pair.views[0], compared_by_seen(pair, OPENED, everything).views[0], strict=True):
        torch.testing.assert_close(after.weight, before.weight)
    upper = [s.means[:, 2] > 0 for s in pair.splats]
    for before, view in zip(pair.views[0], compared_by_seen(pair, OPENED, upper).views[0], strict=True):
        trace = before.share(pair.splats[1].transformed(inverse(OPENED)), ~upper[1])
        torch.testing.assert_close(view.weight, before.weight * (1 - trace / TRACE).clamp(0, 1))


def test_where_hardly_a_pixel_would_be_left_all_count(cupboard):
    splats, views = cupboard
    pair = part_pair(splats, views, 2, 10, 10**6, near=True)
    nothing = [torch.zeros(len(s), dtype=torch.bool) for s in pair.splats]
    assert compared_by_seen(pair, OPENED, nothing) is pair
    in_one_state = [nothing[0], ~nothing[1]]
    compared = compared_by_seen(pair, OPENED, in_one_state)
    own, left = (sum(float((v.weight * v.rgba[..., 3]).sum()) for v in p.views[1]) for p in (pair, compared))
    assert left < 0.1 * own


def test_a_door_that_was_shut_is_found_better(cupboard, monkeypatch):
    frozen = torch.tensor([[True, True], [True, False]])
    middle = torch.tensor([[0.235, 0.0, 0.0]], dtype=torch.float64)

    def errors():
        T, *_ = refine_poses(*cupboard, POSES, frozen)
        shift = transform_points(T[1, 1], middle) - transform_points(OPENED, middle)
        return angle_deg(T[1, 1], OPENED), float(shift.norm())

    angle, shift = errors()
    monkeypatch.setattr(pose_evidence, "is_flush", lambda views, part: False)
    angle_before, shift_before = errors()
    assert angle < 0.5
    assert angle < 0.95 * angle_before  # 0.87
    assert shift < 0.4 * shift_before


def test_a_part_that_lies_flush_in_one_state_keeps_what_reaches_into_the_background(cupboard, monkeypatch):
    asked = []
    monkeypatch.setattr(pose_evidence, "without_haze", lambda pair, T, free: asked.append(pair) or pair)
    refine_poses(*cupboard, POSES, torch.tensor([[True, True], [True, False]]))
    assert not asked
    monkeypatch.setattr(pose_evidence, "is_flush", lambda views, part: False)
    refine_poses(*cupboard, POSES, torch.tensor([[True, True], [True, False]]))
    assert len(asked) == 1
