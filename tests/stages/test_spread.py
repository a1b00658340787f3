import math
from dataclasses import replace

import torch

from splatart_ns.splats.splat import Splat
from splatart_ns.stages.spread import spread


def plate(part: int, height: float, size: int = 20, spacing: float = 0.1) -> Splat:
    """Flat Gaussians on a square of the xy plane, from the origin on."""
    steps = spacing * torch.arange(size)
    means = torch.cartesian_prod(steps, steps, torch.tensor([height]))
    n = len(means)
    return Splat(
        means=means,
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        log_scales=torch.tensor([spacing / 2, spacing / 2, spacing / 20]).log().repeat(n, 1),
        opacity_logits=torch.full((n,), 3.0),
        sh=torch.zeros(n, 1, 3),
        part_logits=torch.full((n, 3), -8.0).index_fill(1, torch.tensor([part]), 0.0),
    )


WALL, DRAWER = plate(1, 0.0), plate(2, 0.05)  # nearer to each other than Gaussians on one of them
BOTH = Splat.cat([WALL, DRAWER])


def test_what_no_labelled_view_shows_is_labelled_as_its_surface_is():
    told = torch.ones(len(BOTH), dtype=torch.bool)
    patch = ((BOTH.means[:, :2] - 0.95).abs() < 0.6).all(-1)
    told[patch & (BOTH.part_ids == 1)] = False
    votes = torch.where(told[:, None], BOTH.part_logits, DRAWER.part_logits[:1])  # those that shine through
    found = spread(BOTH, votes, told)
    assert torch.equal(found.argmax(-1), BOTH.part_ids)
    assert torch.equal(found[told], BOTH.part_logits[told])


def test_between_two_labels_each_gaussian_has_the_nearer_one():
    """The ends of a strip are told: what lies between falls off evenly, as a harmonic function on a line does."""
    logits = torch.where(WALL.means[:, :1] < 0.95, WALL.part_logits, DRAWER.part_logits[:1])
    told = (WALL.means[:, 0] < 0.05) | (WALL.means[:, 0] > 1.85)
    found = spread(WALL, logits, told)
    assert torch.equal(found.argmax(-1), logits.argmax(-1))
    of_columns = found.softmax(-1)[:, 1].reshape(20, 20)
    assert (of_columns.diff(dim=0) < 1e-3).all() and of_columns.std(dim=1).max() < 0.02
    assert torch.allclose(of_columns.mean(1), torch.linspace(1, 0, 20), atol=0.04)


def test_what_is_connected_with_nothing_told_has_the_nearest_label():
    near, far = plate(2, 2.0), plate(1, 6.0)
    both, told = Splat.cat([WALL, near, far]), torch.arange(3 * len(WALL)) < 2 * len(WALL)
    found = spread(both, both.part_logits, told)
    assert torch.equal(found.argmax(-1), both.part_ids.where(told, 2))


def test_labels_stay_where_all_or_none_are_told():
    for told in (torch.ones(400, dtype=torch.bool), torch.zeros(400, dtype=torch.bool)):
        assert torch.equal(spread(WALL, WALL.part_logits, told), WALL.part_logits)


def test_few_gaussians_and_such_at_one_place_are_labelled():
    one = WALL.select(torch.tensor([0, 0, 0, 1]))
    found = spread(one, one.part_logits, torch.tensor([True, False, False, False]))
    assert found.argmax(-1).tolist() == [1, 1, 1, 1] and found.isfinite().all()
    assert math.isclose(float(found[0].logsumexp(0)), float(WALL.part_logits[0].logsumexp(0)))


def test_another_state_tells_what_rests_and_nothing_of_what_has_another_colour():
    """The wall of one state, half of it told, lies where another state has a drawer in front, or its own wall."""
    here, elsewhere = WALL, replace(WALL, part_logits=DRAWER.part_logits)
    both, states = Splat.cat([here, elsewhere]), torch.arange(2).repeat_interleave(len(WALL))
    told = torch.cat([here.means[:, 0] < 0.45, torch.ones(len(WALL), dtype=torch.bool)])
    found = spread(both, both.part_logits, told, states).argmax(-1)[: len(WALL)]
    assert (found[here.means[:, 0] > 1] == 2).all()  # as the other state's, which looks alike
    painted = Splat.cat([here, replace(elsewhere, sh=elsewhere.sh + 1.0)])
    assert (spread(painted, both.part_logits, told, states).argmax(-1)[: len(WALL)] == 1).all()
