import math

import mpmath
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from splatart_ns.geometry import se3

# From an angle that is lost in float64 to pi itself.
ANGLES = [
    0.0,
    1e-300,
    1e-12,
    1e-8,
    1e-5,
    math.radians(0.01),
    1e-3,
    0.1,
    0.499,
    0.501,
    1.0,
    3.0,
    math.pi - 1e-6,
    math.pi,
]
TOLERANCE = {torch.float32: 3e-6, torch.float64: 1e-14}
both_dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
seeds = given(seed=st.integers(0, 2**31))


def directions(seed: int, count: int, dtype=torch.float64) -> torch.Tensor:
    x = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (x / torch.linalg.vector_norm(x, dim=-1, keepdim=True)).to(dtype)


def tangents(seed: int, dtype=torch.float64) -> torch.Tensor:
    """One tangent [6] for each of the angles, with translations of length 1."""
    angle = torch.tensor(ANGLES, dtype=torch.float64)[:, None]
    return torch.cat([directions(seed, len(ANGLES)), angle * directions(seed + 1, len(ANGLES))], -1).to(dtype)


def matrix_exponential(xi: torch.Tensor) -> torch.Tensor:
    """The exponential of the 4x4 generator, in 50 digits."""
    x, y, z, a, b, c = (mpmath.mpf(float(v)) for v in xi)
    with mpmath.workdps(50):
        E = mpmath.expm(mpmath.matrix([[0, -c, b, x], [c, 0, -a, y], [-b, a, 0, z], [0, 0, 0, 0]]), method="taylor")
    return torch.tensor([[float(E[i, j]) for j in range(4)] for i in range(4)], dtype=torch.float64)


@both_dtypes
def test_se3_exp_equals_the_matrix_exponential(dtype):
    for xi in tangents(0, dtype):
        assert torch.allclose(se3.se3_exp(xi).double(), matrix_exponential(xi), rtol=0, atol=TOLERANCE[dtype])


@both_dtypes
def test_a_tiny_rotation_keeps_its_digits(dtype):
    for angle in (1e-12, 1e-8, 1e-5, 1e-3):
        phi = angle * directions(3, 1, dtype)[0]
        assert torch.allclose(se3.so3_log(se3.so3_exp(phi)), phi, rtol=30 * torch.finfo(dtype).eps, atol=0)


@seeds
@settings(max_examples=50, deadline=None, derandomize=True)
def test_exponential_undoes_logarithm_at_every_angle(seed):
    for dtype in (torch.float32, torch.float64):
        T = se3.se3_exp(tangents(seed, dtype))
        xi = se3.se3_log(T)
        assert torch.linalg.vector_norm(xi[:, 3:], dim=-1).max() <= math.pi + 1e-6
        assert torch.allclose(se3.se3_exp(xi), T, rtol=0, atol=2 * TOLERANCE[dtype])


@seeds
@settings(max_examples=50, deadline=None, derandomize=True)
def test_rotation_logarithm_equals_scipy(seed):
    phi = tangents(seed)[:-1, 3:]
    R = se3.so3_exp(phi)
    assert torch.allclose(se3.so3_log(R), torch.tensor(Rotation.from_matrix(R.numpy()).as_rotvec()), rtol=0, atol=1e-13)


@both_dtypes
def test_gradients_are_finite_at_every_angle_and_exact_up_to_pi(dtype):
    xi = tangents(1, dtype).requires_grad_()
    (gradient,) = torch.autograd.grad(se3.se3_log(se3.se3_exp(xi)).sum(), xi)
    assert gradient.isfinite().all()
    assert torch.allclose(gradient[:-1], torch.ones_like(gradient[:-1]), rtol=0, atol=3 * TOLERANCE[dtype])


@pytest.mark.parametrize("function", [se3.se3_exp, lambda xi: se3.se3_log(se3.se3_exp(xi))])
def test_derivatives_at_the_identity(function):
    assert torch.autograd.gradcheck(function, torch.zeros(2, 6, dtype=torch.float64, requires_grad=True))


def test_any_batch_shape_and_no_gradient_unasked():
    for shape in ((6,), (0, 6), (5, 6), (2, 3, 6)):
        T = se3.se3_exp(torch.zeros(shape))
        assert T.shape == (*shape[:-1], 4, 4) and not T.requires_grad
        assert se3.se3_log(T).shape == shape and se3.adjoint(T).shape == (*shape[:-1], 6, 6)
        assert se3.quat_from_matrix(T[..., :3, :3]).shape == (*shape[:-1], 4)


@seeds
@settings(max_examples=50, deadline=None, derandomize=True)
def test_quaternions_equal_scipy_and_come_back(seed):
    R = se3.so3_exp(tangents(seed)[:, 3:])
    q = se3.quat_from_matrix(R)
    reference = torch.tensor(Rotation.from_matrix(R.numpy()).as_quat()).roll(1, -1)  # scipy's is xyzw
    same = (q * reference).sum(-1).abs()
    assert (q[:, 0] >= 0).all() and torch.allclose(same, torch.ones_like(same), rtol=0, atol=1e-14)
    assert torch.allclose(se3.matrix_from_quat(-2.5 * q), R, rtol=0, atol=1e-14)


@seeds
@settings(max_examples=25, deadline=None, derandomize=True)
def test_quaternion_product_composes_rotations(seed):
    a, b = (se3.so3_exp(tangents(seed + k)[:, 3:]) for k in (0, 1))
    product = se3.quat_multiply(se3.quat_from_matrix(a), se3.quat_from_matrix(b))
    assert torch.allclose(se3.matrix_from_quat(product), a @ b, rtol=0, atol=1e-14)


@seeds
@settings(max_examples=25, deadline=None, derandomize=True)
def test_adjoint_moves_a_tangent_through_a_motion(seed):
    T, xi = se3.se3_exp(tangents(seed)), tangents(seed + 7).flip(0)
    moved = (se3.adjoint(T) @ xi[..., None])[..., 0]
    assert torch.allclose(T @ se3.se3_exp(xi) @ se3.inverse(T), se3.se3_exp(moved), rtol=0, atol=1e-13)


def test_inverse_and_points():
    T, x = se3.se3_exp(tangents(5)), directions(6, 20)
    assert torch.allclose(se3.inverse(T), torch.linalg.inv(T), rtol=0, atol=1e-14)
    homogeneous = torch.cat([x, torch.ones(20, 1, dtype=x.dtype)], -1)
    assert torch.allclose(se3.transform_points(T, x), (homogeneous @ T.mT)[..., :3], rtol=0, atol=1e-14)


@both_dtypes
@pytest.mark.parametrize("scale", [1e-25, 1e-8, 1e8, 1e25])
def test_matrix_of_a_quaternion_of_any_norm(dtype, scale):
    unit = torch.tensor([0.1, 0.7, -0.5, 0.5], dtype=dtype)  # of norm 1
    q = (scale * unit).requires_grad_()
    R = se3.matrix_from_quat(q)
    expected = torch.autograd.functional.jacobian(se3.matrix_from_quat, unit)
    found = torch.stack([torch.autograd.grad(v, q, retain_graph=True)[0] for v in R.flatten()]).reshape(3, 3, 4)
    tolerance = 10 * torch.finfo(dtype).eps
    assert torch.allclose(R, se3.matrix_from_quat(unit), rtol=0, atol=tolerance)
    assert torch.allclose(scale * found, expected, rtol=0, atol=4 * tolerance)
