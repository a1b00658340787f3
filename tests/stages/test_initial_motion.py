from dataclasses import replace

import pytest
import torch
from part_scene import OPENED, angle_deg, box, lit_lid, motion, photograph, two_states

from splatart_ns.splats.splat import Splat
from splatart_ns.stages import initial_motion as module
from splatart_ns.stages.initial_motion import SHADED_RATIO, STILL_RATIO, initial_motion
from splatart_ns.stages.motion_preference import ALIKE, DOUBTFUL
from splatart_ns.stages.part_pair import part_pair
from splatart_ns.stages.registration import part_points, register
from splatart_ns.stages.render_choice import FINE_PIXELS, VIEWS, appearance_cost, ranked, refined
from splatart_ns.stages.visibility import visibility

TRUTH = motion((0, 0, 70), (0.3, 0.2, 0.1))


@pytest.fixture(scope="module")
def scene():
    splats, views = two_states(TRUTH)
    return splats, views, tuple(visibility(s, v) for s, v in zip(splats, views, strict=True))


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
    monkeypatch.setattr(module, "VIEWS", views_at_first)
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
    assert found.identity_ratio > STILL_RATIO and found.maybe_moved


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

    def with_dear(look, candidates):
        ends = refined(look, candidates)
        return [*ends, replace(ends[0], T=T @ T, cost=0.55 * look.unmoved_cost())]

    def dear_first(pair, ends):
        ranking = ranked(pair, ends)
        return replace(ranking, order=[len(ends) - 1, *ranking.order])

    monkeypatch.setattr(module, "refined", with_dear)
    monkeypatch.setattr(module, "ranked", dear_first)
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
