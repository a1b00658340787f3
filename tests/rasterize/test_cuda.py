"""What renders on a GPU, against the torch backend in float64 on the CPU."""

import pytest
import torch
from scenes import WORLD_LEAVES, image_and_gradients, world_scene

from splatart_ns.rasterize.rasterization import rasterization
from splatart_ns.rasterize.ssim import l1_ssim_loss

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA here")


def on_cuda(backend, dtype=torch.float32, **changes):
    """`image_and_gradients` of a scene there, and of the same one in float64 on the CPU."""
    scene = world_scene(500, C=2) | changes
    truth = image_and_gradients(rasterization, scene, torch.float64, WORLD_LEAVES)
    scene = {k: v.cuda() if torch.is_tensor(v) else v for k, v in scene.items()}

    def render(**scene):
        return tuple(x.cpu() for x in rasterization(**scene, backend=backend)[:2])

    return image_and_gradients(render, scene, dtype, WORLD_LEAVES), truth


def assert_close(ours, truth, bound):
    assert (ours[0] - truth[0]).norm() <= bound * truth[0].norm()
    for name, a, b in zip(WORLD_LEAVES, ours[1], truth[1], strict=True):
        assert (a.cpu() - b).norm() <= bound * b.norm(), name


def test_gsplat_agrees_to_its_three_sigma_support():
    ours, truth = on_cuda("gsplat")
    # What lies beyond three deviations has alpha up to exp(-4.5) = 0.011, in few pixels.
    assert (ours[0] - truth[0]).abs().max() <= 0.03
    assert (ours[0] - truth[0]).abs().mean() <= 5e-4
    assert_close(ours, truth, 0.03)


def test_gsplat_agrees_where_nothing_is_drawn_beyond_three_deviations():
    # Up to 0.35 exp(-4.5) = 1 / 257 alpha is skipped there by all.
    ours, truth = on_cuda("gsplat", opacities=0.35 * world_scene(500)["opacities"])
    assert_close(ours, truth, 2e-4)  # compiled with --use_fast_math


@pytest.mark.parametrize("dtype, bound", [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_the_torch_backend_is_the_same_there(dtype, bound):
    assert_close(*on_cuda("torch", dtype), bound)


@pytest.mark.parametrize("render_mode", ["RGB", "RGB+D", "RGB+ED"])
def test_many_channels_and_depth_pass_through_gsplat(render_mode):
    scene = world_scene(500, C=2, D=40)
    scene["opacities"] *= 0.35
    expected = rasterization(**scene, render_mode=render_mode)[0]
    scene = {k: v.float().cuda() if torch.is_tensor(v) else v for k, v in scene.items()}
    image = rasterization(**scene, render_mode=render_mode, backend="gsplat")[0]
    assert image.shape == expected.shape
    assert (image.cpu() - expected).norm() <= 2e-4 * expected.norm()


@pytest.mark.parametrize("count, shift", [(0, 0.0), (1, 0.0), (60, -100.0)])
def test_gsplat_renders_none_one_and_none_visible(count, shift):
    scene = {k: v.float().cuda() if torch.is_tensor(v) else v for k, v in world_scene(count).items()}
    scene["means"][:, 2] += shift
    image, alpha, _ = rasterization(**scene, backend="gsplat")
    expected, expected_alpha, _ = rasterization(**scene, backend="torch")
    torch.testing.assert_close(alpha, expected_alpha, atol=0.011, rtol=0)
    torch.testing.assert_close(image, expected, atol=0.011, rtol=0)


@pytest.mark.parametrize("size", [(40, 33), (300, 200)])
def test_the_loss_of_images_is_as_exact_there(size):
    image, target = torch.rand(2, *size, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = []
    for x, y in ((image, target), (image.float().cuda(), target.float().cuda())):
        x.requires_grad_()
        loss = l1_ssim_loss(x, y)
        found.append((loss.detach().cpu(), torch.autograd.grad(loss, x)[0].cpu()))
    assert abs(found[1][0] - found[0][0]) <= 1e-6
    assert (found[1][1] - found[0][1]).norm() <= 1e-5 * found[0][1].norm()
