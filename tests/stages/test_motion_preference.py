import numpy as np
import pytest
import torch
from part_scene import motion

from splatart_ns.stages.motion_preference import ALIKE, prefer_less_turn, prefer_slide, prefer_turn, prefer_upright


@pytest.mark.parametrize(
    "turn_cost, rise, first",
    [(1.2, 0.0, 1), (1.6, 0.0, 0), (1.2, 0.2, 0)],
    ids=["a door upside down", "one that fits much worse", "neither merely turns"],
)
def test_a_mere_turn_is_preferred_to_a_turn_that_fits_hardly_better(turn_cost, rise, first):
    """A door of a hinge about z; upside down it turns about its normal x, and is shifted along that."""
    door, upside_down = motion((0, 0, 60), (0.3, 0.2, rise)), motion((180, 0, 0), (0.3, 0.2, 0.0))
    T = torch.stack([upside_down, door]).numpy()
    assert prefer_turn(T, np.array([1.0, turn_cost]), [0, 1], radius=0.5)[0] == first


def test_a_mere_turn_that_fits_best_stays_first():
    T = torch.stack([motion((0, 0, 60), (0.3, 0.2, 0.0)), motion((0, 0, 40), (0.1, 0.2, 0.0))]).numpy()
    assert prefer_turn(T, np.array([1.0, 1.1]), [0, 1], radius=0.5) == [0, 1]


def test_a_slide_that_fits_nearly_as_well_is_preferred_to_turning_over():
    T = np.stack([motion(turn, (0, 0, 0)).numpy() for turn in ((0, 178, 0), (0, 0, 60), (0, 0, 2))])
    assert prefer_slide(T, np.array([1.0, 1.05, 0.98 * ALIKE]), [0, 1, 2]) == [2, 0, 1]
    assert prefer_slide(T, np.array([1.0, 1.05, 1.3]), [0, 1, 2]) == [0, 1, 2]
    assert prefer_slide(T, np.array([1.1, 1.0, 1.15]), [1, 0, 2]) == [1, 0, 2]


@pytest.mark.parametrize("own, first", [(0.2, 2), (0.3, 0)])
def test_of_motions_that_all_fit_far_worse_than_a_states_own_gaussians_a_slide_is_preferred_sooner(own, first):
    T = np.stack([motion(turn, (0, 0, 0)).numpy() for turn in ((0, 178, 0), (0, 0, 60), (0, 0, 2))])
    assert prefer_slide(T, np.array([1.0, 1.05, 1.6]), [0, 1, 2], own)[0] == first


def test_a_knob_that_fits_as_well_turned_by_less_is_not_turned_over():
    T = np.stack([motion(turn, (0, 0, 0)).numpy() for turn in ((0, 133, 0), (0, 0, 48), (0, 0, 0))])
    assert prefer_upright(T, np.array([1.0, 1.02, 1.03]), [0, 1, 2]) == [1, 0, 2]
    assert prefer_upright(T, np.array([1.0, 1.2, 1.3]), [0, 1, 2]) == []
    assert prefer_upright(T, np.array([1.0, 0.99, 1.3]), [1, 0, 2]) == []


@pytest.mark.parametrize(
    "turn, over, cost, preferred",
    [
        (47, (0, 0, 180), 1.5, True),
        (47, (0, 0, 180), 2.5, False),
        (3, (0, 0, 180), 1.5, False),
        (90, (0, 85, 0), 1.5, False),
        (47, (0, 60, 0), 0.9, True),
    ],
    ids=["a flap turned over", "it fits much worse", "no hinge", "a knob of four sides", "the better one is the less"],
)
def test_less_than_half_a_turn_is_preferred_to_the_part_turned_over(turn, over, cost, preferred):
    less = motion((0, turn, 0), (0, 0, 0))
    T = torch.stack([less @ motion(over, (0, 0, 0)), less]).numpy()
    order = sorted((0, 1), key=lambda i: (1.0, cost)[i])
    assert prefer_less_turn(T, np.array([1.0, cost]), order)[0] == int(preferred)
