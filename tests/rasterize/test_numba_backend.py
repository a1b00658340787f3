import os
from concurrent.futures import ThreadPoolExecutor

import naive
import numpy as np
import pytest
import torch
from scenes import LEAVES, image_and_gradients
from scenes import pixel_scene as scene

pytest.importorskip("numba")
from splatart_ns.rasterize import torch_backend
from splatart_ns.rasterize.numba_backend import rasterize_to_pixels
from splatart_ns.rasterize.numba_runtime import jit, run


@pytest.fixture
def num_threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def assert_equals_naive(scene):
    expected, expected_gradients = image_and_gradients(naive.composite, scene, torch.float64)
    image, gradients = image_and_gradients(rasterize_to_pixels, scene, torch.float32)
    assert image.dtype == torch.float32
    assert (image - expected).abs().max() <= 1e-5
    for name, gradient, reference in zip(LEAVES, gradients, expected_gradients, strict=True):
        assert gradient.isfinite().all(), name
        assert (gradient - reference).norm() <= 1e-5 * reference.norm().clamp_min(1e-9), name


@pytest.mark.parametrize("width, height", [(29, 21), (16, 8), (1, 1), (7, 40)])
@pytest.mark.parametrize("D", [1, 3, 4, 12, 17])
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


@pytest.mark.parametrize("opacity", [0.01, 0.9])
def test_thousands_on_one_pixel_underflow_nothing(opacity):
    s = scene(N=2500)
    s["means2d"][:] = torch.tensor([11.3, 9.8])
    s["opacities"] = opacity * (0.9 + 0.1 * s["opacities"])
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
    conics = [c * c * long + sn * sn * thin, c * sn * (long - thin), sn * sn * long + c * c * thin]
    s["conics"] = torch.stack(conics, -1).float().double()
    s["means2d"] = s["means2d"].float().double() * 5 - 40
    assert_equals_naive(s)


def test_conics_made_indefinite_by_rounding_stay_finite():
    s = scene(N=3)
    s["conics"][:] = torch.tensor([1.0, 1.0 + 1e-6, 1.0])
    image, gradients = image_and_gradients(rasterize_to_pixels, s, torch.float32)
    assert image.isfinite().all() and image.abs().max() > 0
    assert all(g.isfinite().all() for g in gradients)


@pytest.mark.parametrize("C, N", [(1, 1), (3, 2)])
def test_few_gaussians(C, N):
    assert_equals_naive(scene(C=C, N=N))


def test_no_gaussians_are_black():
    image, gradients = image_and_gradients(rasterize_to_pixels, scene(C=2, N=0), torch.float32)
    assert image.shape == (2, 21, 29, 4) and (image == 0).all()
    assert [g.shape for g in gradients] == [(2, 0, 2), (2, 0, 3), (2, 0), (2, 0, 3)]


def test_what_is_not_drawn_is_black_with_zero_gradients():
    for change in ({"visible": False}, {"opacities": 0.0039}, {"opacities": 0.0}, {"means2d": -1e4}, {"means2d": 1e30}):
        s = scene()
        for name, value in change.items():
            s[name][:] = value
        image, gradients = image_and_gradients(rasterize_to_pixels, s, torch.float32)
        assert (image == 0).all(), change
        assert all((g == 0).all() for g in gradients), change


def test_invisible_gaussians_may_hold_anything():
    s = scene()
    expected, expected_gradients = image_and_gradients(rasterize_to_pixels, s, torch.float32)
    for name in LEAVES + ("depths",):
        s[name][~s["visible"]] = float("nan")
    image, gradients = image_and_gradients(rasterize_to_pixels, s, torch.float32)
    assert torch.equal(image, expected)
    assert all(map(torch.equal, gradients, expected_gradients))


def test_results_do_not_depend_on_the_number_of_threads(num_threads):
    results = []
    for threads in (1, 2, 3):
        num_threads(threads)
        results.append(image_and_gradients(rasterize_to_pixels, scene(C=2, N=500, width=90, height=70), torch.float32))
    for image, gradients in results[1:]:
        assert torch.equal(image, results[0][0])
        assert all(map(torch.equal, gradients, results[0][1]))


