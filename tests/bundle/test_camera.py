import math
from pathlib import Path

import numpy as np
import pytest
import torch

from splatart_ns.bundle import camera, posed_splat
from splatart_ns.bundle.camera import Camera, bounding_sphere, capture_camera, front_azimuth, orbit_camera
from splatart_ns.bundle.posing import configured_motions
from splatart_ns.capture import capture
from splatart_ns.capture.capture import Capture, Frame, State
from splatart_ns.errors import InputError
from splatart_ns.geometry.camera import project_points, viewmat_from_opengl


@pytest.mark.parametrize(("azimuth", "elevation"), [(0.0, 0.0), (2.0, 0.4), (-1.0, -1.5)])
@pytest.mark.parametrize("size", [(64, 64), (120, 40), (40, 120)])
def test_the_whole_object_is_in_the_picture_at_all_configurations(bundle, azimuth, elevation, size):
    configurations = [{}, {"hinge": 1.5}, {"hinge": -1.5, "slide": 3.0}]
    view = orbit_camera(*bounding_sphere(bundle, configurations), azimuth, elevation, *size)
    viewmat, K = viewmat_from_opengl(view.T_world_camera), view.K
    for q in configurations:
        pixels, depths = project_points(posed_splat(bundle, q).means.double(), viewmat, K)
        assert (depths > 0).all()
        assert ((pixels >= 0) & (pixels <= torch.tensor(size))).all()


def test_thousands_of_configurations_are_sized_by_an_even_choice_of_them(bundle, monkeypatch):
    asked = []
    monkeypatch.setattr(camera, "configured_motions", lambda b, q: asked.append(q) or configured_motions(b, q))
    configurations = [{"slide": x} for x in np.linspace(0, 3, 5000)]
    centre, radius = bounding_sphere(bundle, configurations)
    assert len(asked) == camera.SIZED_BY and asked[0] == configurations[0] and asked[-1] == configurations[-1]
    whole = bounding_sphere(bundle, configurations[::10])
    assert centre == pytest.approx(whole[0], abs=0.01) and radius == pytest.approx(whole[1], rel=0.01)


def test_the_camera_stands_where_it_is_asked_to_and_upright():
    view = orbit_camera(np.array([1.0, 2.0, 3.0]), 0.5, math.pi / 2, math.radians(30), 64, 48)
    T = view.T_world_camera.numpy()
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


def test_an_object_is_looked_at_from_beside_where_the_other_parts_are(bundle):
    beside = math.radians(40)
    assert front_azimuth(bundle) == pytest.approx(beside, abs=0.1)
    for part in bundle.parts[1:]:
        part.splat.means[:, :2] = part.splat.means[:, [1, 0]] * torch.tensor([1.0, -1.0])
    assert front_azimuth(bundle) == pytest.approx(beside - math.pi / 2, abs=0.1)


def test_a_camera_of_the_capture_is_taken_by_number():
    intrinsics = capture.Camera(50, 60, 20, 16, 40, 32)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 2.0
    frames = tuple(Frame(f"{k}.png", Path(f"{k}.png"), intrinsics, T, "train") for k, T in enumerate(poses))
    taken = Capture(Path("here"), (State("a", frames),), {1: "base"})
    camera = capture_camera(taken, 1)
    assert camera.K.tolist() == [[50, 0, 20], [0, 60, 16], [0, 0, 1]] and (camera.width, camera.height) == (40, 32)
    assert camera.T_world_camera[0, 3] == 2
    for index in (-1, 2):
        with pytest.raises(InputError, match="there are 0 to 1"):
            capture_camera(taken, index)


EYE = np.eye(4)


def test_a_camera_takes_arrays_lists_and_tensors():
    camera = Camera(EYE.tolist(), (50, 60, 20, 16), 40, 32)
    assert torch.equal(camera.K, torch.tensor([[50.0, 0, 20], [0, 60, 16], [0, 0, 1]], dtype=torch.float64))
    assert camera.batch == ()
    assert Camera(torch.eye(4).expand(5, 4, 4), camera.K.float(), 40, 32).batch == (5,)
    assert Camera(EYE, camera.K.expand(5, 3, 3), 40, 32).batch == (5,)
    assert Camera(np.tile(EYE, (5, 1, 1))[::-1], camera.K, np.int64(40), np.int32(32)).width == 40


@pytest.mark.parametrize("count", [1, 3, 4, 5])
def test_any_number_of_intrinsics_is_a_batch(count):
    K = np.array([[50.0, 0, 20], [0, 60, 16], [0, 0, 1]])
    for batch in (np.stack([K] * count), [K] * count, torch.from_numpy(np.stack([K] * count))):
        assert Camera(EYE, batch, 40, 32).batch == (count,)
    four = torch.tensor([50.0, 60, 20, 16], dtype=torch.float64)
    for numbers in (four, four.numpy(), tuple(four), tuple(np.array(x) for x in four.tolist())):
        assert torch.equal(Camera(EYE, numbers, 40, 32).K, torch.from_numpy(K))


@pytest.mark.parametrize(
    ("T", "K", "width", "found"),
    [
        (np.eye(3), (50, 50, 20, 16), 40, r"T_world_camera has the shape \[3, 3\]"),
        (2 * EYE, (50, 50, 20, 16), 40, "no rigid motion"),
        (np.diag([1.0, 1, -1, 1]), (50, 50, 20, 16), 40, "no rigid motion"),
        (EYE + 1e200 * np.eye(4, k=3), (50, 50, 20, 16), 40, r"T_world_camera has a number of 1e\+200; give lengths"),
        (EYE * np.nan, (50, 50, 20, 16), 40, "not finite"),
        (EYE, (-50, 50, 20, 16), 40, "fx and fy above 0"),
        (EYE, [[50, 1, 20], [0, 50, 16], [0, 0, 1]], 40, "no pinhole"),
        (EYE, "wide", 40, "K is 'wide'; give numbers"),
        (np.tile(EYE, (2, 1, 1)), np.tile(np.eye(3), (3, 1, 1)), 40, "2 T_world_camera but 3 K"),
        (EYE, (50, 50, 20, 16), 0, "width is 0"),
        (EYE, (50, 50, 20, 16), 40.5, "width is 40.5"),
        (EYE, (50, 50, 20, 16), True, "width is True"),
        (EYE, [[1], [1, 2]], 40, "give numbers"),
        (EYE, (1e300, 50, 20, 16), 40, r"1e\+300; give pixels"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(T, K, width, found):
    with pytest.raises(InputError, match=found):
        Camera(T, K, width, 32)


@pytest.mark.parametrize(("radius", "width", "found"), [(-1.0, 40, "radius is -1.0"), (1.0, 0, "width is 0")])
def test_no_camera_looks_at_nothing(radius, width, found):
    with pytest.raises(InputError, match=found):
        orbit_camera(np.zeros(3), radius, 0.0, 0.0, width, 32)
