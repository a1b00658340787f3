import math

import pytest
import torch

from splatart_ns.geometry.se3 import se3_exp
from splatart_ns.stages.image_error import ImageError
from splatart_ns.stages.initial_motion import InitialMotion
from splatart_ns.stages.pose_notes import doubtful_rest, ill_shown, open_turns, turns_alike, unknown_poses

NAMES = ["base", "lid"]


def turned(degrees: float) -> torch.Tensor:
    return se3_exp(torch.tensor([0, 0, 0.1, 0, 0, math.radians(degrees)]).double())


def error(*by_part: float) -> ImageError:
    return ImageError(30.0, sum(by_part), torch.tensor(by_part))


@pytest.fixture
def poses() -> torch.Tensor:
    return torch.eye(4, dtype=torch.float64).repeat(2, 2, 1, 1)


@pytest.fixture
def covariance() -> torch.Tensor:
    return torch.zeros(2, 2, 6, 6, dtype=torch.float64)


def test_an_unknown_pose_is_put_elsewhere_at_state_0_and_follows_afterwards():
    first, later = unknown_poses(torch.tensor([[True, False], [False, True]]), NAMES)
    assert first.startswith("part lid, state 0: ") and "where another state shows it" in first
    assert later.startswith("part base, state 1: ") and "as what it hangs on" in later


def test_a_turn_that_images_leave_open_is_told_of_known_poses(covariance):
    covariance[0] = torch.nan
    covariance[1, 1, 4, 4] = 3.3
    (note,) = open_turns(covariance, NAMES)
    assert note.startswith("part lid, state 1: ") and "about its own axis" in note


@pytest.mark.parametrize(
    ("found", "searched", "told"),
    [
        (30, (30, 150), "turned by 30 degrees; by 150"),
        (30, (30, 150, 90, 150), "turned by 30 degrees; by 150 or 90"),
        (30, (30, 90, 100, 110, 120, 80), "turned by 30 degrees; by 5 others of 80 to 120"),
        (0, (28, 151), "slid; turned by 151 degrees"),
        (90, (0, 80, 150), "turned by 90 degrees; by 150 or 0"),
        (25, (0, 32), None),
    ],
)
def test_turns_other_than_the_one_found_that_look_alike_are_told_all_if_they_are_few(
    poses, covariance, found, searched, told
):
    """The first of those `searched` is where refinement began."""
    first, *alike = (turned(degrees) for degrees in searched)
    motions = {(1, 1): InitialMotion(first, found=True, alike=tuple(alike))}
    poses[1, 1] = turned(found)
    notes, doubted = turns_alike(motions, [0, 0], poses, covariance, NAMES)
    assert notes == ([] if told is None else [f"part lid, state 1: {told} it looks nearly the same."])
    assert doubted.tolist() == [False, told is not None]
    covariance[1, 1, 5, 5] = 4.0
    assert turns_alike(motions, [0, 0], poses, covariance, NAMES)[0] == []  # `open_turns` says it


@pytest.mark.parametrize("misfits", [False, True])
@pytest.mark.parametrize("then", ["stays", "is turned", "is slid", "may have turned"])
def test_a_part_that_only_seems_to_rest_is_in_doubt_unless_more_is_found_of_it(poses, covariance, then, misfits):
    begun, held = poses.clone(), torch.ones(2, 2, dtype=torch.bool)
    if then == "is turned":
        poses[1, 1] = turned(30)
    elif then == "is slid":
        poses[1, 1, 0, 3] = 0.01
    elif then == "may have turned":
        covariance[1, 1, 5, 5] = 3.3
    of_lid = torch.tensor([[False, False], [False, True]])
    notes, doubted = doubtful_rest(of_lid & (not misfits), of_lid & misfits, held, begun, poses, covariance, NAMES)
    but = (
        "does not fit its images there, and no motion was found that does"
        if misfits
        else ("other motions fit its images a little better")
    )
    assert notes == [f"part lid, state 1: seems to rest, but {but}."] * (then == "stays")
    assert doubted.tolist() == [False, then == "stays"]


def test_a_state_from_whose_images_the_posed_parts_are_much_further_than_its_own_splat_puts_all_in_doubt():
    own = [error(0.002, 0.002, 0.001), error(0.0, 0.0001, 0.0)]
    posed = [error(0.02, 0.02, 0.005), error(0.003, 0.003, 0.007)]
    (note,), in_doubt = ill_shown(own, posed, ["shut", "open"], NAMES)
    assert note.startswith("open: the posed parts differ from its images 13 times as much") and "at part lid" in note
    assert in_doubt.tolist() == [True, True]
    notes, in_doubt = ill_shown(own[:1], posed[:1], ["shut"], NAMES)
    assert notes == [] and not in_doubt.any()
