from dataclasses import replace

import numpy as np
import pytest
import torch
from part_scene import angle_deg, box, motion, photograph, two_states

from splatart_ns.splats.splat import Splat
from splatart_ns.stages import render_choice
from splatart_ns.stages.motion_preference import (
    ALIKE,
    DOUBTFUL,
    looks_alike,
)
from splatart_ns.stages.part_pair import part_pair
from splatart_ns.stages.registration import part_points, register
from splatart_ns.stages.render_choice import (
    COARSE_PIXELS,
    FINE_PIXELS,
    SHADED_RATIO,
    STILL_RATIO,
    VIEWS,
    appearance_cost,
    choose,
    initial_motion,
    mere_shifts,
    own_appearance,
    ranked,
    refined,
)
from splatart_ns.stages.visibility import visibility

TRUTH = motion((0, 0, 70), (0.3, 0.2, 0.1))


@pytest.fixture(scope="module")
def scene():
    splats, views = two_states(TRUTH)
    return splats, views, tuple(visibility(s, v) for s, v in zip(splats, views, strict=True))


def test_rendering_chooses_among_flipped_candidates(scene):
    splats, views, _ = scene
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
    splats, views, _ = scene
    pair = part_pair(splats, views, 2, num_views=3, pixels=400)
    twin = TRUTH @ motion((0, 0, 1), (0, 0, 0))
    far = TRUTH @ motion((90, 0, 0), (2, 0, 0))
    assert len(choose(pair, torch.stack([twin, TRUTH, far]), similar=2.5)) == 1


def test_a_quite_different_motion_is_kept_beside_many_alike(scene):
    splats, views, _ = scene
    pair = part_pair(splats, views, 2, num_views=3, pixels=400)
    alike = [TRUTH @ motion((0, 0, degrees), (0, 0, 0)) for degrees in (0, 7, -7, 14)]
    other = TRUTH @ motion((90, 0, 0), (0, 0, 0))
    kept = choose(pair, torch.stack([*alike, other]), similar=1e9)
    assert len(kept) == 4 and torch.equal(kept[-1], other)


def test_what_fits_as_each_states_own_gaussians_do_is_kept_and_looks_alike_however_well_another_fits(scene):
    splats, views, _ = scene
    pair = part_pair(splats, views, 2, num_views=3, pixels=400)
    other = TRUTH @ motion((90, 0, 0), (0, 0, 0))
    motions = torch.stack([TRUTH, other])
    cost = appearance_cost(pair, motions)
    assert own_appearance(pair) == pytest.approx(cost[0], rel=0.02)  # nothing of this part is hidden in one state
    for own, kept in ((cost[1], True), (0.8 * cost[1], False)):
        assert len(choose(pair, motions, similar=1.5, own=own)) == 1 + kept
        assert looks_alike(motions.numpy(), cost, 0, 1, own) == kept
    assert not looks_alike(motions.numpy(), cost, 0, 0, cost[1])


def test_the_motion_of_a_part_is_found_from_splats_and_views(scene):
    found = initial_motion(*scene, part=2)
    assert found.found and not found.still
    assert angle_deg(found.T, TRUTH) < 0.3
    assert torch.allclose(found.T[:3, 3], TRUTH[:3, 3], atol=5e-3)
    assert found.identity_ratio > 3
    assert found.alike == ()


def test_the_other_turns_of_a_plain_square_part_are_told():
    plate = box(2, (0.6, 0.6, 0.12), (0.0, 0.0, 0.2), spacing=0.05)
    plate.sh = torch.zeros_like(plate.sh)
    base = box(1, (0.9, 0.6, 0.3), (0.0, 0.0, -0.3))
    T = motion((0, 0, 25), (0, 0, 0))
    splats = (Splat.cat([base, plate]), Splat.cat([base, plate.transformed(T)]))
    views = tuple(photograph(s) for s in splats)
    seen = tuple(visibility(s, v) for s, v in zip(splats, views, strict=True))
    found = initial_motion(splats, views, seen, part=2)
    turns = [angle_deg(found.T, other) for other in found.alike]
    assert any(abs(turn - 90) < 2 for turn in turns)
    assert all(min(abs(turn - quarter) for quarter in (90, 180)) < 2 for turn in turns)


@pytest.mark.parametrize("views_at_first", [1, 5])  # one, from above or below, shows nothing of the sides
def test_of_a_square_plate_painted_on_half_of_one_side_the_right_turn_is_found(monkeypatch, views_at_first):
    T = motion((0, 0, 115), (0.2, 0.1, 0.0))
    plate = box(1, (0.6, 0.6, 0.16), (0.0, 0.0, 0.0), spacing=0.05)
    painted = (plate.means[:, 0] > 0.28) & (plate.means[:, 1] > 0)
    plate.sh = torch.where(painted[:, None, None], plate.sh.new_tensor([1.0, -1.0, -1.0]), 0.0)
    splats = plate, plate.transformed(T)
    views = tuple(photograph(s, count=20) for s in splats)
    seen = tuple(visibility(s, v) for s, v in zip(splats, views, strict=True))
    monkeypatch.setattr(render_choice, "VIEWS", views_at_first)
    found = initial_motion(splats, views, seen, part=1)
    assert angle_deg(found.T, T) < 1
    assert found.alike == ()


