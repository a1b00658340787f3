import pytest
import torch

from splatart_ns.rasterize import render
from splatart_ns.rasterize.rasterization import rasterization
from splatart_ns.rasterize.render import PIXEL_VARIANCE
from splatart_ns.splats.splat import Splat

WIDTH, HEIGHT = 40, 30


def splat(N=50, degree=2):
    generator = torch.Generator().manual_seed(0)

    def randn(*shape):
        return torch.randn(*shape, generator=generator)

    return Splat(
        means=0.7 * randn(N, 3),
        quats=randn(N, 4),
        log_scales=0.5 * randn(N, 3) - 2,
        opacity_logits=randn(N),
        sh=0.5 * randn(N, (degree + 1) ** 2, 3),
        part_logits=randn(N, 4),
    )


def cameras(C=2):
    viewmats = torch.eye(4).repeat(C, 1, 1)
    viewmats[:, 2, 3] = 4 + torch.arange(C)
    return viewmats, torch.tensor([[45.0, 0, 20], [0, 45, 15], [0, 0, 1]]).repeat(C, 1, 1)


def test_one_pass_equals_separate_ones():
    s, (viewmats, Ks) = splat(), cameras()
    features = s.part_probabilities
    rendering = render(s, viewmats, Ks, WIDTH, HEIGHT, features=features, backend="torch")
    geometry = (s.means, s.quats, s.scales, s.opacities)
    camera = dict(viewmats=viewmats, Ks=Ks, width=WIDTH, height=HEIGHT, eps2d=PIXEL_VARIANCE, backend="torch")
    image, alpha, _ = rasterization(*geometry, s.sh, sh_degree=2, render_mode="RGB+ED", **camera)
    parts = rasterization(*geometry, features, **camera)[0]
    torch.testing.assert_close(rendering.rgb, image[..., :3])
    torch.testing.assert_close(rendering.depth, image[..., 3:])
    torch.testing.assert_close(rendering.accumulation, alpha)
    torch.testing.assert_close(rendering.features, parts)
    # Probabilities sum to one, so their renderings sum to the accumulation.
    torch.testing.assert_close(rendering.features.sum(-1, keepdim=True), alpha)


@pytest.mark.parametrize("with_depth", [True, False])
def test_depth_and_features_are_optional(with_depth):
    s, (viewmats, Ks) = splat(), cameras()
    plain = render(s, viewmats, Ks, WIDTH, HEIGHT, with_depth=with_depth)
    assert plain.features is None
    assert (plain.depth is not None) == with_depth
    full = render(s, viewmats, Ks, WIDTH, HEIGHT, features=s.part_probabilities[:, :2], with_depth=with_depth)
    assert full.features.shape == (2, HEIGHT, WIDTH, 2)
    torch.testing.assert_close(full.rgb, plain.rgb)


def test_lower_degrees_ignore_the_higher_bands():
    s, (viewmats, Ks) = splat(), cameras()
    flat = Splat(s.means, s.quats, s.log_scales, s.opacity_logits, s.sh[:, :1])
    expected = render(flat, viewmats, Ks, WIDTH, HEIGHT).rgb
    torch.testing.assert_close(render(s, viewmats, Ks, WIDTH, HEIGHT, sh_degree=0).rgb, expected)
    torch.testing.assert_close(render(flat, viewmats, Ks, WIDTH, HEIGHT, sh_degree=3).rgb, expected)


def test_everything_of_the_splat_and_the_cameras_gets_gradients():
    s, (viewmats, Ks) = splat().map(lambda t: t.requires_grad_()), cameras()
    viewmats.requires_grad_()
    rendering = render(s, viewmats, Ks, WIDTH, HEIGHT, features=s.part_probabilities)
    loss = rendering.rgb.square().sum() + rendering.depth.sum() + rendering.features[..., 1].sum()
    loss.backward()
    for tensor in (s.means, s.quats, s.log_scales, s.opacity_logits, s.sh, s.part_logits, viewmats):
        assert tensor.grad.isfinite().all() and (tensor.grad != 0).any()


def test_a_rigid_motion_of_splat_and_camera_changes_nothing():
    s, (viewmats, Ks) = splat().map(lambda t: t.double()), cameras()
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64))[0]
    T[:3, :3] *= torch.linalg.det(T[:3, :3])
    T[:3, 3] = torch.tensor([0.3, -1.0, 2.0])
    viewmats, Ks = viewmats.double(), Ks.double()
    a = render(s, viewmats, Ks, WIDTH, HEIGHT)
    b = render(s.transformed(T), viewmats @ torch.linalg.inv(T), Ks, WIDTH, HEIGHT)
    torch.testing.assert_close(a.rgb, b.rgb, rtol=0, atol=1e-6)
    torch.testing.assert_close(a.depth, b.depth, rtol=0, atol=1e-6)
