import torch
from part_scene import motion, two_states

from splatart_ns.stages.joint import PRISMATIC_BELOW
from splatart_ns.stages.pose_evidence import motion_covariances, rotation_held_ratios


def evidence(T):
    splats, views = two_states(T)
    eye = torch.eye(4, dtype=torch.float64)
    poses = torch.stack([torch.stack([eye, eye]), torch.stack([eye, T])])
    return motion_covariances(splats, views, poses), rotation_held_ratios(splats, views, poses)


def test_a_slide_fits_as_well_with_its_rotation_held_and_a_turn_does_not():
    slid = evidence(motion((0, 0, 0.5), (0.3, 0.1, 0.0)))[1]  # half a degree of error on a slide
    turned = evidence(motion((0, 0, 8), (0.1, 0.0, 0.0)))[1]
    assert slid[0, 1] < PRISMATIC_BELOW < turned[0, 1]
    assert torch.isnan(slid.diagonal()).all()


def test_a_part_that_turned_far_is_not_suspected_of_sliding():
    assert torch.isnan(evidence(motion((0, 0, 40), (0.1, 0.0, 0.0)))[1]).all()


def test_covariances_are_proper_and_zero_at_state_0():
    covariance = evidence(motion((0, 0, 20), (0.1, 0.0, 0.0)))[0]
    assert covariance.shape == (2, 2, 6, 6)
    assert (covariance[0] == 0).all()
    assert (torch.linalg.eigvalsh(covariance[1]) > -1e-12).all()