def test_a_still_part_does_not_move_at_all(scene):
    found = initial_motion(*scene, part=1)
    assert found.still and not found.maybe_moved
    assert torch.equal(found.T, torch.eye(4, dtype=torch.float64))


def blotched_plate(T, colours):
    """Splats, views and visibilities of a square plate at two states; `colours` (means [N, 3], state) of it [N, 3]."""
    plate = box(1, (0.6, 0.6, 0.16), (0.0, 0.0, 0.0), spacing=0.05)
    splats, generator = (plate, plate.transformed(T)), torch.Generator().manual_seed(0)
    for state, splat in enumerate(splats):  # else no motion but the right one would fit at all
        blotches = 0.4 * torch.randn(len(plate.means), 1, generator=generator)
        splat.sh = (colours(plate.means, state) + blotches)[:, None]
    views = tuple(photograph(s, count=20) for s in splats)
    return splats, views, tuple(visibility(s, v) for s, v in zip(splats, views, strict=True))


@pytest.mark.parametrize("slid", [0.0, 0.002])
def test_that_a_part_rests_is_in_doubt_where_another_motion_fits_a_little_better(slid):
    """Its blotches differ between the states, so that no motion fits well; 0.002 are less than a tenth of a pixel."""
    T = motion((0, 0, 0), (slid, 0.0, 0.0))
    found = initial_motion(*blotched_plate(T, lambda x, _: 0.3 * torch.ones(3)), part=1)
    assert found.still and torch.equal(found.T, torch.eye(4, dtype=torch.float64))
    assert found.maybe_moved == (slid > 0)


def test_a_square_part_that_others_shade_elsewhere_has_not_turned():
    """The shadow on it, of a lid that opened, lies a quarter turn on."""
    eye = torch.eye(4, dtype=torch.float64)
    scene = blotched_plate(eye, lambda x, state: -0.2 * (x[:, state, None] > 0) * torch.ones(3))
    found = initial_motion(*scene, part=1)
    assert found.still and torch.equal(found.T, eye)
    assert found.identity_ratio > STILL_RATIO


def test_a_square_part_with_a_print_that_turned_a_quarter_did_not_stay():
    T = motion((0, 0, 90), (0, 0, 0))
    scene = blotched_plate(T, lambda x, _: 0.3 * (x[:, :2].amin(1) > 0.1)[:, None] * torch.tensor([1.0, -1.0, -1.0]))
    found = initial_motion(*scene, part=1)
    assert not found.still and angle_deg(found.T, T) < 2
    assert found.identity_ratio < SHADED_RATIO


def test_a_part_does_not_rest_for_that_what_is_preferred_fits_hardly_better(monkeypatch):
    """A print that turned a quarter; half a turn, were it preferred, would fit but half as badly as none."""
    T = motion((0, 0, 90), (0, 0, 0))
    blotches = blotched_plate(T, lambda x, _: 0.8 * (x[:, :2].amin(1) > 0.0)[:, None] * torch.tensor([1.0, -1.0, -1.0]))

    def with_dear(coarse, fine, candidates):
        ends = refined(coarse, fine, candidates)
        none = float(fine.cost(torch.eye(4, dtype=torch.float64)[None])[0])
        return [*ends, replace(ends[0], T=T @ T, cost=0.55 * none)]

    def dear_first(pair, ends):
        motions, cost, order = ranked(pair, ends)
        return motions, cost, [len(ends) - 1, *order]

    monkeypatch.setattr(render_choice, "refined", with_dear)
    monkeypatch.setattr(render_choice, "ranked", dear_first)
    assert not initial_motion(*blotches, part=1).still


def test_a_tin_that_looks_alike_upside_down_but_for_its_colour_is_not_flipped():
    T = motion((180, 0, 0), (0.0, 0.3, 0.0))
    plate = box(1, (1.0, 1.0, 0.1), (0.0, 0.0, 0.0), spacing=0.08)
    splats = (plate, plate.transformed(T))
    views = tuple(photograph(s) for s in splats)
    seen = tuple(visibility(s, v) for s, v in zip(splats, views, strict=True))
    # The points alone fit nearly as well unturned.
    candidates = register(*(part_points(s, v, 1) for s, v in zip(splats, seen, strict=True)))
    assert len(candidates) > 1
    assert angle_deg(initial_motion(splats, views, seen, part=1).T, T) < 0.5


def test_a_part_missing_in_one_state_is_reported(scene):
    splats, views, seen = scene
    kept = splats[1].part_ids != 2
    found = initial_motion((splats[0], splats[1].select(kept)), views, (seen[0], seen[1][kept]), part=2)
    assert not found.found
    assert torch.equal(found.T, torch.eye(4, dtype=torch.float64))


