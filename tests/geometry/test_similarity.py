import pytest
import torch

from splatart_ns.geometry.camera import project_points
from splatart_ns.geometry.se3 import se3_exp, transform_points
from splatart_ns.geometry.similarity import inverse_similarity, rigid_of, scale_of, similarity, view_of_moved


@pytest.fixture
def T():
    M = se3_exp(torch.tensor([0.3, -1.2, 0.4, 1.0, -2.0, 0.5], dtype=torch.float64))
    return similarity(1.7, M[:3, :3], M[:3, 3])


def test_scale_and_rigid_motion_make_the_similarity_again(T):
    assert scale_of(T) == pytest.approx(1.7, abs=1e-14)
    assert torch.allclose(rigid_of(T) @ torch.diag(torch.tensor([1.7, 1.7, 1.7, 1.0]).double()), T, atol=1e-12)


def test_the_inverse_undoes_batches(T):
    batch = torch.stack([T, se3_exp(torch.randn(6, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))])
    assert torch.allclose(inverse_similarity(batch) @ batch, torch.eye(4).double().expand(2, 4, 4), atol=1e-12)


def test_a_view_of_the_moved_world_is_rigid_and_sees_points_where_they_are_moved_to(T):
    points = torch.randn(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    viewmat = se3_exp(torch.tensor([0.1, 0.2, 12.0, 0.4, 0.2, -0.3], dtype=torch.float64))
    K = torch.tensor([[100.0, 0, 50], [0, 110, 40], [0, 0, 1]], dtype=torch.float64)
    view = view_of_moved(viewmat, T)
    assert torch.allclose(view[:3, :3] @ view[:3, :3].T, torch.eye(3).double(), atol=1e-12)
    moved, seen = (project_points(*x, K)[0] for x in ((transform_points(T, points), viewmat), (points, view)))
    assert torch.allclose(moved, seen, atol=1e-9)
