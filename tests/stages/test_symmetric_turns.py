import math
from dataclasses import replace

import pytest
import torch
from part_scene import angle_deg, box, disc, motion

from splatart_ns.geometry.se3 import from_rotation_translation, so3_log
from splatart_ns.stages.symmetric_turns import similar_axes, symmetric_turns

TILT = motion((20, -35, 50), (0.1, 0.2, 0.3))


def nearest_deg(turns: torch.Tensor, T: torch.Tensor) -> float:
    """How far the nearest of some rotations [K, 3, 3] is from that of T [4, 4]."""
    return min(angle_deg(from_rotation_translation(R, torch.zeros(3)), T) for R in turns)


def test_a_brick_looks_alike_after_half_turns_about_its_edges():
    turns = symmetric_turns(box(1, (1.0, 0.6, 0.2), (0.0, 0.0, 0.0)).transformed(TILT))
    assert len(turns) == 3
    for edge in TILT[:3, :3].T:
        half = from_rotation_translation(2 * edge.outer(edge) - torch.eye(3).to(edge), torch.zeros(3))
        assert nearest_deg(turns, half) < 1


@pytest.mark.parametrize("degrees", [90, 180, 270])
@pytest.mark.parametrize("over", [0, 180])
def test_a_square_plate_looks_alike_after_quarter_turns_on_either_side(degrees, over):
    turns = symmetric_turns(box(1, (0.6, 0.6, 0.1), (0.0, 0.0, 0.0)).transformed(TILT))
    turned = TILT @ motion((0, 0, degrees), (0, 0, 0)) @ motion((over, 0, 0), (0, 0, 0)) @ TILT.inverse()
    assert nearest_deg(turns, turned) < (0.5 if not over else 5)


def test_a_disc_may_turn_about_its_axis_alone():
    splat = disc(1, TILT)
    axes = similar_axes(splat)
    assert len(axes) == 1
    assert float((axes[0] @ TILT[:3, 2]).abs()) > 0.999
    turns = symmetric_turns(splat)
    phi = so3_log(turns)
    along = (phi @ axes[0]).abs() / phi.norm(dim=-1)
    assert ((along > 0.999) | (along < 1e-6)).all()
    assert torch.allclose(phi[along < 1e-6].norm(dim=-1), torch.tensor(math.pi, dtype=phi.dtype), atol=1e-6)


def test_a_single_gaussian_has_no_turns():
    assert symmetric_turns(disc(1, TILT).select(torch.tensor([0]))).shape == (0, 3, 3)


def test_a_rod_as_thick_as_its_gaussians_may_turn_about_its_length():
    """Their centres lie in a plane, as those of a rod a few pixels thick may."""
    along = torch.linspace(-0.5, 0.5, 41)
    centres = torch.stack([0.01 * (-1.0) ** torch.arange(41), torch.zeros(41), along], -1)
    rod = replace(disc(1, TILT).select(torch.zeros(41, dtype=torch.long)), means=centres)
    rod = replace(rod, quats=torch.tensor([[1.0, 0, 0, 0]]), log_scales=torch.tensor([[0.02, 0.02, 0.03]]).log())
    rod = replace(rod, quats=rod.quats.expand(41, 4), log_scales=rod.log_scales.expand(41, 3)).transformed(TILT)
    axes = similar_axes(rod)
    assert len(axes) == 1
    assert float((axes[0] @ TILT[:3, 2]).abs()) > 0.999