def test_may_be_called_from_several_threads_at_once(num_threads):
    num_threads(2)
    scenes = [scene(N=400, width=80, height=60, seed=seed) for seed in range(4)]
    expected = [image_and_gradients(rasterize_to_pixels, s, torch.float32) for s in scenes]
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda s: image_and_gradients(rasterize_to_pixels, s, torch.float32), scenes * 5))
    for i, (image, gradients) in enumerate(results):
        assert torch.equal(image, expected[i % 4][0])
        assert all(map(torch.equal, gradients, expected[i % 4][1]))


@pytest.mark.parametrize("leaf", LEAVES)
def test_one_gradient_alone_equals_that_among_all(leaf):
    s = scene(D=6)
    _, expected = image_and_gradients(rasterize_to_pixels, s, torch.float32)
    s = {k: v.float() if torch.is_tensor(v) and v.is_floating_point() else v for k, v in s.items()}
    s[leaf].requires_grad_()
    image = torch.cat(rasterize_to_pixels(**s), -1)
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).float()
    (image * weights).sum().backward()
    assert torch.equal(s[leaf].grad, expected[LEAVES.index(leaf)])


def test_absgrad_sums_absolute_gradients_of_single_pixels():
    s = scene(C=2, N=30, width=12, height=9)
    s["means2d"].requires_grad_()
    expected = torch.zeros_like(s["means2d"])
    weights = torch.randn(2, 9, 12, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    image, _ = naive.composite(**s)
    for pixel in (image * weights).sum(-1).flatten():
        expected += torch.autograd.grad(pixel, s["means2d"], retain_graph=True)[0].abs()

    s = {k: v.float() if torch.is_tensor(v) and v.is_floating_point() else v for k, v in s.items()}
    means2d = s["means2d"] = s["means2d"] * 1.0
    means2d.retain_grad()
    image, _ = rasterize_to_pixels(**s, absgrad=True)
    (image * weights.float()).sum().backward()
    torch.testing.assert_close(means2d.absgrad.double(), expected, rtol=1e-4, atol=1e-5)
    assert (means2d.grad.abs() <= means2d.absgrad + 1e-5).all()


def test_equals_the_torch_backend_on_a_larger_scene():
    s = scene(C=2, N=3000, D=5, width=150, height=111, seed=5)
    expected, expected_gradients = image_and_gradients(torch_backend.rasterize_to_pixels, s, torch.float64)
    image, gradients = image_and_gradients(rasterize_to_pixels, s, torch.float32)
    difference = (image - expected).abs()
    # A pixel where alpha is 1/255 to within rounding may differ by one faint layer.
    assert difference.mean() <= 1e-6 and (difference > 1e-5).float().mean() <= 1e-4
    for gradient, reference in zip(gradients, expected_gradients, strict=True):
        assert (gradient - reference).norm() <= 1e-3 * reference.norm()


def test_arguments_may_be_views_without_contiguous_memory():
    s = scene(C=2, N=50)
    expected, expected_gradients = image_and_gradients(rasterize_to_pixels, s, torch.float32)

    def strided(means2d, conics, opacities, colors, depths, visible, width, height):
        expanded = (t.mT.contiguous().mT for t in (means2d, conics))
        return rasterize_to_pixels(
            *expanded, opacities.T.contiguous().T, colors.mT.contiguous().mT, depths, visible, width, height
        )

    image, gradients = image_and_gradients(strided, s, torch.float32)
    assert torch.equal(image, expected)
    assert all(map(torch.equal, gradients, expected_gradients))


def test_kernels_compile_where_no_cache_can_be_kept():
    names = {}
    exec("def double(begin, end, worker, values): values[begin:end] *= 2", names)
    values = np.arange(3.0)
    run(jit(names["double"]), np.array([0, 2, 3]), values)
    assert values.tolist() == [0.0, 2.0, 4.0]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.skipif(torch.cuda.is_available(), reason="with CUDA torch refuses gradients in forked processes")
def test_a_forked_child_renders(num_threads):
    num_threads(2)
    s = scene(N=50)
    image_and_gradients(rasterize_to_pixels, s, torch.float32)
    child = os.fork()
    if child == 0:
        status = 1
        try:
            image_and_gradients(rasterize_to_pixels, s, torch.float32)
            status = 0
        finally:
            os._exit(status)
    assert os.waitpid(child, 0)[1] == 0
