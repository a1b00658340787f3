import torch

from splatart_ns.geometry.camera import project_points, viewmat_from_opengl
from splatart_ns.geometry.se3 import se3_exp, transform_points


def test_camera_sees_what_lies_along_its_negative_z():
    T = se3_exp(torch.tensor([0.3, -1.0, 2.0, 0.4, 1.0, -0.7], dtype=torch.float64))
    K = torch.tensor([[100.0, 0, 32], [0, 200, 24], [0, 0, 1]], dtype=torch.float64)
    # In camera axes: straight ahead at 2, one to the right of it, one above it, and one behind the camera.
    local = torch.tensor([[0.0, 0, -2], [1, 0, -2], [0, 1, -2], [0, 0, 3]], dtype=torch.float64)
    pixels, depths = project_points(transform_points(T, local), viewmat_from_opengl(T), K)
    assert torch.allclose(depths, torch.tensor([2.0, 2, 2, -3], dtype=torch.float64))
    assert torch.allclose(pixels[:3], torch.tensor([[32.0, 24], [82, 24], [32, -76]], dtype=torch.float64))
    assert pixels.isfinite().all()


def test_cameras_and_points_broadcast():
    viewmats = viewmat_from_opengl(torch.eye(4).repeat(3, 1, 1))
    pixels, depths = project_points(torch.randn(7, 3), viewmats, torch.eye(3))
    assert pixels.shape == (3, 7, 2) and depths.shape == (3, 7)
