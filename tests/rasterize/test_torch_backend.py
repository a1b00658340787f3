import naive
import pytest
import torch
from scenes import LEAVES, image_and_gradients
from scenes import pixel_scene as scene

from splatart_ns.rasterize import torch_backend
from splatart_ns.rasterize.torch_backend import rasterize_to_pixels


def assert_equals_naive(scene):
    expected, expected_gradients = image_and_gradients(naive.composite, scene, torch.float64)
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 2e-5)):
        image, gradients = image_and_gradients(rasterize_to_pixels, scene, dtype)
        assert image.dtype == dtype
        assert (image - expected).abs().max() <= tolerance
        for name, gradient, reference in zip(LEAVES, gradients, expected_gradients, strict=True):
            assert gradient.isfinite().all(), name
            assert (gradient - reference).norm() <= tolerance * reference.norm().clamp_min(1e-9), name


@pytest.mark.parametrize("width, height", [(29, 21), (16, 8), (1, 1), (7, 40)])
@pytest.mark.parametrize("D", [1, 3, 12])
def test_image_and_gradients_equal_the_naive_ones(width, height, D):
    assert_equals_naive(scene(C=2, D=D, width=width, height=height))


def test_opacities_of_zero_and_one():
    s = scene()
    s["opacities"][0, ::3] = 0
    s["opacities"][0, 1::3] = 1
    assert_equals_naive(s)


def test_pixels_stop_when_opaque_and_full_tiles_are_left():
    s = scene(N=300, seed=3)
    s["opacities"] = 0.5 + 0.5 * s["opacities"]
    s["conics"] = s["conics"] * 0.1
    assert_equals_naive(s)


def test_many_on_one_pixel_underflow_nothing():
    s = scene(N=2000)
    s["means2d"][:] = torch.tensor([11.3, 9.8])
    s["opacities"] = 0.005 + 0.01 * s["opacities"]
    assert_equals_naive(s)


def test_equal_depths_keep_their_order():
    s = scene(N=60)
    s["depths"][:] = 2.0
    assert_equals_naive(s)


def test_depths_of_either_sign_sort_by_value():
    s = scene(N=60)
    s["depths"] = s["depths"].float().double() - 1.5
    assert_equals_naive(s)


def test_needles_across_the_image_keep_their_digits():
    s = scene(N=40)
    angle = s["depths"] * 3
    c, sn = angle.cos(), angle.sin()
    thin, long = 1 / 0.3, 1 / 300.0**2
    s["conics"] = torch.stack(
        [c * c * long + sn * sn * thin, c * sn * (long - thin), sn * sn * long + c * c * thin], -1
    )
    s["conics"] = s["conics"].float().double()  # rounding the conics themselves is not what is tested here
    s["means2d"] = s["means2d"].float().double() * 5 - 40
    assert_equals_naive(s)


def test_one_gaussian():
    assert_equals_naive(scene(N=1))


@pytest.mark.parametrize("why", ["none", "invisible", "faint", "elsewhere"])
def test_nothing_drawn_is_black_with_zero_gradients(why):
    s = scene(N=0 if why == "none" else 9)
    if why == "invisible":
        s["visible"][:] = False
    elif why == "faint":
        s["opacities"][:] = 0.0039
    elif why == "elsewhere":
        s["means2d"] += 1e6
    image, gradients = image_and_gradients(rasterize_to_pixels, s, torch.float32)
    assert image.shape == (1, 21, 29, 4) and (image == 0).all()
    assert all((g == 0).all() for g in gradients)


def test_invisible_gaussians_may_hold_anything():
    s = scene()
    expected = image_and_gradients(rasterize_to_pixels, s, torch.float64)
    for name in LEAVES + ("depths",):
        s[name][~s["visible"]] = float("nan")
    image, gradients = image_and_gradients(rasterize_to_pixels, s, torch.float64)
    assert torch.equal(image, expected[0])
    for gradient, reference in zip(gradients, expected[1], strict=True):
        assert torch.equal(gradient, reference)


def test_gradcheck():
    s = scene(N=6, D=2, width=10, height=9)
    # Away from the cut at 1/255, across which the image jumps: everything is drawn everywhere.
    s["conics"] = s["conics"] * 0.0 + torch.tensor([0.01, 0.004, 0.012])
    s["opacities"] = 0.3 + 0.4 * s["opacities"]
    leaves = [s.pop(name).requires_grad_() for name in LEAVES]
    assert torch.autograd.gradcheck(lambda *a: rasterize_to_pixels(*a, **s), leaves)


def test_absgrad_sums_absolute_gradients_of_single_pixels():
    s = scene(C=2, N=30, width=12, height=9)
    s["means2d"].requires_grad_()
    expected = torch.zeros_like(s["means2d"])
    weights = torch.randn(2, 9, 12, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    image, _ = naive.composite(**s)
    for pixel in (image * weights).sum(-1).flatten():
        expected += torch.autograd.grad(pixel, s["means2d"], retain_graph=True)[0].abs()

    means2d = s["means2d"] * 1.0
    s["means2d"] = means2d
    means2d.retain_grad()
    image, _ = rasterize_to_pixels(**s, absgrad=True)
    (image * weights).sum().backward()
    torch.testing.assert_close(means2d.absgrad, expected, rtol=1e-9, atol=1e-12)
    assert (means2d.grad.abs() <= means2d.absgrad + 1e-12).all()


@pytest.mark.parametrize("limit, value", [("SLOTS", 48), ("BLOCKS", 1), ("KEPT_BYTES", 0), ("KEPT_BYTES", 200_000)])
def test_the_size_of_steps_and_what_is_kept_of_them_change_nothing(monkeypatch, limit, value):
    s = scene(N=300, width=40, height=40)
    expected, expected_gradients = image_and_gradients(rasterize_to_pixels, s, torch.float64)
    monkeypatch.setattr(torch_backend, limit, value)
    image, gradients = image_and_gradients(rasterize_to_pixels, s, torch.float64)
    torch.testing.assert_close(image, expected, rtol=0, atol=1e-14)
    torch.testing.assert_close(gradients, expected_gradients)
