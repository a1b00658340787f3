import pytest
import torch
from part_scene import box, motion, photograph

from splatart_ns.splats.splat import Splat
from splatart_ns.stages import pose_evidence
from splatart_ns.stages.covisibility import compared_by_common, covisible
from splatart_ns.stages.part_pair import part_pair
from splatart_ns.stages.pose_evidence import refine_poses
from splatart_ns.stages.visibility import clearest

OPENED = motion((0, 0, 0), (0.5, 0.0, 0.0))
POSES = torch.stack([torch.eye(4).double(), torch.eye(4).double(), torch.eye(4).double(), OPENED]).view(2, 2, 4, 4)


@pytest.fixture(scope="module")
def drawer():
    """A drawer (part 2) in a case, shut and open; its sides are in the open state's splat alone."""
    case = box(1, (1.0, 0.7, 0.5), (0.0, 0.0, 0.0))
    case = case.select(case.means[:, 0] < 0.49)
    whole = box(2, (0.94, 0.58, 0.38), (0.05, 0.0, 0.0))
    front = whole.select(whole.means[:, 0] > 0.51)
    pulled = whole.select(whole.means[:, 0] > 0.03).transformed(OPENED)
    splats = Splat.cat([case, front]), Splat.cat([case, pulled])
    return splats, tuple(photograph(s) for s in splats)


@pytest.fixture(scope="module")
def common(drawer):
    splats, views = drawer
    return covisible(splats, views, tuple(clearest(s, v) for s, v in zip(splats, views, strict=True)), POSES[1])


def test_what_a_shut_drawer_hides_is_not_common_and_its_front_and_the_case_are(drawer, common):
    (shut, opened), _ = drawer
    of_drawer = opened.part_ids == 2
    front = opened.means[:, 0] > 1.01
    assert common[1][of_drawer & front].float().mean() > 0.95
    assert common[1][of_drawer & ~front].float().mean() < 0.1
    assert common[0][shut.part_ids == 2].all()
    for splat, both in zip((shut, opened), common, strict=True):
        assert both[splat.part_ids == 1].float().mean() > 0.9


def test_pixels_count_as_far_as_they_show_what_is_common(drawer, common):
    splats, views = drawer
    pair = part_pair(splats, views, 2, 10, 10**6)
    of_drawer = [both[s.part_ids == 2] for both, s in zip(common, splats, strict=True)]
    masked = compared_by_common(pair, of_drawer)
    for before, after in zip(pair.views[1], masked.views[1], strict=True):
        sides = before.share(pair.splats[1], ~of_drawer[1])
        torch.testing.assert_close(after.weight, before.weight * (1 - sides))
    assert sum(float((b.weight - a.weight).sum()) for b, a in zip(pair.views[1], masked.views[1], strict=True)) > 100
    everything = [torch.ones_like(both) for both in of_drawer]
    assert compared_by_common(pair, everything) is pair


def test_where_hardly_anything_is_common_everything_is_compared(drawer, common):
    splats, views = drawer
    pair = part_pair(splats, views, 2, 10, 10**6)
    few = [torch.arange(int((s.part_ids == 2).sum())) < 3 for s in splats]
    assert compared_by_common(pair, few) is pair


def test_a_drawer_is_found_better_by_what_both_states_show(drawer, monkeypatch):
    frozen = torch.tensor([[True, True], [True, False]])

    def error():
        T, *_ = refine_poses(*drawer, POSES, frozen)
        return float((T[1, 1, :3, 3] - OPENED[:3, 3]).norm())

    by_common = error()
    monkeypatch.setattr(pose_evidence, "compared_by_common", lambda pair, common: pair)
    assert by_common < 0.75 * error()
