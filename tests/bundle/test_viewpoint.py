import math
from pathlib import Path

import numpy as np
import pytest
import torch

from splatart_ns.bundle import posed_splat
from splatart_ns.bundle.viewpoint import bounding_sphere, capture_viewpoint, front_azimuth, orbit_viewpoint
from splatart_ns.capture.capture import Camera, Capture, Frame, State
from splatart_ns.errors import InputError
from splatart_ns.geometry.camera import project_points, viewmat_from_opengl


@pytest.mark.parametrize(("azimuth", "elevation"), [(0.0, 0.0), (2.0, 0.4), (-1.0, -1.5)])
@pytest.mark.parametrize("size", [(64, 64), (120, 40), (40, 120)])
def test_the_whole_object_is_in_the_picture_at_all_configurations(bundle, azimuth, elevation, size):
    configurations = [{}, {"hinge": 1.5}, {"hinge": -1.5, "slide": 3.0}]
    view = orbit_viewpoint(*bounding_sphere(bundle, configurations), azimuth, elevation, *size)
    viewmat, K = viewmat_from_opengl(torch.from_numpy(view.T_world_camera)), torch.from_numpy(view.camera.K)
    for q in configurations:
        pixels, depths = project_points(posed_splat(bundle, q).means.double(), viewmat, K)
        assert (depths > 0).all()
        assert ((pixels >= 0) & (pixels <= torch.tensor(size))).all()


def test_the_camera_stands_where_it_is_asked_to_and_upright():
    view = orbit_viewpoint(np.array([1.0, 2.0, 3.0]), 0.5, math.pi / 2, math.radians(30), 64, 48)
    T = view.T_world_camera
    back = (T[:3, 3] - [1, 2, 3]) / np.linalg.norm(T[:3, 3] - [1, 2, 3])
    np.testing.assert_allclose(back, [0, math.cos(math.radians(30)), 0.5], atol=1e-12)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    assert T[2, 1] > 0 and T[2, 0] == pytest.approx(0)


def test_a_sphere_ignores_what_cannot_be_seen(bundle):
    centre, radius = bounding_sphere(bundle, [{}])
    assert 1 < radius < 2
    for part in bundle.parts:
        part.splat.means[0] = 100.0
        part.splat.opacity_logits[0] = -10.0
    np.testing.assert_allclose(bounding_sphere(bundle, [{}])[0], centre, atol=0.3)


def test_the_front_is_where_the_other_parts_are(bundle):
    assert front_azimuth(bundle) == pytest.approx(0, abs=0.1)
    for part in bundle.parts[1:]:
        part.splat.means[:, :2] = part.splat.means[:, [1, 0]] * torch.tensor([1.0, -1.0])
    assert front_azimuth(bundle) == pytest.approx(-math.pi / 2, abs=0.1)


def test_a_camera_of_the_capture_is_taken_by_number():
    camera = Camera(50, 50, 20, 16, 40, 32)
    frames = tuple(Frame(f"{k}.png", Path(f"{k}.png"), camera, (k + 1) * np.eye(4), "train") for k in range(2))
    capture = Capture(Path("here"), (State("a", frames),), {1: "base"})
    assert capture_viewpoint(capture, 1).camera == camera
    assert capture_viewpoint(capture, 1).T_world_camera[0, 0] == 2
    for index in (-1, 2):
        with pytest.raises(InputError, match="there are 0 to 1"):
            capture_viewpoint(capture, index)
