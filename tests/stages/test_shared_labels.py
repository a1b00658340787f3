from dataclasses import replace

import pytest
import torch
from part_scene import inverse, motion, two_states

from splatart_ns.splats.splat import Splat
from splatart_ns.stages.semantic import ballots
from splatart_ns.stages.shared_labels import share_labels
from splatart_ns.stages.spread import TOLD

LIFT = motion((0.0, 40.0, 0.0), (0.5, 0.0, 0.5))


@pytest.fixture(scope="module")
def states():
    """Both states; of the second only views from above are labelled, and what they do not show was guessed wrongly."""
    splats, (views, few) = two_states(LIFT)
    few = [view if inverse(view.viewmat)[2, 3] > 1 else replace(view, labels=None) for view in few]
    told = told_by(splats[1], few)
    wrong = torch.where(told[:, None], splats[1].part_logits, splats[1].part_logits[-1])
    return splats, (splats[0], replace(splats[1], part_logits=wrong)), (views, few), told


def told_by(splat: Splat, views) -> torch.Tensor:
    return (ballots(splat, [view for view in views if view.labels is not None], 2)[1] >= TOLD).any(0)


def test_what_rests_has_the_label_that_another_state_tells(states):
    truth, guessed, views, told = states
    hidden = ~told & (truth[1].part_ids == 1)
    assert hidden.sum() > 100 and (guessed[1].part_ids[hidden] == 2).all()
    first, second = share_labels(guessed, views)
    assert (second.part_ids[hidden] == 1).float().mean() > 0.98
    assert (second.part_ids == truth[1].part_ids)[~told].float().mean() > 0.95
    seen = told_by(truth[0], views[0])
    assert torch.equal(first.part_ids[seen], truth[0].part_ids[seen])


def test_what_a_state_tells_itself_stays(states):
    _, guessed, views, told = states
    _, second = share_labels(guessed, views)
    assert torch.equal(second.part_logits[told], guessed[1].part_logits[told])
    assert torch.equal(second.means, guessed[1].means)


def test_a_single_state_and_labels_everywhere_leave_splats_as_they_are(states):
    truth, _, (views, _), _ = states
    assert share_labels(truth[:1], [views]) == [truth[0]]
