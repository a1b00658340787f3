"""Images and gradients of every backend against the naive definition in float64, where rasterizers break."""

import functools
import importlib.util

import naive
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scenes import WORLD_LEAVES, image_and_gradients, world_scene

from splatart_ns.rasterize.rasterization import rasterization

needs_numba = pytest.mark.skipif(importlib.util.find_spec("numba") is None, reason="numba is not installed")
VARIANTS = [
    pytest.param("torch", torch.float64, id="torch-float64"),
    pytest.param("torch", torch.float32, id="torch-float32"),
    pytest.param("numba", torch.float32, id="numba", marks=needs_numba),
]
BOUNDS = {torch.float32: 1e-5, torch.float64: 1e-12}
"""Of relative L2 errors."""
NO_SHAPE = ("means", "opacities", "colors", "viewmats")
"""Leaves to compare where the true gradient by rotation or extent is zero to within rounding."""


def opacities(s):
    s["opacities"][:30] = torch.tensor([0, 1 - 1e-7, 1], dtype=torch.float32).repeat(10)


def all_opaque(s):
    s["opacities"][:] = 1


def behind_the_camera(s):
    s["means"][::2, 2] -= 8


def on_and_across_the_near_plane(s):
    s["means"][:4, 2] = torch.tensor([0.01, 0.0100001, 0.25, 0.02]) - 4
    s["viewmats"][:, 2, 3] = 4
    s["means"][:4, :2] = torch.tensor([[0.0, 0.2], [0.001, 0.203], [0.1, 0.1], [-0.105, 0.21]])
    s["scales"][:4] = 0.5


def screen_filling(s):
    s["scales"][:3] = 30


def needle_1000(s):
    s["scales"][:8] = torch.tensor([1, 0.001, 0.001])


def needle_30(s):
    s["scales"][:2] = torch.tensor([30, 0.01, 0.01])


def points(s):
    s["scales"][:] = 1e-8
    return NO_SHAPE


def giants(s):
    s["scales"][::6] = 1e8


def zero_quaternions(s):
    s["quats"][::2] = 0
    return tuple(name for name in WORLD_LEAVES if name != "quats")


def tiny_quaternions(s):
    s["quats"] *= 1e-24


def unnormalised_quaternions(s):
    s["quats"] *= torch.logspace(-3, 3, len(s["quats"]))[:, None]


def none_visible(s):
    s["means"][:, 2] -= 100


def one(s):
    for name in WORLD_LEAVES[:5]:
        s[name] = s[name][:1]


def none(s):
    for name in WORLD_LEAVES[:5]:
        s[name] = s[name][:0]


def stacked_on_one_pixel(s):
    s.update(world_scene(16000, seed=2, width=3, height=3))
    s["Ks"][:, :2, 2] = 1.5
    s["means"][:, :2] = torch.tensor([-0.1, 0.2]) + 0.001 * s["means"][:, :2]
    s["scales"][:] *= 0.1
    s["opacities"][:] *= 0.01


def transmittance_underflow(s):
    s.update(world_scene(3000, seed=15, width=11, height=9))
    s["Ks"][:, :2, 2] = 5
    s["means"][:, :2] *= 0.001
    s["opacities"][:] = 0.9


def equal_depths(s):
    s["means"][:, 2] = 0.5


def equal_depths_and_places(s):
    s["means"][:] = torch.tensor([0.0, 0.2, 0.5])


def one_pixel(s):
    s.update(world_scene(width=1, height=1))
    s["Ks"][:, :2, 2] = 0.5


def uneven_size(s):
    s.update(width=33, height=17)


def many_channels(s):
    s.update(world_scene(D=19))


def three_cameras(s):
    s.update(world_scene(C=3))


CASES = (
    *(opacities, all_opaque, behind_the_camera, on_and_across_the_near_plane, screen_filling, needle_1000, needle_30),
    *(points, giants, zero_quaternions, tiny_quaternions, unnormalised_quaternions, none_visible, one, none),
    *(stacked_on_one_pixel, transmittance_underflow, equal_depths, equal_depths_and_places, one_pixel, uneven_size),
    *(many_channels, three_cameras),
)


WIDER_BOUNDS = {
    # The reference's inverse of the covariance cancels; ours is the better one.
    (needle_30, "torch", torch.float64): 4e-11,
    (giants, "torch", torch.float64): 1e-9,
    # The rows of J W R S, 700 times longer than the determinant's root, are rounded to float32. In numba they are not.
    (needle_30, "torch", torch.float32): 3e-5,
    # Thousands of gradients nearly cancel in a camera's.
    (stacked_on_one_pixel, "torch", torch.float32): 3e-5,
    (stacked_on_one_pixel, "numba", torch.float32): 3e-5,
}


