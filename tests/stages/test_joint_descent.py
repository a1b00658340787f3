import pytest
import torch

from splatart_ns.stages.joint import fit_joint
from splatart_ns.stages.joint_descent import descend_joint
from splatart_ns.stages.joint_parameters import joint_motion


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_descent_ends_where_the_closed_form_does(kind):
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(60, 3, generator=generator, dtype=torch.float64) * 0.3 + 0.4
    axis = torch.nn.functional.normalize(torch.tensor([0.3, 1.0, -0.2], dtype=torch.float64), dim=0)
    values = torch.tensor([0.0, -0.5], dtype=torch.float64)
    T = joint_motion(kind, axis, torch.tensor([0.1, 0.0, 0.5], dtype=torch.float64), 0.0, values)
    slow = descend_joint(kind, T, points, steps=250, learning_rate=5e-2)
    quick = fit_joint(T, points, types=(kind,))
    assert slow.residual < 3e-3
    assert float(slow.axis @ quick.axis) > 0.999
    assert torch.allclose(slow.values, quick.values, atol=0.01)
    if kind == "revolute":
        assert torch.allclose(slow.origin, quick.origin, atol=0.02)


def test_other_types_are_refused():
    with pytest.raises(ValueError, match="screw"):
        descend_joint("screw", torch.eye(4).repeat(2, 1, 1), torch.zeros(4, 3))
