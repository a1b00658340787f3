import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from splatart_ns.geometry.screw import Screw, screw_from_motion

unit = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: math.hypot(*v) > 0.1)
lengths = st.floats(-2, 2)


@given(
    axis=unit,
    point=st.tuples(*[lengths] * 3),
    reference=st.tuples(*[lengths] * 3),
    slide=lengths,
    exponent=st.floats(-5, 0),
)
@settings(max_examples=100, deadline=None, derandomize=True)
def test_screw_comes_back_from_its_motion(axis, point, reference, slide, exponent):
    axis, point, reference = (torch.tensor(v, dtype=torch.float64) for v in (axis, point, reference))
    axis = axis / torch.linalg.vector_norm(axis)
    point = point + ((reference - point) @ axis) * axis
    angle, slide = (torch.tensor(v, dtype=torch.float64) for v in (math.pi * 10**exponent * (1 - 1e-9), slide))
    found = screw_from_motion(Screw(axis, point, angle, slide).motion(), reference)
    lost = 1e-14 / float(angle)  # the line's digits go with the angle
    assert torch.allclose(found.angle, angle, rtol=1e-12, atol=1e-14)
    assert torch.allclose(found.slide, slide, rtol=0, atol=10 * lost + 1e-13)
    assert torch.allclose(found.axis, axis, rtol=0, atol=10 * lost + 1e-13)
    assert torch.allclose(found.point, point, rtol=0, atol=100 * lost)


def test_half_a_turn_has_one_of_two_axes_and_the_right_line():
    axis, point = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64), torch.tensor([0.0, 2.0, 0.0], dtype=torch.float64)
    T = Screw(axis, point, torch.tensor(math.pi, dtype=torch.float64), torch.tensor(0.5, dtype=torch.float64)).motion()
    found = screw_from_motion(T, torch.zeros(3, dtype=torch.float64))
    assert abs(float(found.axis @ axis)) == pytest.approx(1, abs=1e-14)
    assert torch.allclose(found.point, point, atol=1e-14)
    assert torch.allclose(found.motion(), T, atol=1e-14)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_translation_and_identity_are_slides_with_finite_gradients(dtype):
    T = torch.eye(4, dtype=dtype).repeat(2, 1, 1)
    T[1, :3, 3] = torch.tensor([0.0, -3.0, 0.0], dtype=dtype)
    T.requires_grad_()
    found = screw_from_motion(T, torch.ones(3, dtype=dtype))
    assert found.angle.tolist() == [0, 0] and found.slide.tolist() == [0, 3]
    assert found.axis.tolist() == [[0, 0, 1], [0, -1, 0]] and found.point.tolist() == [[1, 1, 1], [1, 1, 1]]
    outputs = found.axis.sum() + found.point.sum() + found.slide.sum() + found.angle.sum()
    assert torch.autograd.grad(outputs, T)[0].isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_small_turn_about_a_far_line_moves_as_exactly_as_its_numbers(dtype):
    """point - R point would keep only as many digits of the translation as the angle leaves."""
    angle = 10 * torch.finfo(dtype).eps ** 0.75
    axis, point = torch.tensor([0.0, 0.0, 1.0], dtype=dtype), torch.tensor([1 / angle, 0.0, 0.0], dtype=dtype)
    T = Screw(axis, point, torch.tensor(angle, dtype=dtype), torch.tensor(0.25, dtype=dtype)).motion()
    expected = torch.tensor([0.5 * angle, -1.0, 0.25], dtype=torch.float64)
    assert torch.allclose(T[:3, 3].double(), expected, rtol=0, atol=4 * torch.finfo(dtype).eps)
    rebuilt = screw_from_motion(T, torch.zeros(3, dtype=dtype)).motion()
    assert torch.allclose(rebuilt, T, rtol=0, atol=10 * torch.finfo(dtype).eps)
