from dataclasses import replace

import torch
from part_scene import box, motion, photograph

from splatart_ns.splats.splat import Splat
from splatart_ns.stages import merge
from splatart_ns.stages.merge import covered, merge_parts
from splatart_ns.stages.visibility import shown, visibility

EYE = torch.eye(4, dtype=torch.float64)


def poses(T: torch.Tensor) -> torch.Tensor:
    return torch.stack([EYE.repeat(2, 1, 1), torch.stack([EYE, T])])


def test_what_one_state_hides_comes_from_another():
    T = motion((0, 0, 30), (0.0, 0.2, 0.6))
    base = box(1, (0.9, 0.6, 0.3), (0.0, 0.0, -0.3))
    drawer = box(2, (0.6, 0.4, 0.4), (0.0, 0.0, 0.1))
    lower = drawer.means[:, 2] < 0.1
    splats = [Splat.cat([base, drawer.select(~lower)]), Splat.cat([base, drawer.transformed(T)])]
    views = [photograph(s) for s in splats]
    merged = merge_parts(splats, views, poses(T))
    assert [int(p) for m in merged for p in m.part_ids.unique()] == [1, 2]
    # The drawer is all there, up to single Gaussians, in the canonical frame, and hardly anything twice.
    assert torch.cdist(drawer.means, merged[1].means).amin(1).max() < 0.1
    assert len(merged[1]) < 1.1 * len(drawer)
    assert len(merged[0]) < 1.1 * len(base)


def test_a_part_is_that_of_the_state_which_shows_most_of_it():
    dark = box(1, (0.8, 0.8, 0.8), (0.0, 0.0, 0.0))
    bright = replace(dark, sh=dark.sh + 1)
    much, little = torch.ones(len(dark)), torch.full((len(dark),), 0.1)
    for seen, best in (((much, little), dark), ((little, much), bright)):
        (merged,) = merge_parts([dark, bright], [photograph(dark, 2)] * 2, EYE.repeat(2, 1, 1, 1), seen=seen)
        assert torch.isin(merged.sh, best.sh).all() and len(merged) > 0.9 * len(dark)


def test_background_and_hidden_gaussians_are_left_out():
    cube = box(1, (0.8, 0.8, 0.8), (0.0, 0.0, 0.0))
    inside = box(1, (0.2, 0.2, 0.2), (0.0, 0.0, 0.0))
    floater = box(0, (0.1, 0.1, 0.1), (0.9, 0.0, 0.0))
    splat = Splat.cat([cube, inside, floater])
    T = EYE.repeat(2, 2, 1, 1)
    merged = merge_parts([splat, splat], [photograph(splat)] * 2, T)
    assert len(merged[0]) <= len(cube)
    assert merged[0].means.norm(dim=-1).amin() > 0.3
    assert torch.cdist(cube.means, merged[0].means).amin(1).max() < 0.12


def test_a_part_without_gaussians_stays_empty():
    splat = box(1, (0.8, 0.8, 0.8), (0.0, 0.0, 0.0))
    merged = merge_parts([splat, splat], [photograph(splat, 4)] * 2, EYE.repeat(2, 2, 1, 1))
    assert len(merged[1]) == 0


def test_a_point_is_covered_within_three_standard_deviations():
    splat = box(1, (0.1, 0.1, 0.1), (0.0, 0.0, 0.0), spacing=0.2).select(torch.tensor([0]))
    splat.means[:] = 0
    splat.log_scales = torch.tensor([[0.5, 0.1, 0.1]]).log()
    points = torch.tensor([[1.4, 0, 0], [1.6, 0, 0], [0, 0.29, 0], [0, 0.35, 0]])
    assert covered(points, splat, 0.0).tolist() == [True, False, True, False]
    assert covered(points, splat, 0.1).tolist() == [True, False, True, True]


def test_visibility_is_the_share_of_the_image():
    splat = box(1, (0.8, 0.8, 0.8), (0.0, 0.0, 0.0))
    views = photograph(splat, 4)
    seen = visibility(splat, views)
    alpha = torch.stack([v.alpha for v in views]).float() / 255
    assert torch.isclose(seen.sum(), alpha.sum() / 4, rtol=1e-2)


def test_gaussians_behind_others_are_not_shown():
    cube = box(1, (0.8, 0.8, 0.8), (0.0, 0.0, 0.0))
    inside = box(1, (0.2, 0.2, 0.2), (0.0, 0.0, 0.0))
    splat = Splat.cat([cube, inside])
    mask = shown(visibility(splat, photograph(splat)))
    assert mask[: len(cube)].float().mean() > 0.9
    assert not mask[len(cube) :].any()


def test_the_size_of_a_pixel_does_not_depend_on_which_state_is_first(monkeypatch):
    splat, told = box(1, (0.8, 0.8, 0.8), (0.0, 0.0, 0.0)), []
    monkeypatch.setattr(merge, "covered", lambda points, _, footprint: told.append(footprint) or points[:, 0] > 9)
    views = [photograph(splat, 4, size) for size in (24, 96)]
    for order in (views, views[::-1]):
        merge_parts([splat, splat], order, EYE.repeat(2, 1, 1, 1))
    assert told[0] == told[1] > 0
