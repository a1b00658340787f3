from dataclasses import replace

import pytest
import torch
from part_scene import box, motion, two_states

from splatart_ns.geometry.se3 import inverse
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.initial_motion import InitialMotion
from splatart_ns.stages.part_pair import part_pair
from splatart_ns.stages.render_choice import FINE_PIXELS, VIEWS, appearance_cost
from splatart_ns.stages.siblings import slid_alike, slide_ways

SLID = motion((0, 0, 0), (0.45, 0.0, 0.0))
OVER = motion((0, 180, 0), (0.2, 0.0, 0.4))
EYE = torch.eye(4, dtype=torch.float64)
X = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
WAYS = torch.cat([X.roll(1, 1), -X])


def slid(*shift, **kwargs):
    return InitialMotion(motion((0, 0, 0), shift), found=True, **kwargs)


def doubtful(scene, T):
    """What the search says when it ended there and the upside-down plate looks as well."""
    cost = float(appearance_cost(part_pair(*scene, 2, VIEWS, FINE_PIXELS), T[None])[0])
    return InitialMotion(T, found=True, cost=cost, identity_ratio=3.0, alike=(OVER,))


def test_ways_are_of_slides_unless_another_motion_but_turned_over_looks_alike_and_each_is_told_once():
    motions = [
        slid(0.3, 0.0, 0.0),
        slid(-0.1, 0.005, 0.0),  # the same way back
        slid(0.0, 0.0, 2.0, alike=(OVER,)),  # a plain drawer's front
        slid(0.0, 0.4, 0.0, alike=(OVER, motion((0, 0, 40), (0.0, 0.3, 0.0)))),
        slid(0.0, 0.0, 0.0, still=True),
        InitialMotion(EYE, found=False),
        InitialMotion(motion((0, 0, 20), (0.0, 0.3, 0.0)), found=True),
    ]
    splat = Splat.cat([box(p, (0.2, 0.2, 0.2), (0.0, 0.0, 0.0), num_parts=7) for p in range(1, 8)])
    ways = slide_ways(splat, dict(enumerate(motions, start=1)))
    torch.testing.assert_close(ways, torch.tensor([[1.0, 0, 0], [0, 0, 1.0]], dtype=torch.float64))
    assert slide_ways(splat, {1: InitialMotion(EYE, found=False)}).shape == (0, 3)


def test_the_way_is_that_of_the_part_itself_not_of_the_worlds_origin():
    """Far from which the few degrees that a registration errs by shift the origin as far as the part slid."""
    part = box(1, (0.2, 0.2, 0.2), (3.0, 0.0, 0.0))
    about = motion((0, 0, 0), (3.0, 0.0, 0.0))
    T = motion((0, 0, 0), (0.2, 0.0, 0.0)) @ about @ motion((0, 0, 4), (0.0, 0.0, 0.0)) @ inverse(about)
    ways = slide_ways(part, {1: InitialMotion(T, found=True)})
    torch.testing.assert_close(ways, torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64), atol=5e-3, rtol=0)


@pytest.fixture(scope="module")
def pulled():
    return two_states(SLID)


def test_a_part_that_slid_as_others_do_is_found_though_its_own_search_went_astray(pulled):
    astray = doubtful(pulled, OVER)
    found = slid_alike(*pulled, 2, astray, WAYS)
    assert torch.equal(found.T[:3, :3], EYE[:3, :3]) and (found.T - SLID)[:3, 3].norm() < 0.02
    assert found.cost < astray.cost and found.identity_ratio > astray.identity_ratio
    assert found.alike == ()  # upside down it looks far worse than so


def test_a_slide_that_looks_worse_than_what_was_found_is_not_taken(pulled):
    sure = doubtful(pulled, SLID)
    assert slid_alike(*pulled, 2, sure, X.roll(1, 1)) is sure
    turned = motion((0, 0, 60), (0.0, 0.0, 0.0))
    scene = two_states(turned)
    assert slid_alike(*scene, 2, replace(sure, T=turned), WAYS).T is turned


def test_a_part_that_hardly_shifts_is_not_called_a_slide():
    nudged = motion((0, 0, 0), (0.03, 0.0, 0.0))
    scene = two_states(nudged)
    turned_over = doubtful(scene, OVER)
    assert slid_alike(*scene, 2, turned_over, WAYS) is turned_over


def test_without_ways_or_without_the_part_nothing_changes(pulled):
    astray = doubtful(pulled, OVER)
    assert slid_alike(*pulled, 2, astray, torch.zeros(0, 3, dtype=torch.float64)) is astray
    splats, views = pulled
    gone = splats[0], splats[1].select(splats[1].part_ids == 1)
    assert slid_alike(gone, views, 2, astray, WAYS) is astray
