from dataclasses import replace

import pytest
import torch
from part_scene import box, photograph

from splatart_ns.geometry.se3 import transform_points
from splatart_ns.rasterize.render import render
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.thinning import LARGEST_SHARE, Absences, absences, expendable, veils


def images(splat: Splat, views) -> torch.Tensor:
    """Premultiplied colours and accumulations [V, H, W, 4]."""
    pictures = [render(splat, v.viewmat[None], v.K[None], v.width, v.height, with_depth=False) for v in views]
    return torch.cat([torch.cat([p.rgb, p.accumulation], dim=-1) for p in pictures])


def test_absence_is_what_the_images_miss_without_a_gaussian():
    splat = box(1, (0.8, 0.8, 0.8), (0.0, 0.0, 0.0), spacing=0.2)
    views = photograph(splat, 2, 48)
    found = sum(absences(splat, views, seed).images for seed in range(30)) / 30
    whole, everything, tried = images(splat, views), torch.arange(len(splat)), range(0, len(splat), 3)
    missed = torch.stack([(images(splat.select(everything != k), views) - whole).square().sum() for k in tried])
    assert torch.corrcoef(torch.stack([found[::3], missed]))[0, 1] > 0.9
    assert float(found[::3].sum()) == pytest.approx(float(missed.sum()), rel=0.1)


def test_depth_and_weights_are_what_each_gaussian_makes_up():
    splat = box(1, (0.8, 0.8, 0.8), (0.0, 0.0, 0.0), spacing=0.2)
    views = photograph(splat, 2, 48)

    def shown(splat: Splat, features) -> torch.Tensor:
        pictures = [
            render(splat, v.viewmat[None], v.K[None], v.width, v.height, features=features(v), with_depth=False)
            for v in views
        ]
        return torch.cat([p.features for p in pictures])

    z = {v.name: transform_points(v.viewmat, splat.means)[:, 2] for v in views}
    z = {name: (x - x.mean())[:, None] for name, x in z.items()}
    whole, everything, tried = shown(splat, lambda v: z[v.name]), torch.arange(len(splat)), range(0, len(splat), 3)
    without = [shown(splat.select(everything != k), lambda v, k=k: z[v.name][everything != k]) for k in tried]
    marks = [shown(splat, lambda v, k=k: (everything == k)[:, None].float()) for k in tried]
    true = torch.stack([(x - whole).square().sum() for x in without]), torch.stack([x.square().sum() for x in marks])
    found = [absences(splat, views, seed) for seed in range(30)]
    found = sum(x.depth for x in found) / 30, sum(x.weight for x in found) / 30
    for measured, exact in zip(found, true, strict=True):
        assert torch.corrcoef(torch.stack([measured[::3], exact]))[0, 1] > 0.9
        assert float(measured[::3].sum()) == pytest.approx(float(exact.sum()), rel=0.1)


def sheet(z: float, colour: float, opacity: float, side: float) -> Splat:
    """A square across z of Gaussians of one colour."""
    flat = box(1, (side, side, 0.02), (0.0, 0.0, z))
    flat = flat.select((flat.means[:, 2] - z).abs() < 0.011)
    return replace(
        flat,
        sh=torch.full_like(flat.sh, (colour - 0.5) / 0.28209479),
        opacity_logits=torch.full_like(flat.opacity_logits, opacity).logit(),
    )


@pytest.mark.parametrize(
    ("before", "colour", "opacity", "wall", "veil"),
    [
        (0.4, 0.6, 0.15, True, True),
        (0.05, 0.6, 0.15, True, False),  # as near as Gaussians of one surface
        (0.4, 0.05, 0.15, True, False),  # another colour
        (0.4, 0.6, 0.97, True, False),  # opaque
        (0.4, 0.6, 0.15, False, False),  # before nothing
    ],
)
def test_what_hangs_translucent_before_a_wall_of_its_colour_is_a_veil(before, colour, opacity, wall, veil):
    back, front = sheet(0.0, 0.6, 0.95, 1.2), sheet(before, colour, opacity, 0.6)
    splat = Splat.cat([back, front]) if wall else front
    of_front = slice(len(splat) - len(front), None)
    views = [view for view in photograph(splat, 240) if float(view.viewmat[2, 2]) < -0.8]  # from above
    assert len(views) >= 15
    found = veils(absences(splat, views, 0), splat)
    assert found[of_front].float().mean() > 0.8 if veil else not found[of_front].any()
    assert not found[: of_front.start].any()


def test_absences_of_parts_that_some_views_do_not_have_add_up():
    splat = box(1, (0.8, 0.8, 0.8), (0.0, 0.0, 0.0), spacing=0.2)
    views = photograph(splat, 2, 48)
    shown = torch.arange(len(splat)) % 2 == 0
    some, rest = absences(splat, views[:1], 0), absences(splat.select(shown), views[1:], 0)
    total = Absences.none(splat).plus(some, torch.ones_like(shown)).plus(rest, shown)
    for name in ("images", "depth", "weight"):
        of_all, mine, theirs = (getattr(x, name) for x in (total, some, rest))
        torch.testing.assert_close(of_all[shown], mine[shown] + theirs)
        torch.testing.assert_close(of_all[~shown], mine[~shown])
    assert total.error == pytest.approx(some.error + rest.error)


def test_no_gaussians_have_no_veils():
    nothing = box(1, (0.8, 0.8, 0.8), (0.0, 0.0, 0.0)).select(torch.zeros(0, dtype=torch.long))
    assert len(veils(Absences.none(nothing), nothing)) == 0


def test_the_error_of_the_images_is_that_of_colour_and_accumulation():
    splat = box(1, (0.8, 0.8, 0.8), (0.0, 0.0, 0.0))
    views = photograph(splat, 4)
    # All that is left to differ is what 8 bits a channel round off.
    assert absences(splat, views, 0).error < 1e-4 * float(images(splat, views).square().sum())
    assert absences(splat.select(torch.arange(len(splat)) % 2 == 0), views, 0).error > 10
    masked = [replace(v, mask=torch.zeros(v.height, v.width, dtype=torch.bool)) for v in views]
    nothing = absences(splat, masked, 0)
    assert nothing.error == 0 and not any(x.any() for x in (nothing.images, nothing.depth, nothing.weight))


def test_what_is_hidden_and_what_repeats_something_goes_first():
    cube = box(1, (0.8, 0.8, 0.8), (0.0, 0.0, 0.0))
    hidden = box(1, (0.2, 0.2, 0.2), (0.0, 0.0, 0.0))
    copies = cube.select(torch.arange(len(cube)) % 4 == 0)
    copies = replace(copies, means=0.97 * copies.means)
    splat = Splat.cat([cube, hidden, copies])
    absence = absences(splat, photograph(splat), 0).images
    of_cube, of_hidden, of_copies = absence.split([len(cube), len(hidden), len(copies)])
    assert of_hidden.max() < 0.15 * of_cube.median()
    assert of_copies.median() < 0.2 * of_cube.median()


def test_images_hardly_change_where_little_is_missed():
    cube = box(1, (0.8, 0.8, 0.8), (0.0, 0.0, 0.0))
    twice = Splat.cat([cube, replace(cube, means=0.97 * cube.means)])
    views = photograph(twice)
    absence = absences(twice, views, 0).images
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
