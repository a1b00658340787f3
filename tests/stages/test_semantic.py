import math
from dataclasses import replace

import torch
from part_scene import box, photograph

from splatart_ns.capture.capture import UNLABELLED
from splatart_ns.rasterize.render import render
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.semantic import accumulation_loss, part_image, segmentation_loss, vote_logits

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


def test_votes_find_the_parts_of_visible_gaussians():
    forgotten = replace(SPLAT, part_logits=torch.zeros_like(SPLAT.part_logits))
    logits = vote_logits(forgotten, VIEWS, 2)
    seen = logits.amax(-1) > math.log(0.9)  # what views agree on
    assert seen.float().mean() > 0.3
    assert (logits.argmax(-1) == SPLAT.part_ids)[seen].float().mean() > 0.99


def test_votes_come_from_labelled_views_and_pixels_only():
    silent = [view.to("cpu") for view in VIEWS]
    for k, view in enumerate(silent):
        view.labels = None if k % 2 else torch.full_like(view.labels, UNLABELLED)
    logits = vote_logits(SPLAT, silent, 2)
    assert torch.allclose(logits, logits[:1, :1].expand_as(logits))
