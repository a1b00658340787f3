import pytest
import torch
from pytorch_msssim import SSIM

from splatart_ns.rasterize.ssim import l1_ssim_loss, ssim


def images(height, width, dtype=torch.float32, seed=0):
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(height, width, 3, generator=generator, dtype=torch.float64)
    noise = torch.randn(height, width, 3, generator=generator, dtype=torch.float64)
    target = (image + 0.2 * noise).clamp(0, 1).to(dtype)
    return image.to(dtype).requires_grad_(), target


def reference(image, target):
    similarity = SSIM(data_range=1.0, size_average=True, channel=3)
    similarity.win = similarity.win.to(image.dtype)
    return similarity(image.movedim(-1, 0)[None], target.movedim(-1, 0)[None])


# Widths on both sides of the compiled path's blocks of 80 pixels.
SIZES = [(11, 11), (40, 33), (23, 80), (12, 90), (31, 91), (20, 170)]


@pytest.mark.parametrize("height, width", SIZES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_value_and_gradient_equal_those_of_pytorch_msssim(height, width, dtype):
    image, target = images(height, width, dtype)
    value = ssim(image, target)
    # The window of pytorch_msssim is made in float32.
    expected = reference(image.double(), target.double())
    assert value.shape == () and value.dtype == dtype
    assert abs(value - expected) <= 1e-6
    (gradient,) = torch.autograd.grad(value, image)
    (expected,) = torch.autograd.grad(expected, image)
    assert (gradient - expected).norm() <= 5e-6 * expected.norm()


@pytest.mark.parametrize("height, width", [*SIZES, (10, 10), (1, 1), (2, 30), (40, 7)])
def test_compiled_and_torch_paths_agree_on_every_size(height, width):
    image, target = images(height, width)
    image64 = image.detach().double().requires_grad_()
    for function in (ssim, l1_ssim_loss):
        value, expected = function(image, target), function(image64, target)
        # A variance is a difference of float32 moments; over many pixels the roundings average out.
        tolerance = 1e-6 if min(height, width) > 2 else 1e-3
        assert abs(value - expected) <= tolerance
        (gradient,), (expected,) = torch.autograd.grad(value, image), torch.autograd.grad(expected, image64)
        assert (gradient - expected).norm() <= 100 * tolerance * expected.norm()


def test_gradcheck():
    image, target = images(13, 12, torch.float64)
    assert torch.autograd.gradcheck(lambda x: ssim(x, target), image)
    assert torch.autograd.gradcheck(lambda x: l1_ssim_loss(x, target, 0.3), image)


def test_loss_mixes_l1_and_ssim():
    image, target = images(30, 20)
    l1, similarity = (image - target).abs().mean(), reference(image, target)
    for weight in (0.0, 0.2, 1.0):
        loss = l1_ssim_loss(image, target, weight)
        expected = (1 - weight) * l1 + weight * (1 - similarity)
        assert abs(loss - expected) <= 1e-6
        (gradient,), (expected,) = (torch.autograd.grad(v, image, retain_graph=True) for v in (loss, expected))
        assert (gradient - expected).norm() <= 5e-6 * expected.norm()


@pytest.mark.parametrize("size", [30, 5])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equal_images_are_similar_to_one_with_zero_gradient(size, dtype):
    image = images(size, size, dtype)[0]
    value = ssim(image, image.detach())
    assert abs(value - 1) <= 1e-6
    assert torch.autograd.grad(value, image)[0].abs().max() <= 1e-5


def test_constant_images_have_finite_gradients():
    image = torch.zeros(20, 20, 3, requires_grad=True)
    l1_ssim_loss(image, torch.ones(20, 20, 3)).backward()
    assert image.grad.isfinite().all()


def test_results_do_not_depend_on_the_number_of_threads():
    image, target = images(50, 110)
    results, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            value = ssim(image, target)
            results.append((value.item(), torch.autograd.grad(value, image)[0]))
    finally:
        torch.set_num_threads(before)
    for value, gradient in results[1:]:
        assert value == results[0][0] and torch.equal(gradient, results[0][1])


def test_images_may_be_views_and_need_no_gradient():
    image, target = images(40, 30)
    whole = torch.cat([image.detach(), torch.ones(40, 30, 1)], -1)
    value = ssim(whole[..., :3], target)
    assert not value.requires_grad
    assert value == ssim(image, target)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(20, 29, 3), (15, 30, 3), (20, 30, 4), (20, 30)])
def test_shapes_that_differ_are_named(dtype, shape):
    image, other = torch.rand(20, 30, 3, dtype=dtype), torch.rand(shape, dtype=dtype)
    for one, two in ((image, other), (other, image), *([] if shape[-1] == 3 else [(other, other)])):
        with pytest.raises(ValueError, match=r"image has the shape .*; give \[H, W, 3\] of both"):
            ssim(one, two)
