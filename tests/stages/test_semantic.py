import math
from dataclasses import replace

import pytest
import torch
from part_scene import box, photograph

from splatart_ns.capture.capture import UNLABELLED
from splatart_ns.rasterize.render import render
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.semantic import (
    accumulation_loss,
    ballots,
    part_image,
    segmentation_loss,
    spike_loss,
    trusted,
    vote_logits,
)

SPLAT = Splat.cat([box(1, (0.9, 0.6, 0.3), (0.0, 0.0, -0.3)), box(2, (0.7, 0.4, 0.12), (0.1, 0.0, 0.2))])
VIEWS = photograph(SPLAT)


def rendered(view):
    return render(SPLAT, view.viewmat[None], view.K[None], view.width, view.height, features=SPLAT.part_probabilities)


def test_part_probabilities_of_a_pixel_add_up_to_one():
    image = part_image(rendered(VIEWS[0]))
    assert torch.allclose(image.sum(-1), torch.ones(1, 64, 64), atol=1e-5)
    assert (image >= -1e-6).all()


def test_the_right_labels_cost_little_and_wrong_ones_much():
    probabilities = part_image(rendered(VIEWS[0]))[0]
    right = segmentation_loss(probabilities, VIEWS[0].labels)
    swapped = torch.where(VIEWS[0].labels > 0, 3 - VIEWS[0].labels, 0)
    assert right < 0.1 and segmentation_loss(probabilities, swapped) > 10 * right


def test_unlabelled_pixels_do_not_count():
    probabilities = torch.full((2, 2, 3), 1 / 3)
    labels = torch.tensor([[1, UNLABELLED], [UNLABELLED, UNLABELLED]])
    assert torch.isclose(segmentation_loss(probabilities, labels), torch.tensor(math.log(3.0)))
    assert segmentation_loss(probabilities, torch.full((2, 2), UNLABELLED)) == 0


def test_accumulation_loss_is_the_mean_difference():
    assert torch.isclose(accumulation_loss(torch.full((4, 4), 0.75), torch.ones(4, 4)), torch.tensor(0.25))


def test_long_gaussians_cost_what_their_axes_differ_beyond_the_limit():
    scales = torch.tensor([[1.0, 1, 1], [1, 2, 8], [3, 1, 3]])
    assert float(spike_loss(scales.log(), 3.0)) == pytest.approx(5 / 3, rel=1e-5)


def test_votes_find_the_parts_of_visible_gaussians():
    forgotten = replace(SPLAT, part_logits=torch.zeros_like(SPLAT.part_logits))
    logits = vote_logits(ballots(forgotten, VIEWS, 2)[0])
    seen = logits.amax(-1) > math.log(0.9)  # what views agree on
    assert seen.float().mean() > 0.3
    assert (logits.argmax(-1) == SPLAT.part_ids)[seen].float().mean() > 0.99


def test_a_view_shows_little_of_what_lies_behind_others():
    hidden = box(2, (0.1, 0.1, 0.05), (0.0, 0.0, -0.3))  # inside the first box
    _, shown = ballots(Splat.cat([SPLAT, hidden]), VIEWS, 2)
    assert shown.shape == (len(VIEWS), len(SPLAT) + len(hidden))
    assert shown[:, len(SPLAT) :].max() < 0.05
    assert (shown.amax(0) > 0.2)[: len(SPLAT)].float().mean() > 0.5 and shown.max() < 1.1


def test_a_view_shows_nothing_where_it_has_no_labels():
    unlabelled = [replace(view, labels=torch.full_like(view.labels, UNLABELLED)) for view in VIEWS[:2]]
    assert (ballots(SPLAT, unlabelled, 2)[1] == 0).all()


def test_unlabelled_pixels_have_no_vote():
    silent = [replace(view, labels=torch.full_like(view.labels, UNLABELLED)) for view in VIEWS]
    logits = vote_logits(ballots(SPLAT, silent, 2)[0])
    assert torch.allclose(logits, logits[:1, :1].expand_as(logits))


def swapped(view):
    return replace(view, labels=torch.where((view.labels == 1) | (view.labels == 2), 3 - view.labels, view.labels))


@pytest.mark.parametrize("wrong", [{3}, {1, 5, 6}])
def test_views_that_contradict_the_others_are_not_trusted(wrong):
    views = [swapped(view) if i in wrong else view for i, view in enumerate(VIEWS[:9])]
    kept = trusted(*ballots(SPLAT, views, 2))
    assert {i for i, keep in enumerate(kept.tolist()) if not keep} == wrong


def test_a_view_that_contradicts_two_others_on_a_large_part_alone_is_not_trusted():
    """Two of four links that change places are half of the object."""
    links = Splat.cat([box(k, (0.4, 0.3, 0.2), (0.45 * k - 1.1, 0.0, 0.0), num_parts=4) for k in (1, 2, 3, 4)])
    views = photograph(links, 40)[:4]
    views = [*views[:3], swapped(views[3])]
    assert trusted(*ballots(links, views, 4)).tolist() == [True, True, True, False]
    unlabelled = [replace(view, labels=torch.where(view.labels < 3, UNLABELLED, view.labels)) for view in views[:2]]
    assert trusted(*ballots(links, [*unlabelled, *views[2:]], 4)).all()  # of one against one nobody can tell


def test_right_labels_are_trusted_even_if_their_outlines_are_rough():
    g = torch.Generator().manual_seed(0)
    rough = []
    for view in VIEWS:
        shift = torch.randint(-1, 2, (2,), generator=g).tolist()
        rough.append(replace(view, labels=view.labels.roll(shift, (0, 1))))
    assert trusted(*ballots(SPLAT, rough, 2)).all()


def test_of_two_views_none_is_called_wrong():
    assert trusted(*ballots(SPLAT, [VIEWS[4], swapped(VIEWS[5])], 2)).all()
    assert trusted(*ballots(SPLAT, [], 2)).shape == (0,)


def test_right_labels_from_behind_are_trusted_though_others_see_a_glimmer_through_what_lies_before():
    book = Splat.cat([box(1, (0.9, 0.6, 0.06), (0.0, 0.0, 0.0)), box(2, (0.9, 0.6, 0.06), (0.0, 0.0, 0.12))])
    all_around = photograph(book, 100)
    *above, below = (all_around[k] for k in (0, 1, 2, 99))
    assert trusted(*ballots(book, [*above, below], 2)).all()
    assert trusted(*ballots(book, [*above, swapped(below)], 2)).tolist() == [True, True, True, False]
