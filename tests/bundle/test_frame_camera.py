"""Cameras of frames: which one, and what lies where in its image."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatart_ns.bundle.frame_camera import FrameView, find_frame, pinhole_pixels
from splatart_ns.capture.capture import Camera, Capture, Frame, State
from splatart_ns.capture.images import undistorted_points
from splatart_ns.errors import InputError

PINHOLE = Camera(50.0, 52.0, 30.0, 25.0, 64, 48)
DISTORTED = replace(PINHOLE, distortion=(-0.3, 0.05, 0.0, 0.0, 0.0, 0.0))


def frame(name, camera=PINHOLE):
    return Frame(name, Path("here") / name, camera, np.eye(4), "train")


CAPTURE = Capture(
    Path("here"),
    (State("shut", (frame("a/1.png"), frame("a/2.png"))), State("open", (frame("b/1.png"), frame("c/1.png")))),
    {1: "base"},
)


@pytest.mark.parametrize(
    ("camera", "state", "name"),
    [("1", None, "a/2.png"), ("1.png", None, "a/1.png"), ("a/2.png", "shut", "a/2.png"), ("0", "open", "b/1.png")],
)
def test_a_frame_is_found_by_its_number_or_its_name_in_a_state(camera, state, name):
    assert find_frame(CAPTURE, camera, state).name == name


@pytest.mark.parametrize(
    ("camera", "state", "told"),
    [
        ("2", None, "camera 2 does not exist; there are 0 to 1, a/1.png and so on"),
        ("-1", None, "camera -1 does not exist"),
        ("1.png", "open", "camera 1.png is any of 2"),
        ("0", "ajar", "no state 'ajar'; choose --state from shut, open"),
    ],
)
def test_a_frame_that_is_not_there_is_refused(camera, state, told):
    with pytest.raises(InputError, match=told):
        find_frame(CAPTURE, camera, state)


def test_a_picture_is_distorted_as_the_frame_is():
    view = FrameView(frame("1.png", DISTORTED))
    # Each pixel of the picture says where its ray goes.
    K = view.camera.K.numpy()
    u, v = np.meshgrid(np.arange(view.camera.width) + 0.5, np.arange(view.camera.height) + 0.5)
    picture = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.zeros_like(u)], axis=-1).astype(np.float32)
    taken = view.as_taken(picture)
    assert taken.shape == (48, 64, 3)
    ray = undistorted_points(np.array([[40.5, 3.5]]), DISTORTED)[0]
    assert np.abs(taken[3, 40, :2] - ray).max() < 1e-3


def test_a_pixel_without_distortion_is_its_own():
    pixels, wide = pinhole_pixels(Camera(50.0, 40.0, 8.0, 6.5, 16, 12))
    assert (wide.width, wide.height) == (16, 12)
    assert np.abs(pixels[..., 0] - np.arange(16) - 0.5).max() < 1e-9
    assert np.abs(pixels[..., 1] - np.arange(12)[:, None] - 0.5).max() < 1e-9


@pytest.mark.parametrize("k1", [-0.3, 0.2])
def test_the_wide_image_holds_every_pixel_s_ray(k1):
    camera = Camera(50.0, 52.0, 30.0, 25.0, 64, 48, distortion=(k1, 0.02, 0.0, 0.0, 0.003, 0.001))
    pixels, wide = pinhole_pixels(camera)
    assert pixels.min() >= 0 and (pixels < [wide.width, wide.height]).all()
    rays = undistorted_points(np.array([[0.5, 0.5], [63.5, 47.5], [40.5, 3.5]]), camera)
    for (u, v), ray in zip([(0, 0), (63, 47), (40, 3)], rays, strict=True):
        assert np.abs((pixels[v, u] - [wide.cx, wide.cy]) / [wide.fx, wide.fy] - ray).max() < 1e-6
