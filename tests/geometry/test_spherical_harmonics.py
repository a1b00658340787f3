import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import lpmv

from splatart_ns.geometry.se3 import so3_exp
from splatart_ns.geometry.spherical_harmonics import rotate_sh, sh_basis


def sample(seed: int, count: int, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    dirs = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=dtype), dim=-1)
    R = so3_exp(2 * torch.randn(count, 3, generator=generator, dtype=dtype))
    return dirs, R, torch.randn(count, 16, 3, generator=generator, dtype=dtype)


def test_basis_is_the_textbooks_with_odd_orders_negated():
    dirs, _, _ = sample(0, 50)
    z, phi = dirs[:, 2].numpy(), np.arctan2(dirs[:, 1].numpy(), dirs[:, 0].numpy())
    values = sh_basis(dirs, 3)
    for band in range(4):
        for order in range(-band, band + 1):
            m = abs(order)
            norm = math.sqrt((2 * band + 1) / (4 * math.pi) * math.factorial(band - m) / math.factorial(band + m))
            turn = 1 if m == 0 else math.sqrt(2) * (np.cos(m * phi) if order > 0 else np.sin(m * phi))
            # scipy's Legendre functions carry the Condon-Shortley sign, which is the negation of odd orders.
            reference = norm * lpmv(m, band, z) * turn
            assert np.allclose(values[:, band * (band + 1) + order].numpy(), reference, atol=1e-14), (band, order)


@given(seed=st.integers(0, 2**31), degree=st.integers(0, 3))
@settings(max_examples=40, deadline=None, derandomize=True)
def test_turned_coefficients_show_the_old_colour_in_the_turned_direction(seed, degree):
    for dtype, tolerance in ((torch.float32, 2e-5), (torch.float64, 1e-13)):
        dirs, R, sh = sample(seed, 8, dtype)
        sh = sh[:, : (degree + 1) ** 2]
        seen = sh_basis((R @ dirs[..., None])[..., 0], degree)[:, None] @ rotate_sh(R, sh)
        assert torch.allclose(seen, sh_basis(dirs, degree)[:, None] @ sh, rtol=0, atol=tolerance)
        assert torch.allclose(rotate_sh(R[0], sh), rotate_sh(R[:1].expand(8, 3, 3), sh), rtol=0, atol=tolerance)


def test_rotations_compose_and_the_identity_does_nothing():
    _, R, sh = sample(4, 6)
    assert torch.allclose(rotate_sh(R[0], rotate_sh(R[1], sh)), rotate_sh(R[0] @ R[1], sh), atol=1e-13)
    assert torch.allclose(rotate_sh(torch.eye(3, dtype=sh.dtype), sh), sh, atol=1e-14)


def test_a_degree_beyond_three_is_refused():
    with pytest.raises(ValueError, match="degree 4"):
        sh_basis(torch.eye(3), 4)
