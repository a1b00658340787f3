"""A part of which one state hides most: what the images of that state alone tell of its motion."""

from dataclasses import replace

import pytest
import torch
from part_scene import angle_deg, box, motion, photograph

from splatart_ns.splats.splat import Splat
from splatart_ns.stages.initial_motion import initial_motion
from splatart_ns.stages.motion_preference import SUSPECT
from splatart_ns.stages.render_choice import (
    PartLook,
    explained_by_one_state,
    part_look,
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
def look(scene):
    splats, views, _ = scene
    return part_look(splats, views, 2, 5)


@pytest.fixture(scope="module")
def covering(look):
    """Where refinement ends that looks at the images of both states."""
    return ranked(look.fine, refined(look, torch.stack([PULLED, COVERING]))).best


def test_the_shut_state_tells_that_a_drawer_slid_which_seems_turned_so_as_to_cover_what_came_to_light(look, covering):
    assert angle_deg(covering.T, PULLED) > 20
    assert covering.cost > SUSPECT * look.fine.own_cost()
    state, rivals = explained_by_one_state(look, torch.stack([PULLED, COVERING]), covering)
    assert state == 0
    slid = ranked(look.fine.shown_by(0), rivals).best
    assert angle_deg(slid.T, PULLED) < 5
    assert torch.allclose(slid.T[:3, 3], PULLED[:3, 3], atol=0.06)


def test_the_shut_state_tells_it_where_it_is_the_second_one_too(scene):
    splats, views, _ = (x[::-1] for x in scene)
    look = part_look(splats, views, 2, 5)
    pushed = torch.stack([torch.linalg.inv(PULLED), torch.linalg.inv(COVERING)])
    assert explained_by_one_state(look, pushed, ranked(look.fine, refined(look, pushed)).best)[0] == 1


def test_what_explains_no_state_is_not_preferred(look, covering):
    assert explained_by_one_state(look, motion((0, 0, 90), (0.5, 0.5, 0))[None], covering) is None


def test_a_motion_that_explains_the_shut_state_as_well_stays(look):
    slid = refined(look.shown_by(0), PULLED[None])[0]
    assert explained_by_one_state(look, torch.stack([PULLED, COVERING]), slid) is None


def test_a_state_that_shows_next_to_nothing_of_the_part_tells_nothing(look, covering):
    sliver = tuple(replace(view, area=0.1 * view.area) for view in look.fine.views[0])
    fine = replace(look.fine, views=(sliver, look.fine.views[1]))
    assert explained_by_one_state(PartLook(look.coarse, fine), torch.stack([PULLED, COVERING]), covering) is None


def test_a_pulled_drawer_is_found_by_what_the_shut_state_shows(scene, look):
    found = initial_motion(*scene, part=2)
    assert found.found and not found.still
    assert angle_deg(found.T, PULLED) < 5
    both = float(look.fine.cost(found.T[None])[0])
    assert found.cost < 0.3 * both
    assert found.cost == pytest.approx(float(look.fine.shown_by(0).cost(found.T[None])[0]), rel=0.5)
