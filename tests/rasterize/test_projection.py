import math

import naive
import pytest
import torch

from splatart_ns.rasterize.projection import project

WIDTH, HEIGHT = 64, 48


def cameras(count=2):
    """Cameras that look at the origin from about 4 away, float64."""
    viewmats, Ks = [], []
    for i in range(count):
        angle = 0.7 * i + 0.2
        c, s = math.cos(angle), math.sin(angle)
        viewmats.append([[c, 0, -s, 0.1], [0.3 * s, 0.954, 0.3 * c, -0.2], [s, -0.3, c, 4 + 0.3 * i], [0, 0, 0, 1.0]])
        Ks.append([[70.0 + i, 0, 30], [0, 65.0, 25 - i], [0, 0, 1]])
    viewmats = torch.tensor(viewmats, dtype=torch.float64)
    U, _, V = torch.linalg.svd(viewmats[:, :3, :3])
    viewmats[:, :3, :3] = U @ V
    return viewmats, torch.tensor(Ks, dtype=torch.float64)


def gaussians(N=50, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def randn(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    return randn(N, 3) * 0.6, 3 * randn(N, 4), (0.5 * randn(N, 3) - 2.5).exp()


def reference(means, quats, scales, viewmats, Ks, eps2d=0.3):
    """means2d, conics, depths and compensations by matrices."""
    fx, fy, cx, cy = (Ks[:, i, j, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    margins = [
        (-cx / fx - 0.15 * WIDTH / fx, (WIDTH - cx) / fx + 0.15 * WIDTH / fx),
        (-cy / fy - 0.15 * HEIGHT / fy, (HEIGHT - cy) / fy + 0.15 * HEIGHT / fy),
    ]
    means2d, cov, depths = naive.project(means, quats, scales, viewmats, Ks, margins)
    blurred = cov + eps2d * torch.eye(2).to(cov)
    inverse = torch.linalg.inv(blurred)
    conics = torch.stack([inverse[..., 0, 0], inverse[..., 0, 1], inverse[..., 1, 1]], -1)
    return means2d, conics, depths, (torch.linalg.det(cov) / torch.linalg.det(blurred)).sqrt()


def outputs_and_gradients(function, inputs, dtype=torch.float64):
    leaves = [x.detach().to(dtype).requires_grad_() for x in inputs[:4]]
    outputs = function(*leaves, inputs[4].to(dtype))
    generator = torch.Generator().manual_seed(2)
    weights = [torch.randn(o.shape, generator=generator, dtype=torch.float64).to(dtype) for o in outputs]
    return outputs, torch.autograd.grad(outputs, leaves, weights)


def ours(*inputs):
    p = project(*inputs, WIDTH, HEIGHT)
    return p.means2d, p.conics, p.depths, p.compensations


def assert_equals_reference(inputs, tolerance=1e-9):
    outputs, gradients = outputs_and_gradients(ours, inputs)
    expected, expected_gradients = outputs_and_gradients(reference, inputs)
    for a, b in zip(outputs + gradients, expected + expected_gradients, strict=True):
        assert a.isfinite().all()
        assert (a - b).norm() <= tolerance * b.norm()


def test_values_and_gradients_equal_those_of_matrices():
    assert_equals_reference((*gaussians(), *cameras()))


def test_far_outside_the_image_the_slope_is_limited():
    means, quats, scales = gaussians()
    means[:, 0] += torch.linspace(-12, 12, len(means))
    means[:, 1] += torch.linspace(9, -9, len(means))
    viewmats, Ks = cameras(1)
    assert_equals_reference((means, quats, scales, viewmats, Ks))


def test_float32_is_accurate():
    inputs = (*gaussians(), *cameras())
    inputs = tuple(x.float().double() for x in inputs)
    outputs, gradients = outputs_and_gradients(ours, inputs, torch.float32)
    expected, expected_gradients = outputs_and_gradients(reference, inputs)
    for a, b in zip(outputs + gradients, expected + expected_gradients, strict=True):
        assert a.dtype == torch.float32
        assert (a - b).norm() <= 3e-6 * b.norm()


def test_needles_keep_their_digits_in_float32():
    means = torch.zeros(1, 3)
    quats, scales = torch.tensor([[0.9, 0.1, 0.2, 0.38]]), torch.tensor([[30.0, 0.01, 0.01]])
    viewmats, Ks = (x.float() for x in cameras(1))
    inputs = (means, quats, scales, viewmats, Ks)
    conics = project(*inputs, WIDTH, HEIGHT).conics
    expected = project(*(x.double() for x in inputs), WIDTH, HEIGHT).conics
    assert (conics - expected).norm() <= 1e-6 * expected.norm()


def test_gradcheck():
    viewmats, Ks = cameras()
    leaves = [x.requires_grad_() for x in (*gaussians(4), viewmats)]
    assert torch.autograd.gradcheck(lambda *a: ours(*a, Ks), leaves)


def test_scaling_a_quaternion_changes_nothing():
    means, quats, scales = gaussians()
    a, b = (project(means, q, scales, *cameras(), WIDTH, HEIGHT) for q in (quats, quats * 7.5))
    for x, y in zip(a, b, strict=True):
        torch.testing.assert_close(x, y)


def test_zero_quaternions_are_the_identity_with_finite_gradients():
    means, quats, scales = gaussians(5)
    identity = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(5, 4)
    inputs = (means, torch.zeros_like(quats), scales, *cameras())
    outputs, gradients = outputs_and_gradients(ours, inputs)
    expected, _ = outputs_and_gradients(ours, (means, identity, scales, *cameras()))
    torch.testing.assert_close(outputs, expected)
    assert all(g.isfinite().all() for g in gradients)


@pytest.mark.parametrize("scale", [0.0, 1e-30])
def test_points_without_extent_are_finite(scale):
    means, quats, scales = gaussians(5)
    inputs = (means, quats, torch.full_like(scales, scale), *cameras())
    for dtype in (torch.float32, torch.float64):
        outputs, gradients = outputs_and_gradients(ours, inputs, dtype)
        assert all(x.isfinite().all() for x in outputs + gradients)


def test_depth_and_image_bounds_cull():
    viewmats, Ks = torch.eye(4)[None], cameras(1)[1].float()
    means = torch.tensor([[0, 0, 5.0], [0, 0, -5], [0, 0, 0.01], [0, 0, 0.0], [0, 0, 50], [9, 0, 5], [0, -9, 5]])
    quats, scales = torch.tensor([[1.0, 0, 0, 0]]).expand(7, 4), torch.full((7, 3), 0.1)
    p = project(means, quats, scales, viewmats, Ks, WIDTH, HEIGHT, near_plane=0.01, far_plane=40.0)
    assert (p.radii > 0).tolist() == [[True] + 6 * [False]]
    assert all(x.isfinite().all() for x in p)


def test_culled_gaussians_have_finite_gradients():
    viewmats, Ks = torch.eye(4)[None].double(), cameras(1)[1]
    means, quats, scales = gaussians(6)
    means[:, 2] = torch.tensor([5.0, -5, 0.01, 0.0, 50, 1e12])
    _, gradients = outputs_and_gradients(ours, (means, quats, scales, viewmats, Ks))
    assert all(g.isfinite().all() for g in gradients)


def test_radius_is_three_deviations_of_the_longest_axis():
    viewmats, Ks = torch.eye(4)[None], torch.tensor([[[100.0, 0, 32], [0, 100, 24], [0, 0, 1]]])
    means, quats = torch.tensor([[0, 0, 2.0]]), torch.tensor([[1.0, 0, 0, 0]])
    p = project(means, quats, torch.tensor([[0.1, 0.05, 0.02]]), viewmats, Ks, WIDTH, HEIGHT)
    assert p.radii.dtype == torch.int32
    assert p.radii.tolist() == [[math.ceil(3 * math.sqrt(25 + 0.3))]]
    p = project(means, quats, torch.tensor([[0.1, 0.05, 0.02]]), viewmats, Ks, WIDTH, HEIGHT, radius_clip=16.0)
    assert p.radii.tolist() == [[0]]
