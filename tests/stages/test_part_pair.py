from dataclasses import replace

import pytest
import torch
from part_scene import motion, photograph, two_states

from splatart_ns.geometry.spherical_harmonics import SH_C0
from splatart_ns.stages.part_pair import CHROMA_WEIGHT, IN_EVEN_LIGHT, best_views, part_pair, part_view

EYE = torch.eye(4, dtype=torch.float64)


@pytest.fixture(scope="module")
def scene():
    return two_states(motion((0, 0, 25), (0.3, 0.0, 0.0)))


def test_only_the_part_and_the_background_count(scene):
    view = scene[1][0][0]
    piece = part_view(view, 2)
    left, top = (round(float(x)) for x in (view.K - piece.K)[:2, 2])
    labels = view.labels[top:, left:][: piece.weight.shape[0], : piece.weight.shape[1]]
    assert torch.equal(piece.weight, (labels != 1).float())
    assert piece.area == (view.labels == 2).sum()


def test_unlabelled_pixels_do_not_count(scene):
    view = scene[1][0][0]
    labels = view.labels.clone()
    view.labels = labels.clone().masked_fill_(labels == 0, 255)
    piece = part_view(view, 2)
    view.labels = labels
    assert (piece.weight.sum() == piece.area) and piece.area > 0


def test_a_view_that_does_not_show_the_part_says_nothing(scene):
    view = scene[1][0][0]
    assert part_view(replace(view, labels=torch.where(view.labels == 2, 1, view.labels)), 2) is None
    assert part_view(replace(view, mask=view.labels != 2), 2) is None


def test_a_smaller_piece_shows_the_same(scene):
    splats, views = scene
    part = splats[0].select(splats[0].part_ids == 2)
    for factor in (1, 2, 3):
        piece = part_view(views[0][0], 2, factor)
        image = piece.render(part, EYE[None])[0]
        inside = piece.weight == 1
        assert (image - piece.rgba)[inside].abs().mean() < 0.02, factor


def test_a_narrow_piece_is_a_piece_of_the_wide_one(scene):
    wide, narrow = (part_view(scene[1][0][0], 2, near=near) for near in (False, True))
    left, top = (round(float(x)) for x in (wide.K - narrow.K)[:2, 2])
    height, width = narrow.weight.shape
    assert narrow.weight.numel() < 0.85 * wide.weight.numel() and narrow.area == wide.area
    assert torch.equal(narrow.rgba, wide.rgba[top:, left:][:height, :width])


def test_the_right_motion_costs_least(scene):
    splats, views = scene
    truth = motion((0, 0, 25), (0.3, 0.0, 0.0))
    pair = part_pair(splats, views, 2, num_views=4, pixels=500)
    wrong = [motion((0, 0, 25 + a), (0.3 + t, 0, 0)) for a, t in ((180, 0), (5, 0), (-5, 0), (0, 0.05), (0, -0.05))]
    cost = pair.cost(torch.stack([truth, EYE, *wrong]))
    assert (cost[1:] > 1.5 * cost[0]).all()


def test_views_are_chosen_that_show_the_part_from_all_around(scene):
    views = scene[1][0]
    chosen = best_views(views, 2, 4)
    assert len({v.name for v in chosen}) == 4
    directions = torch.stack([v.viewmat[2, :3] for v in chosen])
    assert (directions @ directions.T).amin() < -0.3
    assert len(best_views(views, 2, 99)) <= len(views)
    assert best_views(views, 7, 4) == []


def test_unlabelled_views_are_not_chosen(scene):
    views = [replace(v, labels=None) if i % 2 else v for i, v in enumerate(scene[1][0])]
    assert {v.name for v in best_views(views, 2, 99)} <= {v.name for v in views[::2]}
    assert best_views([replace(v, labels=None) for v in views], 2, 4) == []


def test_a_part_that_a_state_lacks_makes_no_pair(scene):
    splats, views = scene
    without = splats[1].select(splats[1].part_ids != 2)
    assert part_pair((splats[0], without), views, 2, num_views=3, pixels=500) is None


def test_a_change_of_hue_counts_for_more_than_one_of_brightness(scene):
    """Where hues are asked for; otherwise both count alike."""
    piece, empty = part_view(scene[1][0][0], 2), scene[0][0].select(torch.zeros(len(scene[0][0]), dtype=torch.bool))
    shift = 0.1 * piece.rgba[..., 3:]

    def change(rgb, **weight):
        changed = replace(piece, rgba=piece.rgba + torch.cat([shift * torch.tensor(rgb), 0 * shift], dim=-1))
        return (
            changed.difference(empty, EYE[None], **weight)[0] - piece.difference(empty, EYE[None], **weight)[0]
        ).norm()

    brighter, redder = (1.0, 1.0, 1.0), (2**0.5, -(2**-0.5), -(2**-0.5))
    assert change(redder) == pytest.approx(float(change(brighter)), rel=1e-3)
    assert change(redder, chroma_weight=CHROMA_WEIGHT) > 6 * change(brighter, chroma_weight=CHROMA_WEIGHT)
    assert change(brighter, chroma_weight=CHROMA_WEIGHT) == pytest.approx(float(change(brighter)), rel=1e-3)


def test_no_pixel_is_left_out_where_something_shows(scene):
    (splat, other), views = scene
    part = other.select(other.part_ids == 2)
    T = torch.stack([EYE, motion((0, 0, 25), (0.3, 0.0, 0.0))])
    for view in views[0][:3]:
        piece = part_view(view, 2)
        difference, weight = piece.difference(part, T, chroma_weight=1.0, brightness_weight=1.0)
        everywhere = piece.render(part, T) - piece.rgba
        expected = (everywhere.square().sum(-1) * piece.weight).sum((1, 2))
        torch.testing.assert_close((difference.square().sum(-1) * weight).sum(1), expected)
        assert len(weight) < piece.weight.numel() and (weight > 0).all()


def test_in_even_light_colours_that_are_darker_alike_cost_no_more_than_grey_ones(scene):
    """A saturated colour that is lit less has less of its hue, too."""
    (splat, other), views = scene
    T = motion((0, 0, 25), (0.3, 0.0, 0.0))[None]
    costs = {}
    for name, colour in (("grey", (0.7, 0.7, 0.7)), ("yellow", (0.9, 0.7, 0.0))):
        plain = ((torch.tensor(colour) - 0.5) / SH_C0).expand(len(splat), 1, 3)
        dark = ((0.6 * torch.tensor(colour) - 0.5) / SH_C0).expand(len(splat), 1, 3)
        splats = replace(splat, sh=plain), replace(other, sh=dark)
        pair = part_pair(splats, tuple(photograph(s) for s in splats), 2, num_views=3, pixels=400)
        even = replace(pair, **IN_EVEN_LIGHT)
        costs[name] = float(even.cost(T)[0]), float(replace(even, even_light=False).cost(T)[0])
    even, uneven = zip(*costs.values(), strict=True)
    assert even[1] < 3 * even[0]
    assert even[1] < 0.1 * uneven[1]
