from dataclasses import replace

import pytest
import torch
from part_scene import box, photograph

from splatart_ns.rasterize.render import render
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.thinning import LARGEST_SHARE, absences, expendable


def images(splat: Splat, views) -> torch.Tensor:
    """Premultiplied colours and accumulations [V, H, W, 4]."""
    pictures = [render(splat, v.viewmat[None], v.K[None], v.width, v.height, with_depth=False) for v in views]
    return torch.cat([torch.cat([p.rgb, p.accumulation], dim=-1) for p in pictures])


def test_absence_is_what_the_images_miss_without_a_gaussian():
    splat = box(1, (0.8, 0.8, 0.8), (0.0, 0.0, 0.0), spacing=0.2)
    views = photograph(splat, 2, 48)
    found = sum(absences(splat, views, seed)[0] for seed in range(30)) / 30
    whole, everything, tried = images(splat, views), torch.arange(len(splat)), range(0, len(splat), 3)
    missed = torch.stack([(images(splat.select(everything != k), views) - whole).square().sum() for k in tried])
    assert torch.corrcoef(torch.stack([found[::3], missed]))[0, 1] > 0.9
    assert float(found[::3].sum()) == pytest.approx(float(missed.sum()), rel=0.1)


def test_the_error_of_the_images_is_that_of_colour_and_accumulation():
    splat = box(1, (0.8, 0.8, 0.8), (0.0, 0.0, 0.0))
    views = photograph(splat, 4)
    # All that is left to differ is what 8 bits a channel round off.
    assert absences(splat, views, 0)[1] < 1e-4 * float(images(splat, views).square().sum())
    assert absences(splat.select(torch.arange(len(splat)) % 2 == 0), views, 0)[1] > 10
    masked = [replace(v, mask=torch.zeros(v.height, v.width, dtype=torch.bool)) for v in views]
    absence, error = absences(splat, masked, 0)
    assert error == 0 and not absence.any()


def test_what_is_hidden_and_what_repeats_something_goes_first():
    cube = box(1, (0.8, 0.8, 0.8), (0.0, 0.0, 0.0))
    hidden = box(1, (0.2, 0.2, 0.2), (0.0, 0.0, 0.0))
    copies = cube.select(torch.arange(len(cube)) % 4 == 0)
    copies = replace(copies, means=0.97 * copies.means)
    splat = Splat.cat([cube, hidden, copies])
    absence, _ = absences(splat, photograph(splat), 0)
    of_cube, of_hidden, of_copies = absence.split([len(cube), len(hidden), len(copies)])
    assert of_hidden.max() < 0.15 * of_cube.median()
    assert of_copies.median() < 0.2 * of_cube.median()


def test_images_hardly_change_where_little_is_missed():
    cube = box(1, (0.8, 0.8, 0.8), (0.0, 0.0, 0.0))
    twice = Splat.cat([cube, replace(cube, means=0.97 * cube.means)])
    views = photograph(twice)
    absence, _ = absences(twice, views, 0)
    budget = 1e-3 * float(images(twice, views).square().sum())
    goes = expendable(absence, twice.part_ids, budget)
    assert goes.sum() == int(LARGEST_SHARE * len(twice))
    assert (images(twice.select(~goes), views) - images(twice, views)).square().sum() < budget


def test_no_more_goes_than_the_budget_allows():
    absence = torch.tensor([4.0, 1.0, 9.0, 2.0, 9.0, 9.0] * 6)
    ids = torch.ones(36, dtype=torch.long)
    assert not expendable(absence, ids, 0.5).any()
    goes = expendable(absence, ids, 3.0)
    assert goes.sum() == 3 and absence[goes].tolist() == [1.0] * 3
    assert expendable(absence, ids, 1e9).sum() == 6


def test_no_part_vanishes_however_little_it_shows():
    absence = torch.cat([torch.full((600,), 1.0), torch.full((13,), 1e-6), torch.full((3,), 1e-6)])
    ids = torch.cat([torch.full((600,), 1), torch.full((13,), 2), torch.full((3,), 3)])
    goes = expendable(absence, ids, 1e9)
    assert [int(goes[ids == p].sum()) for p in (1, 2, 3)] == [100, 2, 0]
