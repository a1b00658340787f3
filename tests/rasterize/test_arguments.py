"""Shapes, types and modes that the rasterizer refuses, before a compiled kernel reads or writes where nothing is."""

import importlib.util
import timeit

import numpy as np
import pytest
import torch
from scenes import world_scene

from splatart_ns.rasterize import rasterization, rasterize_neighbours
from splatart_ns.rasterize.arguments import Arguments
from splatart_ns.rasterize.rasterization import sh_colors

BACKENDS = [
    "torch",
    pytest.param("numba", marks=pytest.mark.skipif(not importlib.util.find_spec("numba"), reason="without numba")),
]
N, C = 60, 2


def scene(**others):
    found = {k: v.float() if torch.is_tensor(v) else v for k, v in world_scene(N, C).items()}
    return found | others


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    "name, shape, wanted",
    [
        ("means", (N, 4), "[N, 3]"),
        ("means", (), "[N, 3]"),
        ("means", (2, N, 3), "[N, 3]"),
        ("quats", (1, 4), "[N, 4], with N = 60, C = 2"),
        ("quats", (N - 5, 4), "[N, 4]"),
        ("quats", (N, 3), "[N, 4]"),
        ("scales", (1, 3), "[N, 3]"),
        ("scales", (N, 1), "[N, 3]"),
        ("scales", (N,), "[N, 3]"),
        ("opacities", (N, 1), "[N]"),
        ("opacities", (N - 1,), "[N]"),
        ("colors", (N,), "[N, D] or [C, N, D]"),
        ("colors", (N - 5, 3), "[N, D] or [C, N, D]"),
        ("colors", (3, N, 3), "[N, D] or [C, N, D]"),
        ("viewmats", (4, 4), "[C, 4, 4]"),
        ("viewmats", (C, 3, 4), "[C, 4, 4]"),
        ("Ks", (3, 3), "[C, 3, 3]"),
        ("Ks", (1, 3, 3), "[C, 3, 3]"),
        ("backgrounds", (3,), "[C, 3]"),
        ("backgrounds", (C, 4), "[C, 3]"),
    ],
)
def test_a_wrong_shape_is_named_with_the_wanted_one(backend, name, shape, wanted):
    with pytest.raises(ValueError) as error:
        rasterization(**scene(**{name: torch.zeros(shape)}), backend=backend)
    assert f"rasterization: {name} has the shape {list(shape)}; give {wanted}" in str(error.value)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    "shape, degree", [((N, 4, 3), 3), ((N, 4, 4), 1), ((N, 3), 1), ((1, 4, 3), 1), ((1, N, 4, 3), 1), ((N, 0, 3), 0)]
)
def test_harmonics_need_all_bands_of_three_channels(backend, shape, degree):
    s = scene(colors=torch.zeros(shape))
    for call in (
        lambda: rasterization(**s, sh_degree=degree, backend=backend),
        lambda: sh_colors(s["means"], s["colors"], s["viewmats"], degree, backend),
    ):
        with pytest.raises(ValueError, match=rf"shape .*; give \[N, K >= {(degree + 1) ** 2}, 3\] or \[C, N, K"):
            call()


@pytest.mark.parametrize("degree", [-1, 4, 1.0, True])
def test_degrees_that_there_are_not(degree):
    with pytest.raises(ValueError, match=f"sh_degree is {degree!r}; give 0 to 3"):
        rasterization(**scene(colors=torch.zeros(N, 25, 3)), sh_degree=degree)


@pytest.mark.parametrize(
    "argument, value, wanted",
    [
        ("rasterize_mode", "antialias", "classic, antialiased"),
        ("render_mode", "rgb", "RGB, D, ED, RGB[+]D, RGB[+]ED"),
        ("render_mode", "XD", "RGB, D, ED, RGB[+]D, RGB[+]ED"),
        ("width", 0, "1 or more"),
        ("height", 3.0, "1 or more"),
        ("height", True, "1 or more"),
    ],
)
def test_a_mode_or_size_that_there_is_not(argument, value, wanted):
    with pytest.raises(ValueError, match=f"{argument} is {value!r}; give .*{wanted}"):
        rasterization(**scene(**{argument: value}))


def test_other_types_and_devices_are_named():
    with pytest.raises(TypeError, match="quats is of type ndarray"):
        rasterization(**scene(quats=np.zeros((N, 4))))
    with pytest.raises(TypeError, match="means is of type list"):
        rasterization(**scene(means=[[0.0, 0.0, 0.0]]))
    with pytest.raises(ValueError, match="Ks is on meta but means on cpu"):
        rasterization(**scene(Ks=torch.zeros(C, 3, 3, device="meta")))
    with pytest.raises(ValueError, match="scales is torch.float16; give float32"):
        rasterization(**scene(scales=torch.zeros(N, 3).half()))
    with pytest.raises(ValueError, match="viewmats is torch.float64 but means torch.float32; convert either"):
        rasterization(**scene(viewmats=torch.eye(4).double().repeat(C, 1, 1)))
    with pytest.raises(ValueError, match="gsplat backend takes float32 on CUDA"):
        rasterization(**scene(), backend="gsplat")


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_gsplat_takes_is_taken(backend):
    s = scene()
    image = rasterization(**s, backend=backend)[0]
    channels = s["colors"].expand(C, N, 3)
    sizes = dict(width=np.int64(s["width"]), height=torch.tensor(s["height"]))
    again = scene(colors=channels, backgrounds=torch.zeros(C, 3), **sizes)
    assert torch.equal(rasterization(**again, backend=backend)[0], image)
    for shape in ((N, 16, 3), (C, N, 9, 3), (N, 25, 3)):
        assert rasterization(**scene(colors=torch.zeros(shape)), sh_degree=2, backend=backend)[0].shape[-1] == 3
    nothing = {k: v[:0] if torch.is_tensor(v) and len(v) == N else v for k, v in s.items()}
    assert not rasterization(**nothing, backend=backend)[0].any()
    nobody = scene(means=s["means"].clone().requires_grad_(), viewmats=s["viewmats"][:0], Ks=s["Ks"][:0])
    images = rasterization(**nobody, backend=backend)[0]
    assert images.shape == (0, s["height"], s["width"], s["colors"].shape[-1])
    images.sum().backward()
    assert not nobody["means"].grad.any()
    # The background of depth is 0, whatever is behind the colours.
    assert rasterization(**scene(backgrounds=torch.ones(C, 1)), render_mode="D", backend=backend)[0].shape[-1] == 1


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    "name, shape", [("quats", (1, 4)), ("K", (1, 3, 3)), ("colors", (N, 3)), ("colors", (C, N, 4))]
)
def test_neighbours_need_their_shapes_too(backend, name, shape):
    near = scene()
    near |= dict(K=near.pop("Ks")[0], colors=near["colors"].expand(C, N, 3))
    assert rasterize_neighbours(**near, backend=backend).shape[-1] == 4
    with pytest.raises(ValueError, match=f"{name} has the shape"):
        rasterize_neighbours(**near | {name: torch.zeros(shape)}, backend=backend)


def test_looking_takes_microseconds():
    s = scene()

    def look():
        arguments = Arguments(s["means"], s["viewmats"])
        arguments.require(quats=(s["quats"], ("N", 4)), scales=(s["scales"], ("N", 3)), Ks=(s["Ks"], ("C", 3, 3)))
        arguments.require_colors(s["colors"])

    assert min(timeit.repeat(look, number=100, repeat=10)) / 100 < 2e-4
