import builtins
import math
import sys

import pytest
import torch
from scenes import HEIGHT, WIDTH
from scenes import world_scene as scene

from splatart_ns.errors import InputError
from splatart_ns.rasterize.rasterization import default_backend, default_device, rasterization, set_backend, sh_colors

# The package's attribute of that name is the function.
MODULE = sys.modules["splatart_ns.rasterize.rasterization"]


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


@pytest.mark.parametrize("has_numba, expected", [(False, "torch"), (True, "numba")])
def test_backends_are_chosen_by_device(monkeypatch, has_numba, expected):
    monkeypatch.setattr(MODULE, "has_numba", lambda: has_numba)
    assert [default_backend(d) for d in ("cuda", "cpu", "xpu")] == ["gsplat", expected, "torch"]


def test_the_backend_can_be_chosen_for_the_process(monkeypatch):
    monkeypatch.setattr(MODULE, "_chosen", "auto")
    set_backend("torch")
    assert default_backend("cpu") == default_backend() == "torch"
    set_backend("auto")
    assert default_backend("cuda") == "gsplat"
    with pytest.raises(InputError, match="tensorflow"):
        set_backend("tensorflow")
    monkeypatch.setattr(MODULE, "has_numba", lambda: False)
    with pytest.raises(InputError, match="pip install"):
        set_backend("numba")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="CUDA"):
        set_backend("gsplat")


@pytest.mark.parametrize(
    "chosen, with_cuda, on_cpu, on_cuda",
    [
        ("numba", "cpu", "numba", "gsplat"),
        ("gsplat", "cuda", "numba", "gsplat"),
        ("torch", "cuda", "torch", "torch"),
        ("auto", "cuda", "numba", "gsplat"),
    ],
)
def test_a_chosen_backend_is_used_on_the_devices_that_it_runs_on(monkeypatch, chosen, with_cuda, on_cpu, on_cuda):
    monkeypatch.setattr(MODULE, "_chosen", "auto")
    monkeypatch.setattr(MODULE, "has_numba", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    set_backend(chosen)
    assert (default_device(), default_backend("cpu"), default_backend("cuda")) == (with_cuda, on_cpu, on_cuda)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert default_device() == "cpu"


def test_cpu_rendering_never_imports_gsplat(monkeypatch):
    original = builtins.__import__

    def guarded(name, *args, **kwargs):
        assert not name.startswith("gsplat")
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", guarded)
    rasterization(**scene(), backend="auto")
    rasterization(**{name: value.float() if torch.is_tensor(value) else value for name, value in scene().items()})
