"""Images of cameras near one camera, to first order about its image."""

import pytest
import torch
from scenes import world_scene

from splatart_ns.geometry.se3 import se3_exp
from splatart_ns.rasterize.rasterization import rasterization, rasterize_neighbours

pytest.importorskip("numba")
TANGENTS = torch.eye(6, dtype=torch.float64)


def scene_near(step: float, opacity: float = 1.0, **settings):
    """A float32 scene, and what `rasterize_neighbours` takes: its camera, and six that moved by `step` each."""
    scene = world_scene(**settings)
    viewmats = torch.cat([torch.eye(4)[None].double(), se3_exp(step * TANGENTS)]) @ scene["viewmats"]
    near = dict(scene, colors=scene["colors"].expand(7, -1, -1), opacities=(opacity * scene["opacities"]).clamp(max=1))
    near |= dict(viewmats=viewmats, K=near.pop("Ks")[0])
    return {k: v.float() if torch.is_tensor(v) else v for k, v in near.items()}


def all_images(near, **settings):
    scene = dict(near, Ks=near["K"].expand(7, 3, 3))
    scene.pop("K")
    return torch.cat(rasterization(**scene, **settings)[:2], -1)


def test_the_first_image_is_that_of_the_rasterizer():
    near = scene_near(0.01, N=200)
    assert torch.equal(rasterize_neighbours(**near, backend="numba")[0], all_images(near)[0])


@pytest.mark.parametrize("opacity", [0.05, 1.0, 1e6])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_others_differ_by_the_rasterizers_derivative(seed, opacity):
    near = scene_near(1e-3, opacity, N=200, seed=seed)
    images = rasterize_neighbours(**near, backend="numba")
    viewmat = near["viewmats"][:1].double().requires_grad_()
    double = {k: v.double() if torch.is_tensor(v) else v for k, v in near.items()}
    double |= dict(viewmats=viewmat, Ks=double.pop("K")[None], colors=double["colors"][:1])
    image = torch.cat(rasterization(**double, backend="torch")[:2], -1)
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(1)).double()
    slope = torch.autograd.grad((weights * image).sum(), viewmat)[0]
    expected = ((near["viewmats"][1:] - near["viewmats"][:1]).double() * slope).sum((1, 2))
    found = ((images[1:] - images[:1]).double() * weights[0]).sum((1, 2, 3))
    assert (found - expected).norm() < 3e-3 * expected.norm()


def test_colours_may_differ_too():
    near = scene_near(0.0, N=200)
    near["colors"] = near["colors"] + 0.01 * torch.arange(7)[:, None, None]
    images, expected = rasterize_neighbours(**near, backend="numba"), all_images(near)
    assert (images - expected).abs().max() < 1e-5
    assert (images[6] - images[0])[..., :3].max() > 0.05


def test_what_opaque_gaussians_hide_and_what_is_behind_the_camera_changes_nothing():
    near = scene_near(1e-3, N=60)
    near["opacities"][:] = 1.0
    behind = near["means"].clone()
    behind[:, 2] = -10.0
    images = rasterize_neighbours(**near, backend="numba")
    more = {k: torch.cat([near[k], near[k]]) for k in ("quats", "scales", "opacities")}
    more["means"], more["colors"] = torch.cat([near["means"], behind]), near["colors"].repeat(1, 2, 1)
    assert torch.equal(rasterize_neighbours(**(near | more), backend="numba"), images)
    assert images.isfinite().all()


@pytest.mark.parametrize("scales", [(1.0, 1e-3, 1e-3), (1e-8, 1e-8, 1e-8), (1e3, 1e3, 1e3)])
def test_needles_dust_and_walls_give_finite_images(scales):
    near = scene_near(4e-3, N=50)
    near["scales"] = torch.tensor(scales).expand(50, 3)
    assert rasterize_neighbours(**near, backend="numba").isfinite().all()


def test_threads_change_nothing():
    near, before = scene_near(4e-3, N=200), torch.get_num_threads()
    found = []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        found.append(rasterize_neighbours(**near, backend="numba"))
    torch.set_num_threads(before)
    assert torch.equal(*found)


def test_other_backends_render_every_image():
    near = scene_near(4e-3, N=100)
    assert torch.equal(rasterize_neighbours(**near, backend="torch"), all_images(near, backend="torch"))


def test_what_is_not_finite_is_named():
    near = scene_near(4e-3, N=10)
    near["scales"][3, 1] = torch.nan
    with pytest.raises(ValueError, match=r"scales\[3, 1\] is nan"):
        rasterize_neighbours(**near, backend="numba")
