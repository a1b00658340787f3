from dataclasses import replace

import pytest
import torch
from part_scene import angle_deg, motion, nearby, photograph, two_states

from splatart_ns.stages import pose_evidence
from splatart_ns.stages.joint import PRISMATIC_BELOW
from splatart_ns.stages.part_pair import CHROMA_WEIGHT, part_pair
from splatart_ns.stages.pose_evidence import refine_poses, rotation_held_ratios
from splatart_ns.stages.refinement import refine


def poses_of(T):
    eye = torch.eye(4, dtype=torch.float64)
    return torch.stack([torch.stack([eye, eye]), torch.stack([eye, T])])


def held_ratios(T):
    return rotation_held_ratios(*two_states(T), poses_of(T))


def test_a_slide_fits_as_well_with_its_rotation_held_and_a_turn_does_not():
    slid = held_ratios(motion((0, 0, 0.5), (0.3, 0.1, 0.0)))  # half a degree of error on a slide
    turned = held_ratios(motion((0, 0, 8), (0.1, 0.0, 0.0)))
    assert slid[0, 1] < PRISMATIC_BELOW < turned[0, 1]
    assert torch.isnan(slid.diagonal()).all()


def test_a_part_that_turned_far_is_not_suspected_of_sliding():
    assert torch.isnan(held_ratios(motion((0, 0, 40), (0.1, 0.0, 0.0)))).all()


def test_a_slide_on_what_turned_is_held_at_its_turn():
    turn, slid = motion((0, 0, 30), (0.0, 0.1, 0.0)), motion((0, 0, 0.5), (0.3, 0.1, 0.0))
    splats, (views, _) = two_states(slid)
    turned = splats[1].transformed(turn)
    poses = torch.stack([torch.eye(4).double().repeat(2, 1, 1), torch.stack([turn, turn @ slid])])
    ratios = rotation_held_ratios((splats[0], turned), (views, photograph(turned)), poses)
    assert ratios[0, 1] < PRISMATIC_BELOW


def test_a_pixel_is_as_long_however_coarsely_a_part_is_looked_at():
    fine, coarse = (part_pair(*two_states(torch.eye(4).double()), 2, 5, pixels) for pixels in (10**6, 20))
    assert coarse.views[0][0].factor > 1 == fine.views[0][0].factor
    assert pose_evidence._pixel(coarse) == pytest.approx(pose_evidence._pixel(fine), rel=1e-3)


def test_poses_are_refined_but_for_frozen_ones_and_covariances_are_proper():
    truth = motion((0, 0, 20), (0.1, 0.0, 0.0))
    start = poses_of(nearby(truth, 0.03))
    frozen = torch.tensor([[True, True], [True, False]])
    T, covariance, _ = refine_poses(*two_states(truth), start, frozen)
    assert angle_deg(T[1, 1], truth) < 0.2 < angle_deg(start[1, 1], truth)
    assert torch.equal(T[:, 0], start[:, 0]) and torch.equal(T[0], start[0])
    assert covariance.shape == (2, 2, 6, 6)
    assert (covariance[0] == 0).all()
    assert (torch.linalg.eigvalsh(covariance[1]) > -1e-12).all()


def test_a_part_that_slides_past_one_that_rests_is_held_unturned_and_one_that_turns_is_not():
    slide, tilted, turn = (motion((0, 0, degrees), (0.3, 0.1, 0.0)) for degrees in (0, 0.5, 8))
    for truth, start, rests in ((slide, tilted, True), (slide, tilted, False), (turn, turn, True)):
        frozen = torch.tensor([[True, True], [rests, False]])
        T, covariance, _ = refine_poses(*two_states(truth), poses_of(start), frozen)
        held = rests and truth is slide
        assert torch.equal(T[1, 1, :3, :3], torch.eye(3).double()) == held
        assert bool((covariance[1, 1, 3:] == 0).all()) == held
        assert (torch.linalg.eigvalsh(covariance[1, 1])[-3:] > 0).all()
        assert (T[1, 1, :3, 3] - truth[:3, 3]).norm() < 0.01


def test_a_part_that_seemed_to_rest_is_found_to_have_slid_by_a_quarter_of_a_pixel():
    rest = torch.ones(2, 2, dtype=torch.bool)
    slide = motion((0, 0, 0), (0.01, 0.005, 0.0))
    T, covariance, _ = refine_poses(*two_states(slide), poses_of(torch.eye(4).double()), rest)
    assert (T[1, 1] - slide).abs().max() < 1e-3
    assert torch.equal(T[1, 0], torch.eye(4).double())
    assert (torch.linalg.eigvalsh(covariance[1, 1])[-3:] > 0).all()


@pytest.mark.parametrize("degrees", [0.0, 1.0])
def test_a_part_that_rests_or_turned_a_little_is_not_slid(degrees):
    rest = poses_of(torch.eye(4).double())
    T, *_ = refine_poses(*two_states(motion((0, 0, degrees), (0, 0, 0))), rest, torch.ones(2, 2, dtype=torch.bool))
    assert torch.equal(T, rest)


@pytest.mark.parametrize("degrees", [0.0, 70.0])
def test_a_part_that_was_to_stay_and_did_not_is_told(degrees):
    rest = poses_of(torch.eye(4).double())
    turned = two_states(motion((0, 0, degrees), (0, 0, 0)))
    *_, misfits = refine_poses(*turned, rest, torch.ones(2, 2, dtype=torch.bool))
    assert misfits.tolist() == [[False, False], [False, degrees > 0]]


def test_the_last_refinement_looks_at_hues_and_at_brightness_in_even_light(monkeypatch):
    """What it gains was measured on fits (README); a scene as small as this one is held by its silhouettes."""
    looks = []

    def watched(pair, *args, **options):
        looks.append((pair.chroma_weight, pair.brightness_weight, pair.even_light))
        return refine(pair, *args, **options)

    monkeypatch.setattr(pose_evidence, "refine", watched)
    truth = motion((0, 0, 20), (0.1, 0.0, 0.0))
    refine_poses(*two_states(truth), poses_of(truth), torch.tensor([[True, True], [True, False]]))
    assert set(looks) == {(CHROMA_WEIGHT, 1.0, True)}


def test_a_part_that_nothing_shows_is_not_said_to_have_slid():
    eye = torch.eye(4, dtype=torch.float64)
    splats, views = two_states(eye)
    unseen = tuple(replace(splat, opacity_logits=torch.full_like(splat.opacity_logits, -9.0)) for splat in splats)
    pair = part_pair(unseen, views, 2, 3, 400)
    stays = refine(pair, eye)
    assert not stays.equations.H.any() and pose_evidence._slid_a_little(pair, stays) is None
