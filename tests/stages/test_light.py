"""Light that is even over a few pixels makes no difference; edges and silhouettes do."""

import pytest
import torch

from splatart_ns.stages.light import even_light


def in_even_light(rgba: torch.Tensor, wanted: torch.Tensor, weight: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    gain, inside = even_light(rgba, wanted, weight)
    return torch.cat([rgba[..., :3] * gain[..., None], rgba[..., 3:]], -1), inside


def difference_in_even_light(rgba: torch.Tensor, wanted: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """How much brighter pictures are, inside the silhouettes [K, H, W, 1]."""
    lit, inside = in_even_light(rgba, wanted, weight)
    return ((lit - wanted)[..., :3].mean(-1) * inside)[..., None]


def grey(brightness: torch.Tensor, alpha: torch.Tensor | None = None) -> torch.Tensor:
    """Pictures [..., H, W, 4] of grey surfaces over black."""
    alpha = torch.ones_like(brightness) if alpha is None else alpha
    return torch.stack([brightness * alpha] * 3 + [alpha], -1)


@pytest.fixture
def prints():
    """A dark print on a bright surface [40, 40]."""
    brightness = torch.full((40, 40), 0.6)
    brightness[15:25, 12:22] = 0.3
    return brightness


INSIDE = (slice(None), slice(8, -8), slice(8, -8), 0)


@pytest.mark.parametrize("gain", [0.6, 1.5])
def test_how_brightly_a_surface_is_lit_makes_no_difference(prints, gain):
    ramp = torch.linspace(1.0, gain, 40)
    found = difference_in_even_light(grey(gain * prints)[None], grey(prints), torch.ones(40, 40))
    assert found[INSIDE].abs().max() < 0.02
    # Nor does a light that changes slowly over the surface.
    found = difference_in_even_light(grey(ramp * prints)[None], grey(prints), torch.ones(40, 40))
    assert found[INSIDE].abs().max() < 0.02
    assert ((ramp - 1) * prints).abs().max() > 0.15


@pytest.mark.parametrize("gain", [0.6, 1.5])
def test_nor_does_it_in_any_colour(prints, gain):
    ramp = torch.linspace(1.0, gain, 40)
    yellow = grey(prints) * torch.tensor([1.0, 0.8, 0.1, 1.0])
    for light in (torch.full((40,), gain), ramp):
        other = torch.cat([yellow[..., :3] * light[:, None], yellow[..., 3:]], -1)
        lit, _ = in_even_light(other[None], yellow, torch.ones(40, 40))
        inside = (lit - yellow)[:, 8:-8, 8:-8]
        assert inside.abs().max() < 0.03 < (other - yellow)[8:-8, 8:-8].abs().max()


def test_a_print_that_is_elsewhere_makes_one_under_any_light(prints):
    moved = prints.roll(2, dims=1)
    under = [difference_in_even_light(grey(g * moved)[None], grey(prints), torch.ones(40, 40)) for g in (0.7, 1.0)]
    for found in under:
        assert found[0, 20, 10:14, 0].abs().max() > 0.15
    assert torch.allclose(under[0], under[1], atol=0.03)


def test_it_fades_towards_the_silhouette_and_is_nothing_outside(prints):
    alpha = torch.zeros(40, 40)
    alpha[:, 10:] = 1
    found = difference_in_even_light(grey(0.5 * prints.flip(1), alpha)[None], grey(prints, alpha), torch.ones(40, 40))
    assert found[0, :, :10].abs().max() == 0
    sharp = difference_in_even_light(grey(0.5 * prints.flip(1))[None], grey(prints), torch.ones(40, 40))
    assert found[0, 20, 10, 0].abs() < 0.7 * sharp[0, 20, 10, 0].abs()


def test_pixels_that_do_not_count_change_no_others(prints):
    weight = torch.ones(40, 40)
    weight[:, 30:] = 0
    wrong = prints.clone()
    wrong[:, 30:] = 0.0
    a, b = (difference_in_even_light(grey(x)[None], grey(prints), weight) for x in (prints, wrong))
    assert torch.equal(a[:, :, :30], b[:, :, :30])


def test_black_pictures_have_no_difference():
    black = torch.zeros(1, 20, 20, 4)
    assert torch.equal(difference_in_even_light(black, black[0], torch.ones(20, 20)), torch.zeros(1, 20, 20, 1))
