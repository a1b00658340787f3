"""A part of which one state hides most: what the images of that state alone tell of its motion."""

from dataclasses import replace

import pytest
import torch
from part_scene import angle_deg, box, motion, photograph

from splatart_ns.splats.splat import Splat
from splatart_ns.stages.motion_preference import SUSPECT
from splatart_ns.stages.part_pair import part_pair
from splatart_ns.stages.render_choice import (
    COARSE_PIXELS,
    FINE_PIXELS,
    explained_by_one_state,
    initial_motion,
    ranked,
    refined,
)
from splatart_ns.stages.visibility import looked_at

PULLED = motion((0, 0, 0), (0, -0.5, 0))
COVERING = PULLED @ motion((30, 0, 0), (0, 0, 0))
"""Lays the front over what is open."""
SHOWN = 0.02


def cabinet() -> Splat:
    sides = [box(1, (0.06, 0.6, 0.6), (x, 0.03, 0.0)) for x in (-0.5, 0.5)]
    ends = [box(1, (1.06, 0.6, 0.06), (0.0, 0.03, z)) for z in (-0.28, 0.28)]
    return Splat.cat([*sides, *ends, box(1, (1.06, 0.06, 0.6), (0.0, 0.36, 0.0))])


def drawer() -> Splat:
    front, back = box(2, (0.9, 0.06, 0.4), (0.0, -0.3, 0.0)), box(2, (0.8, 0.06, 0.36), (0.0, 0.27, 0.0))
    sides = [box(2, (0.06, 0.5, 0.36), (x, 0.0, 0.0)) for x in (-0.4, 0.4)]
    return Splat.cat([front, back, *sides, box(2, (0.8, 0.5, 0.06), (0.0, 0.0, -0.15))])


@pytest.fixture(scope="module")
def scene():
    """Splats that have what the views of their states show, those views, and the visibility."""
    everything = [Splat.cat([cabinet(), d]) for d in (drawer(), drawer().transformed(PULLED))]
    views = tuple(photograph(s) for s in everything)
    looks = [looked_at(s, v) for s, v in zip(everything, views, strict=True)]
    splats = tuple(s.select(share >= SHOWN) for s, (_, share) in zip(everything, looks, strict=True))
    return splats, views, tuple(seen[share >= SHOWN] for seen, share in looks)


@pytest.fixture(scope="module")
def pairs(scene):
    splats, views, _ = scene
    return tuple(part_pair(splats, views, 2, 5, pixels) for pixels in (COARSE_PIXELS, FINE_PIXELS))


@pytest.fixture(scope="module")
def ends(pairs):
    """Where refinement ends that looks at the images of both states."""
    return refined(*pairs, torch.stack([PULLED, COVERING]))


def best_of(pair, ends):
    order = ranked(pair, ends)[2]
    return ends[order[0]], order[0]


def test_the_shut_state_tells_that_a_drawer_slid_which_seems_turned_so_as_to_cover_what_came_to_light(pairs, ends):
    covering, best = best_of(pairs[1], ends)
    assert angle_deg(covering.T, PULLED) > 20
    assert covering.cost > SUSPECT * pairs[1].own_cost()
    state, rivals = explained_by_one_state(*pairs, torch.stack([PULLED, COVERING]), ends, best)
    assert state == 0
    slid, _ = best_of(pairs[1].shown_by(0), rivals)
    assert angle_deg(slid.T, PULLED) < 5
    assert torch.allclose(slid.T[:3, 3], PULLED[:3, 3], atol=0.06)


def test_the_shut_state_tells_it_where_it_is_the_second_one_too(scene):
    splats, views, _ = (x[::-1] for x in scene)
    pairs = tuple(part_pair(splats, views, 2, 5, pixels) for pixels in (COARSE_PIXELS, FINE_PIXELS))
    pushed = torch.stack([torch.linalg.inv(PULLED), torch.linalg.inv(COVERING)])
    ends = refined(*pairs, pushed)
    assert explained_by_one_state(*pairs, pushed, ends, best_of(pairs[1], ends)[1])[0] == 1


def test_what_explains_no_state_is_not_preferred(pairs, ends):
    far = motion((0, 0, 90), (0.5, 0.5, 0))[None]
    assert explained_by_one_state(*pairs, far, ends, best_of(pairs[1], ends)[1]) == (None, ends)


def test_a_motion_that_explains_the_shut_state_as_well_stays(pairs):
    slid = refined(*(pair.shown_by(0) for pair in pairs), PULLED[None])
    candidates = torch.stack([PULLED, COVERING])
    assert explained_by_one_state(*pairs, candidates, slid, 0) == (None, slid)


def test_a_state_that_shows_next_to_nothing_of_the_part_tells_nothing(pairs, ends):
    coarse, fine = pairs
    sliver = tuple(replace(view, area=0.1 * view.area) for view in fine.views[0])
    fine = replace(fine, views=(sliver, fine.views[1]))
    candidates = torch.stack([PULLED, COVERING])
    assert explained_by_one_state(coarse, fine, candidates, ends, best_of(fine, ends)[1]) == (None, ends)


def test_a_pulled_drawer_is_found_by_what_the_shut_state_shows(scene, pairs):
    found = initial_motion(*scene, part=2)
    assert found.found and not found.still
    assert angle_deg(found.T, PULLED) < 5
    both = float(pairs[1].cost(found.T[None])[0])
    assert found.cost < 0.3 * both
    assert found.cost == pytest.approx(float(pairs[1].shown_by(0).cost(found.T[None])[0]), rel=0.5)
