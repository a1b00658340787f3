from dataclasses import replace

import pytest
import torch
from part_scene import box, photograph

from splatart_ns.splats.splat import Splat
from splatart_ns.stages.image_error import MAX_VIEWS, image_error
from splatart_ns.stages.pose_notes import FAR, HARDLY


@pytest.fixture(scope="module")
def splat() -> Splat:
    return Splat.cat([box(1, (0.8, 0.8, 0.3), (0.0, 0.0, -0.3)), box(2, (0.4, 0.4, 0.2), (0.0, 0.0, 0.2))])


@pytest.fixture(scope="module")
def moved(splat) -> Splat:
    """With the second part where it is not."""
    return replace(splat, means=splat.means + torch.tensor([0.3, 0, 0]) * (splat.part_ids == 2)[:, None])


def test_a_splat_shows_its_own_pictures_but_for_what_is_rounded_off(splat):
    error = image_error(splat, photograph(splat, 3))
    assert error.psnr > 50 and error.of_object < 0.1 * HARDLY


def test_what_a_part_in_a_wrong_place_shows_is_its_error(splat, moved):
    views = photograph(splat, 3)
    error = image_error(moved, views)
    assert error.psnr < 30 and error.of_object > FAR * HARDLY
    assert error.by_part[2] > 0.4 * error.of_object and error.of_object == pytest.approx(float(error.by_part.sum()))
    blind = [replace(view, mask=torch.zeros(view.height, view.width, dtype=torch.bool)) for view in views[:2]]
    assert image_error(moved, [*blind, views[2]]).psnr == image_error(moved, views[2:]).psnr


def test_the_psnr_is_that_on_white_of_what_the_mask_leaves(splat, moved):
    (view,) = photograph(splat, 1)
    (other,) = photograph(moved, 1)
    for mask in (
        torch.ones(view.height, view.width, dtype=torch.bool),
        torch.arange(view.width) % 3 + 0 * view.alpha > 0,
    ):
        images = [of.rgb_on(torch.ones(3))[mask] for of in (view, other)]
        wanted = -10 * (images[0] - images[1]).square().mean().log10()
        assert image_error(moved, [replace(view, mask=mask)]).psnr == pytest.approx(float(wanted), abs=0.05)


def test_views_are_looked_at_from_the_first_to_the_last(splat, monkeypatch):
    looked = []

    def one(splat, view):
        looked.append(view.name)
        return torch.tensor(30.0), torch.zeros(3)

    monkeypatch.setattr("splatart_ns.stages.image_error._error", one)
    image_error(splat, [replace(view, name=str(k)) for k, view in enumerate(photograph(splat, 3) * 7)])
    assert sorted(map(int, looked)) == [0, 2, 5, 7, 10, 13, 15, 18] and len(looked) == MAX_VIEWS
