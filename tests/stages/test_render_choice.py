from dataclasses import replace

import numpy as np
import pytest
import torch
from part_scene import OPENED, angle_deg, lit_lid, motion, two_states

from splatart_ns.stages import render_choice
from splatart_ns.stages.motion_preference import (
    DOUBTFUL,
    looks_alike,
)
from splatart_ns.stages.part_pair import part_pair
from splatart_ns.stages.render_choice import (
    VIEWS,
    PartLook,
    appearance_cost,
    choose,
    mere_shifts,
    own_appearance,
    part_look,
    ranked,
    refined,
)

TRUTH = motion((0, 0, 70), (0.3, 0.2, 0.1))


@pytest.fixture(scope="module")
def scene():
    return two_states(TRUTH)


def test_rendering_chooses_among_flipped_candidates(scene):
    splats, views = scene
    pair = part_pair(splats, views, 2, num_views=3, pixels=400)
    c = pair.centroid.numpy()
    flips = []
    for axis in np.eye(3):
        F = motion(tuple(180 * axis), (0, 0, 0)).numpy()
        F[:3, 3] = c - F[:3, :3] @ c
        flips.append(TRUTH @ torch.from_numpy(F))
    candidates = torch.stack([*flips, TRUTH])
    assert torch.equal(choose(pair, candidates, similar=1e9, keep=4)[0], TRUTH)


def test_candidates_much_worse_than_the_best_and_twins_are_dropped(scene):
    splats, views = scene
    pair = part_pair(splats, views, 2, num_views=3, pixels=400)
    twin = TRUTH @ motion((0, 0, 1), (0, 0, 0))
    far = TRUTH @ motion((90, 0, 0), (2, 0, 0))
    assert len(choose(pair, torch.stack([twin, TRUTH, far]), similar=2.5)) == 1


def test_a_quite_different_motion_is_kept_beside_many_alike(scene):
    splats, views = scene
    pair = part_pair(splats, views, 2, num_views=3, pixels=400)
    alike = [TRUTH @ motion((0, 0, degrees), (0, 0, 0)) for degrees in (0, 7, -7, 14)]
    other = TRUTH @ motion((90, 0, 0), (0, 0, 0))
    kept = choose(pair, torch.stack([*alike, other]), similar=1e9)
    assert len(kept) == 4 and torch.equal(kept[-1], other)


def test_what_fits_as_each_states_own_gaussians_do_is_kept_and_looks_alike_however_well_another_fits(scene):
    splats, views = scene
    pair = part_pair(splats, views, 2, num_views=3, pixels=400)
    other = TRUTH @ motion((90, 0, 0), (0, 0, 0))
    motions = torch.stack([TRUTH, other])
    cost = appearance_cost(pair, motions)
    assert own_appearance(pair) == pytest.approx(cost[0], rel=0.02)  # nothing of this part is hidden in one state
    for own, kept in ((cost[1], True), (0.8 * cost[1], False)):
        assert len(choose(pair, motions, similar=1.5, own=own)) == 1 + kept
        assert looks_alike(motions.numpy(), cost, 0, 1, own) == kept
    assert not looks_alike(motions.numpy(), cost, 0, 0, cost[1])


def test_where_the_right_turn_fits_no_slide_that_fits_worse_stands_for_turning_over():
    """A nearly symmetric knob: the images tell its turn, but hardly what lies behind it."""
    turn = motion((0, 0, 50), (0.0, 0.0, 0.0))
    splats, views = two_states(turn)
    pair = part_pair(splats, views, 2, num_views=3, pixels=400)
    still = refined(PartLook(pair, pair), turn[None])[0]
    over = turn @ motion((180, 0, 0), (0.0, 0.0, 0.0))
    ends = [replace(still, T=T) for T in (over, turn, torch.eye(4, dtype=torch.float64))]
    own = own_appearance(pair)
    for times, first in ((1.0, 1), (2.0, 2)):
        costs = iter([[times * own, 1.03 * times * own, 1.2 * times * own]])
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(render_choice, "appearance_cost", lambda *_, costs=costs: np.array(next(costs)))
            assert ranked(pair, ends).order[0] == first


def test_a_lid_stays_in_view_that_fits_much_worse_than_turned_over():
    splats, views = lit_lid(0.18)
    look = part_look(splats, views, 1, VIEWS)
    flip = motion((0, 180, 0), (0, 0, 0))
    flip[:3, 3] = look.coarse.centroid - flip[:3, :3] @ look.coarse.centroid
    over = OPENED @ flip
    right, turned_over = appearance_cost(look.coarse, torch.stack([OPENED, over]))
    assert 1.5 * turned_over < right < DOUBTFUL * turned_over
    best = ranked(look.fine, refined(look, torch.stack([OPENED, over]))).best
    assert angle_deg(best.T, OPENED) < 1


def test_where_all_candidates_turn_the_part_over_a_mere_shift_is_tried():
    slide = motion((0, 0, 0), (0.3, 0.2, 0.1))
    splats, views = two_states(slide)
    pair = part_pair(splats, views, 2, num_views=3, pixels=400)
    over = motion((180, 0, 0), (0, 0, 0))
    over[:3, 3] = pair.centroid - over[:3, :3] @ pair.centroid
    ends = refined(PartLook(pair, pair), (slide @ over)[None])
    assert (ranked(pair, ends).best.T - slide).abs().max() < 0.01
    upright = refined(PartLook(pair, pair), slide[None])
    assert len(upright) == 1
    # Turned over, it may lie too far away for a shift from there.
    astray = over.clone()
    astray[:3, 3] += torch.tensor([1.2, -0.9, 0.8])
    tilted = slide @ motion((12, 0, 0), (0, 0, 0))
    ends = [replace(upright[0], T=T, cost=cost) for T, cost in ((tilted, 1.1), (astray, 1.0))]
    lost, found = mere_shifts(pair, ends)
    assert (found.T - slide).abs().max() < 0.01 < 0.5 < (lost.T - slide).abs().max()
    assert mere_shifts(pair, [replace(ends[0], cost=0.9), ends[1]]) == []
    assert len(mere_shifts(pair, ends[1:])) == 1