def test_without_labelled_views_the_registration_decides(scene):
    splats, views, seen = scene
    blind = tuple([type(v)(**{**vars(v), "labels": None}) for v in state] for state in views)
    found = initial_motion(splats, blind, seen, part=2)
    assert found.found and angle_deg(found.T, TRUTH) < 10


def test_a_few_gaussians_of_a_sliver_are_enough():
    sliver = box(2, (0.2, 0.1, 0.06), (0.4, 0.0, 0.3), spacing=0.03)
    T = motion((0, 0, 0), (-0.3, 0.1, 0.0))
    base = box(1, (0.9, 0.6, 0.3), (0.0, 0.0, 0.0))
    splats = tuple(Splat.cat([base, s]) for s in (sliver, sliver.transformed(T)))
    views = tuple(photograph(s) for s in splats)
    seen = tuple(visibility(s, v) for s, v in zip(splats, views, strict=True))
    found = initial_motion(splats, views, seen, part=2)
    centre = torch.tensor([0.4, 0.0, 0.3, 1.0], dtype=torch.float64)
    assert ((found.T - T) @ centre)[:3].norm() < 0.01


def test_where_the_right_turn_fits_no_slide_that_fits_worse_stands_for_turning_over():
    """A nearly symmetric knob: the images tell its turn, but hardly what lies behind it."""
    turn = motion((0, 0, 50), (0.0, 0.0, 0.0))
    splats, views = two_states(turn)
    pair = part_pair(splats, views, 2, num_views=3, pixels=400)
    still = refined(pair, pair, turn[None])[0]
    over = turn @ motion((180, 0, 0), (0.0, 0.0, 0.0))
    ends = [replace(still, T=T) for T in (over, turn, torch.eye(4, dtype=torch.float64))]
    own = own_appearance(pair)
    for times, first in ((1.0, 1), (2.0, 2)):
        costs = iter([[times * own, 1.03 * times * own, 1.2 * times * own]])
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(render_choice, "appearance_cost", lambda *_, costs=costs: np.array(next(costs)))
            assert ranked(pair, ends)[2][0] == first


OPENED = motion((60, 0, 0), (0.0, 0.1, 0.3))


def lit_lid(colour):
    """Opened it is lit from below, so that it fits better turned over, though its sides differ by twice a colour."""
    lid = box(1, (0.6, 0.4, 0.06), (0.0, 0.0, 0.0), spacing=0.04)
    above, front = lid.means[:, 2, None, None] > 0, lid.means[:, 1, None, None] > 0.1
    colours = torch.where(above, colour, -colour) * torch.tensor([1.0, -0.5, -0.5])
    colours = colours + torch.where(front, 0.4, 0.0) * torch.tensor([-0.5, 1.0, -0.5])
    opened = lid.transformed(OPENED)
    lid.sh, opened.sh = (torch.where(lit, 0.5, -0.1) + colours for lit in (above, ~above))
    splats = lid, opened
    return splats, tuple(photograph(s, count=20) for s in splats)


def test_a_lid_that_is_lit_from_one_side_is_not_turned_over():
    splats, views = lit_lid(0.2)
    seen = tuple(visibility(s, v) for s, v in zip(splats, views, strict=True))
    found = initial_motion(splats, views, seen, part=1)
    assert angle_deg(found.T, OPENED) < 2
    over = found.alike[0]
    assert angle_deg(over, OPENED) > 170
    pair = part_pair(splats, views, 1, VIEWS, FINE_PIXELS)
    right, turned_over = appearance_cost(pair, torch.stack([found.T, over]))
    assert ALIKE * turned_over < right < DOUBTFUL * turned_over


def test_a_lid_stays_in_view_that_fits_much_worse_than_turned_over():
    splats, views = lit_lid(0.18)
    coarse, fine = (part_pair(splats, views, 1, VIEWS, pixels) for pixels in (COARSE_PIXELS, FINE_PIXELS))
    flip = motion((0, 180, 0), (0, 0, 0))
    flip[:3, 3] = coarse.centroid - flip[:3, :3] @ coarse.centroid
    over = OPENED @ flip
    right, turned_over = appearance_cost(coarse, torch.stack([OPENED, over]))
    assert 1.5 * turned_over < right < DOUBTFUL * turned_over
    T, cost, order = ranked(fine, refined(coarse, fine, torch.stack([OPENED, over])))
    assert angle_deg(torch.from_numpy(T[order[0]]), OPENED) < 1


def test_where_all_candidates_turn_the_part_over_a_mere_shift_is_tried():
    slide = motion((0, 0, 0), (0.3, 0.2, 0.1))
    splats, views = two_states(slide)
    pair = part_pair(splats, views, 2, num_views=3, pixels=400)
    over = motion((180, 0, 0), (0, 0, 0))
    over[:3, 3] = pair.centroid - over[:3, :3] @ pair.centroid
    ends = refined(pair, pair, (slide @ over)[None])
    T, _, order = ranked(pair, ends)
    assert np.abs(T[order[0]] - slide.numpy()).max() < 0.01
    upright = refined(pair, pair, slide[None])
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