@functools.cache
def scene_and_expectation(case):
    s = world_scene()
    leaves = case(s) or WORLD_LEAVES
    s = {k: v.float().double() if torch.is_tensor(v) else v for k, v in s.items()}
    return s, leaves, *image_and_gradients(naive.rasterization, s, torch.float64, leaves)


def errors(scene, leaves, expected, expected_gradients, backend, dtype):
    """Relative L2 errors of the image and of the gradients; everything is finite."""
    image, gradients = image_and_gradients(functools.partial(rasterization, backend=backend), scene, dtype, leaves)
    result = {}
    names, values, references = ("image", *leaves), (image, *gradients), (expected, *expected_gradients)
    for name, value, reference in zip(names, values, references, strict=True):
        assert value.dtype == dtype and value.shape == reference.shape
        assert value.isfinite().all(), name
        # The floor lets pass what is zero but for rounding.
        result[name] = ((value - reference).norm() / reference.norm().clamp_min(1e-12)).item()
    return result


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
@pytest.mark.parametrize("backend, dtype", VARIANTS)
def test_image_and_gradients_equal_the_naive_ones(case, backend, dtype):
    bound = WIDER_BOUNDS.get((case, backend, dtype), BOUNDS[dtype])
    for name, error in errors(*scene_and_expectation(case), backend, dtype).items():
        assert error <= bound, (name, error)


@settings(max_examples=25, deadline=None, derandomize=True, database=None)
@given(
    st.integers(1, 40),
    st.integers(1, 3),
    st.integers(1, 6),
    st.integers(0, 10**6),
    st.integers(1, 40),
    st.integers(1, 40),
    st.floats(0.03, 30),
)
def test_random_scenes_equal_the_naive_ones(N, C, D, seed, width, height, size):
    s = world_scene(N, C, D, seed, width, height)
    s["scales"] = (s["scales"] * size).float().double()
    assume(naive.margin(**naive.projected(**s)) > 1e-5)
    expected = image_and_gradients(naive.rasterization, s, torch.float64, WORLD_LEAVES)
    for variant in VARIANTS:
        backend, dtype = variant.values
        if backend == "numba" and importlib.util.find_spec("numba") is None:
            continue
        for name, error in errors(s, WORLD_LEAVES, *expected, backend, dtype).items():
            assert error <= 2 * BOUNDS[dtype], (backend, dtype, name, error)


def test_gradcheck_of_all_of_it():
    s = world_scene(4, C=2, D=2, width=8, height=6)
    # Away from the cut at 1/255, across which the image jumps: everything is drawn everywhere.
    s["scales"][:] = s["scales"] * 0.1 + 1
    s["Ks"][:, :2, 2] = 4
    s["opacities"] = 0.2 + 0.3 * s["opacities"]
    leaves = [s.pop(name).requires_grad_() for name in WORLD_LEAVES]

    def rasterize(*values):
        return rasterization(**dict(zip(WORLD_LEAVES, values, strict=True)), **s, render_mode="RGB+ED")[:2]

    assert torch.autograd.gradcheck(rasterize, leaves, fast_mode=True)


@needs_numba
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_backends_agree_on_spherical_harmonics_depth_and_backgrounds(mode):
    s = world_scene(200, C=2, seed=10)
    s["colors"] = torch.randn(200, 16, 3, generator=torch.Generator().manual_seed(4)).double()
    backgrounds = torch.tensor([[0.2, 0.5, 0.9], [1.0, 0.0, 0.0]])
    results = []
    for backend in ("torch", "numba"):
        options = dict(sh_degree=3, render_mode="RGB+ED", rasterize_mode=mode, backgrounds=backgrounds)
        function = functools.partial(rasterization, backend=backend, **options)
        results.append(image_and_gradients(function, s, torch.float32, WORLD_LEAVES))
    (image, gradients), (expected, expected_gradients) = results
    for a, b in zip((image, *gradients), (expected, *expected_gradients), strict=True):
        assert (a - b).norm() <= 1e-5 * b.norm()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", [*WORLD_LEAVES, "Ks", "backgrounds"])
def test_what_is_not_finite_is_named(name, value):
    s = {k: v.float() if torch.is_tensor(v) else v for k, v in world_scene().items()}
    s["backgrounds"] = torch.zeros(1, 3)
    s[name].view(-1)[-1] = value
    with pytest.raises(ValueError, match=rf"{name}\[.*{value}"):
        rasterization(**s)


def test_sums_that_overflow_are_no_error():
    s = {k: v.float() if torch.is_tensor(v) else v for k, v in world_scene().items()}
    s["means"][:] = 3e38
    assert (rasterization(**s)[0] == 0).all()


def test_the_numba_backend_refuses_other_types():
    with pytest.raises(ValueError, match="float64"):
        rasterization(**world_scene(), backend="numba")
