"""Where a capture's cameras were."""

import numpy as np
import pytest
import torch

from splatart_ns.bundle import load_bundle
from splatart_ns.bundle.vantage import MOST, cameras_around, vantage_points
from splatart_ns.capture.formats import load_capture
from splatart_ns.geometry.se3 import transform_points


def positions(state):
    return np.stack([frame.T_world_camera[:3, 3] for frame in state.frames if frame.split == "train"])


def test_a_fit_keeps_where_the_training_cameras_were(hinge_fit, hinge_capture):
    kept = load_bundle(hinge_fit).provenance["cameras"]
    for points, state in zip(kept, load_capture(hinge_capture).states, strict=True):
        np.testing.assert_allclose(points, positions(state), atol=1e-3)


def test_cameras_of_worlds_of_their_own_come_into_the_first(hinge_capture):
    capture = load_capture(hinge_capture)
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, :3, :3] *= 2.0
    T[1, :3, 3] = [1.0, 2, 3]
    first, second = vantage_points(capture, T)
    np.testing.assert_allclose(first, positions(capture.states[0]), atol=1e-3)
    np.testing.assert_allclose(second, 2 * positions(capture.states[1]) + [1, 2, 3], atol=1e-3)


def test_of_many_cameras_an_even_choice_is_kept(hinge_capture, monkeypatch):
    monkeypatch.setattr("splatart_ns.bundle.vantage.MOST", 10)
    capture = load_capture(hinge_capture)
    kept = vantage_points(capture, np.tile(np.eye(4), (2, 1, 1)))
    assert MOST == 300 and [len(points) for points in kept] == [4, 4]
    np.testing.assert_allclose(kept[0], positions(capture.states[0])[::3], atol=1e-3)


def test_a_part_has_the_cameras_about_it_as_it_was_in_each_state(bundle):
    points = torch.tensor([[[3.0, 0, 1]], [[0.0, 4, 1]]], dtype=torch.float64)
    bundle.provenance["cameras"] = points.tolist()
    door = bundle.part("door")
    around = cameras_around(bundle, door)
    torch.testing.assert_close(around[0], points[0, 0])
    torch.testing.assert_close(transform_points(door.motion[1], around[1:]), points[1])


@pytest.mark.parametrize("name", ["base", "door"])
def test_an_older_bundle_does_not_say(bundle, name):
    assert cameras_around(bundle, bundle.part(name)) is None
