import builtins
import math

import naive
import pytest
import torch

from splatart_ns.rasterize.rasterization import default_backend, rasterization, sh_colors

WIDTH, HEIGHT = 45, 35
LEAVES = ("means", "quats", "scales", "opacities", "colors", "viewmats")


def scene(N=60, C=1, D=3, seed=0):
    """A blob in front of C cameras, float64 values that float32 holds exactly."""
    generator = torch.Generator().manual_seed(seed)

    def randn(*shape):
        return torch.randn(*shape, generator=generator)

    viewmats = torch.eye(4).repeat(C, 1, 1)
    viewmats[:, :3, 3] = torch.tensor([0.1, -0.2, 4.0]) + 0.3 * torch.arange(C)[:, None]
    values = dict(
        means=randn(N, 3) * 0.7,
        quats=randn(N, 4),
        scales=(0.6 * randn(N, 3) - 2).exp(),
        opacities=randn(N).sigmoid(),
        colors=randn(N, D).sigmoid(),
        viewmats=viewmats,
        Ks=torch.tensor([[50.0, 0, 22], [0, 48, 18], [0, 0, 1]]).repeat(C, 1, 1),
    )
    return {k: v.double() for k, v in values.items()} | dict(width=WIDTH, height=HEIGHT)


def naive_rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height):
    fx, fy, cx, cy = (Ks[:, i, j, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    margins = [
        ((-cx - 0.15 * width) / fx, (1.15 * width - cx) / fx),
        ((-cy - 0.15 * height) / fy, (1.15 * height - cy) / fy),
    ]
    means2d, cov, depths = naive.project(means, quats, scales, viewmats, Ks, margins)
    inverse = torch.linalg.inv(cov + 0.3 * torch.eye(2).to(cov))
    conics = torch.stack([inverse[..., 0, 0], inverse[..., 0, 1], inverse[..., 1, 1]], -1)
    C, N = depths.shape
    colors, opacities = colors.expand(C, N, -1), opacities.expand(C, N)
    return naive.composite(means2d, conics, opacities, colors, depths, depths > 0.01, width, height)


def image_and_gradients(function, scene, dtype, leaves=LEAVES):
    scene = {k: v.to(dtype) if torch.is_tensor(v) else v for k, v in scene.items()}
    for name in leaves:
        scene[name] = scene[name].clone().requires_grad_()
    image = torch.cat(function(**scene)[:2], -1)
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(dtype)
    return image, torch.autograd.grad(image, [scene[name] for name in leaves], weights)


def torch_rasterization(**scene):
    return rasterization(**scene, backend="torch")


def assert_equals_naive(scene, image_tolerance=2e-5, gradient_tolerance=3e-5, leaves=LEAVES):
    expected, expected_gradients = image_and_gradients(naive_rasterization, scene, torch.float64, leaves)
    for dtype, shrink in ((torch.float32, 1), (torch.float64, 1e-6)):
        image, gradients = image_and_gradients(torch_rasterization, scene, dtype, leaves)
        assert (image - expected).abs().max() <= image_tolerance * shrink
        for name, gradient, reference in zip(leaves, gradients, expected_gradients, strict=True):
            assert gradient.isfinite().all(), name
            assert (gradient - reference).norm() <= gradient_tolerance * shrink * reference.norm() + 1e-15, name


def test_image_and_gradients_equal_the_naive_ones_through_the_projection():
    assert_equals_naive(scene(C=2))


def test_opacities_near_and_at_zero_and_one():
    s = scene()
    s["opacities"][:30] = torch.tensor([0, 1, 0.9999]).repeat(10)
    assert_equals_naive(s)


def test_gaussians_behind_and_on_the_near_plane():
    s = scene()
    s["means"][::2, 2] -= 8.0
    s["means"][1, 2] = 0.01 - 4.0
    assert_equals_naive(s)


def test_zero_quaternions_are_drawn():
    s = scene()
    s["quats"][::2] = 0
    assert_equals_naive(s, leaves=("means", "scales", "opacities", "colors", "viewmats"))
    _, (gradient,) = image_and_gradients(torch_rasterization, s, torch.float32, ("quats",))
    assert gradient.isfinite().all()


def test_points():
    s = scene()
    s["scales"][:] = 1e-8
    assert_equals_naive(s, leaves=("means", "opacities", "colors", "viewmats"))


def test_needles_and_a_screen_filling_gaussian():
    s = scene(20)
    s["scales"][0] = 30.0
    s["scales"][1] = torch.tensor([30.0, 0.01, 0.01])
    s["scales"][2:4] = torch.tensor([1.0, 0.001, 0.001])
    s = {k: v.float().double() if torch.is_tensor(v) else v for k, v in s.items()}
    assert_equals_naive(s)


def test_stacked_on_one_pixel_until_nothing_shines_through():
    s = scene(1000)
    s["means"][:, :2] *= 0.001
    s["scales"][:] = 0.01
    s["opacities"][:] = 0.9
    assert_equals_naive(s, leaves=("means", "opacities", "colors", "viewmats"))


def test_several_cameras_equal_one_at_a_time():
    s = scene(C=3)
    together = rasterization(**s)[0]
    for c in range(3):
        alone = rasterization(**s | dict(viewmats=s["viewmats"][c : c + 1], Ks=s["Ks"][c : c + 1]))[0]
        torch.testing.assert_close(together[c], alone[0])


def test_render_modes_are_channels_of_each_other():
    s = scene(C=2)
    rgb, alpha, info = rasterization(**s)
    depth = rasterization(**s, render_mode="D")[0]
    expected = rasterization(**s, render_mode="ED")[0]
    assert rgb.shape == (2, HEIGHT, WIDTH, 3) and alpha.shape == depth.shape == (2, HEIGHT, WIDTH, 1)
    torch.testing.assert_close(rasterization(**s, render_mode="RGB+D")[0], torch.cat([rgb, depth], -1))
    torch.testing.assert_close(rasterization(**s, render_mode="RGB+ED")[0], torch.cat([rgb, expected], -1))
    torch.testing.assert_close(expected * alpha, depth)
    seen = alpha > 0.01
    assert (expected[seen] >= info["depths"].min() - 1e-9).all()
    assert (expected[seen] <= info["depths"].max() + 1e-9).all()
    assert (expected[alpha == 0] == 0).all()


def test_backgrounds_shine_through_the_colours_only():
    s = scene(C=2)
    backgrounds = torch.tensor([[0.2, 0.5, 0.9], [1.0, 0.0, 0.0]], dtype=torch.float64)
    image, alpha, _ = rasterization(**s, render_mode="RGB+D")
    over, _, _ = rasterization(**s, render_mode="RGB+D", backgrounds=backgrounds)
    torch.testing.assert_close(over[..., :3], image[..., :3] + (1 - alpha) * backgrounds[:, None, None])
    torch.testing.assert_close(over[..., 3:], image[..., 3:])
    depth = rasterization(**s, render_mode="D", backgrounds=backgrounds)[0]
    torch.testing.assert_close(depth, image[..., 3:])


def test_colours_may_differ_per_camera():
    s = scene(C=2)
    colors = torch.stack([s["colors"], 1 - s["colors"]])
    image = rasterization(**s | dict(colors=colors))[0]
    torch.testing.assert_close(image[0], rasterization(**s)[0][0])
    torch.testing.assert_close(image[1], rasterization(**s | dict(colors=colors[1]))[0][1])


def test_antialiasing_keeps_the_mass_of_a_small_gaussian():
    s = scene(1)
    s["means"][:] = torch.tensor([0.0, 0.2, 0.0])
    s["opacities"][:] = 0.5
    masses = {}
    for scale in (0.02, 0.16):
        s["scales"][:] = scale
        classic, sharp = (rasterization(**s, rasterize_mode=mode)[1].sum() for mode in ("classic", "antialiased"))
        masses[scale] = sharp / (0.5 * 2 * math.pi * (scale * 50 / 4) * (scale * 48 / 4))
        assert classic > sharp
    assert masses[0.16] == pytest.approx(1, abs=0.05)
    assert masses[0.02] == pytest.approx(1, abs=0.15)  # the tails below 1/255 are not drawn


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spherical_harmonics_equal_gsplats(degree):
    gsplat_impl = pytest.importorskip("gsplat.cuda._torch_impl")
    s = scene(C=2)
    sh = torch.randn(60, 16, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    dirs = s["means"] - torch.linalg.inv(s["viewmats"])[:, None, :3, 3]
    expected = gsplat_impl._spherical_harmonics(degree, dirs, sh.expand(2, -1, -1, -1))
    expected = (expected + 0.5).clamp_min(0)
    torch.testing.assert_close(sh_colors(s["means"], sh, s["viewmats"], degree), expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(
        rasterization(**s | dict(colors=sh), sh_degree=degree)[0], rasterization(**s | dict(colors=expected))[0]
    )


def test_projection_equals_gsplats():
    gsplat_impl = pytest.importorskip("gsplat.cuda._torch_impl")
    s = scene(C=2)
    s["means"][:, 0] *= 8
    covars, _ = gsplat_impl._quat_scale_to_covar_preci(s["quats"], s["scales"], compute_preci=False)
    radii, means2d, depths, conics, compensations = gsplat_impl._fully_fused_projection(
        s["means"], covars, s["viewmats"], s["Ks"], WIDTH, HEIGHT, calc_compensations=True
    )
    info = rasterization(**s, rasterize_mode="antialiased")[2]
    assert torch.equal(info["radii"], radii)
    assert 0 < (radii == 0).sum() < radii.numel()
    drawn = radii > 0
    expected = dict(means2d=means2d, depths=depths, conics=conics, opacities=s["opacities"] * compensations)
    for name, value in expected.items():
        torch.testing.assert_close(info[name][drawn], value[drawn])


def test_gsplats_default_strategy_runs_on_our_info():
    gsplat = pytest.importorskip("gsplat")
    s = {k: v.float() if torch.is_tensor(v) else v for k, v in scene(C=2).items()}
    params = torch.nn.ParameterDict(
        dict(means=s["means"], quats=s["quats"], scales=s["scales"].log(), opacities=s["opacities"].logit())
    )
    optimizers = {name: torch.optim.Adam([param], lr=0.01) for name, param in params.items()}
    for absgrad in (False, True):
        strategy = gsplat.DefaultStrategy(
            absgrad=absgrad, refine_start_iter=0, refine_every=1, grow_grad2d=1e-9, reset_every=100
        )
        state = strategy.initialize_state()
        before = len(params["means"])
        image, _, info = rasterization(
            *(params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid()),
            *(torch.ones(before, 3), s["viewmats"], s["Ks"], WIDTH, HEIGHT),
            absgrad=absgrad,
            backend="torch",
        )
        strategy.step_pre_backward(params, optimizers, state, 1, info)
        image.square().sum().backward()
        strategy.step_post_backward(params, optimizers, state, 1, info)
        assert len(params["means"]) > before


def test_unsupported_arguments_are_named():
    s = scene()
    with pytest.raises(NotImplementedError, match="fisheye"):
        rasterization(**s, camera_model="fisheye")
    with pytest.raises(NotImplementedError, match="covars"):
        rasterization(**s, covars=torch.eye(3).expand(60, 3, 3))
    with pytest.raises(ValueError, match="tensorflow"):
        rasterization(**s, backend="tensorflow")


def test_backends_are_chosen_by_device(monkeypatch):
    default_backend.cache_clear()
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert [default_backend(d) for d in ("cuda", "cpu", "xpu")] == ["gsplat", "torch", "torch"]
    default_backend.cache_clear()
    monkeypatch.setattr("importlib.util.find_spec", lambda name: object())
    assert [default_backend(d) for d in ("cuda", "cpu", "xpu")] == ["gsplat", "numba", "torch"]
    default_backend.cache_clear()


def test_cpu_rendering_never_imports_gsplat(monkeypatch):
    original = builtins.__import__

    def guarded(name, *args, **kwargs):
        assert not name.startswith("gsplat")
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", guarded)
    rasterization(**scene(), backend="auto")
