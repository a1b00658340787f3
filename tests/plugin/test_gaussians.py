import pytest
import torch

from splatart_ns.geometry.se3 import matrix_from_quat
from splatart_ns.plugin.gaussians import FLATNESS, random_splat, splat_from_points

AXES = torch.eye(3)
SIDEWAYS = torch.nn.functional.normalize(torch.tensor([[1.0, -2.0, 0.5], [0.3, 0.2, -5.0], [-1e-3, 0.0, -1.0]]), dim=-1)


@pytest.mark.parametrize("normal", [*AXES, *-AXES, *SIDEWAYS], ids=lambda n: ",".join(f"{x:.3f}" for x in n.tolist()))
def test_gaussians_on_a_known_surface_lie_flat_on_it(normal):
    xyz = torch.cartesian_prod(*[torch.arange(3.0)] * 3)
    splat = splat_from_points(xyz, torch.full((27, 3), 99.0), normal.expand(27, 3), 1, 2)
    assert torch.allclose(splat.quats.norm(dim=-1), torch.ones(27), atol=1e-6)
    R = matrix_from_quat(splat.quats.double())
    covariance = R @ torch.diag_embed(splat.scales.double() ** 2) @ R.mT
    values, vectors = torch.linalg.eigh(covariance)
    assert torch.allclose(values.sqrt(), torch.tensor([FLATNESS, 1.0, 1.0], dtype=torch.float64), atol=1e-4)
    assert (vectors[:, :, 0] @ normal.double()).abs().min() > 1 - 1e-4


def test_a_single_point_makes_a_gaussian():
    splat = splat_from_points(torch.zeros(1, 3), torch.full((1, 3), 128.0), torch.zeros(1, 3), 0, 1)
    assert splat.log_scales.isfinite().all() and len(splat) == 1


def test_gaussians_are_round_where_no_surface_is_known():
    normals = torch.zeros(27, 3)
    normals[0, 2] = 1
    xyz = torch.cartesian_prod(*[torch.arange(3.0)] * 3)
    splat = splat_from_points(xyz, torch.full((27, 3), 99.0), normals, 1, 2)
    assert torch.allclose(splat.scales[1:], torch.ones(26, 3), atol=1e-5)
    assert splat.scales[0, 2] < 0.5
    assert torch.allclose(random_splat(50, 2.0, 0, 1).log_scales.std(-1), torch.zeros(50), atol=1e-5)
