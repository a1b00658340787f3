import numpy as np
import pytest
import torch
from part_scene import box, photograph

from splatart_ns.capture.view import evenly
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.visibility import HIDDEN, clearest, shown, visibility


def test_what_lies_behind_others_in_all_views_is_hidden_and_what_one_view_shows_is_not():
    shell = box(1, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), spacing=0.05)
    open_box = shell.select(~((shell.means[:, 2] > 0.45) & (shell.means[:, :2].abs().amax(1) < 0.45)))
    haze = shell.select(torch.arange(3))
    haze.means[:] = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, -0.1], [0.0, -0.1, 0.1]])
    haze.log_scales[:] = -2.0
    for around, hidden in ((shell, True), (open_box, False)):
        splat = Splat.cat([around, haze])
        share = clearest(splat, photograph(splat))
        assert bool((share[-3:] < HIDDEN).all()) == hidden
        assert (share[: len(around)] >= HIDDEN).float().mean() > 0.95
        assert share.min() >= 0 and share.max() < 1.2


@pytest.mark.parametrize("count", [0, 1, 40, 41, 100])
def test_no_more_views_than_wanted_are_looked_at_and_they_lie_all_along(count):
    chosen = evenly(range(count), 40)
    assert len(chosen) == min(count, 40)
    assert np.diff([*chosen, count]).max(initial=0) <= -(-count // 40)


def test_of_no_gaussians_nothing_is_shown():
    solid = box(1, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    nothing = solid.select(torch.zeros(len(solid), dtype=torch.bool))
    assert visibility(nothing, photograph(solid)).shape == clearest(nothing, photograph(solid)).shape == (0,)


def test_a_gaussian_alone_is_shown_as_clearly_as_can_be():
    alone = box(1, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), spacing=0.05).select(torch.tensor([5]))
    views = photograph(box(1, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)))
    assert 0.8 < float(clearest(alone, views)) < 1.2
    assert bool(shown(visibility(alone, views)).all())
