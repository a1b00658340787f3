import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatart_ns.capture.capture import CaptureError, Normalization
from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.worlds import focus_on_focus, in_one_world, looks_elsewhere, require_one_place
from splatart_ns.errors import InputError


@pytest.fixture
def capture(layout):
    return load_capture(layout)


@pytest.fixture
def layout(tmp_path):
    """Two states of four frames whose cameras look at the origin; images are never opened."""
    for k in range(2):
        folder = tmp_path / f"state_{k}"
        (folder / "images").mkdir(parents=True)
        frames = []
        for i in range(4):
            name = f"images/{i}.png"
            (folder / name).touch()
            pose = np.eye(4)
            pose[:3, :3] = Rotation.from_euler("ZX", [90 * i + 30 * k, 60], degrees=True).as_matrix()
            pose[:3, 3] = 2.0 * pose[:3, 2]
            frames.append({"file_path": name, "transform_matrix": pose.tolist()})
        meta = {"w": 10, "h": 10, "fl_x": 12.0, "fl_y": 12.0, "semantic_classes": ["background", "a", "b"]}
        (folder / "transforms.json").write_text(json.dumps({**meta, "frames": frames}))
    return tmp_path


def elsewhere(scale):
    T = np.eye(4)
    T[:3, :3] = scale * Rotation.from_rotvec([0.3, -1.0, 0.7]).as_matrix()
    T[:3, 3] = [3.0, -2.0, 1.0]
    return T


def poses(capture, state):
    return np.stack([frame.T_world_camera for frame in capture.states[state].frames])


def test_similarities_move_cameras_and_are_remembered(capture):
    T = np.stack([np.eye(4), elsewhere(1.7)])
    moved = in_one_world(capture, T)
    assert np.array_equal(poses(moved, 0), poses(capture, 0))
    assert np.allclose(poses(moved, 1)[:, :3, 3], poses(capture, 1)[:, :3, 3] @ T[1, :3, :3].T + T[1, :3, 3])
    assert np.allclose(np.linalg.det(poses(moved, 1)[:, :3, :3]), 1)
    assert [state.frames[0].depth_unit for state in moved.states] == pytest.approx([1e-3, 1.7e-3])
    back = in_one_world(moved, np.linalg.inv(T))
    assert np.allclose(poses(back, 1), poses(capture, 1)) and np.allclose(back.states[1].placement, np.eye(4))


@pytest.mark.parametrize(("worlds", "distance"), [("similar", 2.0), ("rigid", 3.4)])
def test_states_come_side_by_side_with_or_without_their_scale(capture, worlds, distance):
    apart = in_one_world(capture, np.stack([np.eye(4), elsewhere(1.7)]))
    together = focus_on_focus(apart, worlds)
    assert together.worlds == worlds
    centre = together.normalization.centre
    assert np.allclose(centre, 0, atol=1e-9)
    assert np.allclose(np.linalg.norm(poses(together, 1)[:, :3, 3] - centre, axis=1), distance)
    assert np.array_equal(poses(together, 0), poses(apart, 0))


def test_a_shared_world_stays(capture):
    assert np.array_equal(poses(focus_on_focus(capture, "shared"), 1), poses(capture, 1))


@pytest.mark.parametrize(("scale", "shift", "strange"), [(1, 0, False), (1.2, 0.1, False), (1, 3, True), (4, 0, True)])
def test_states_of_different_worlds_are_told(capture, scale, shift, strange):
    T = np.diag([scale, scale, scale, 1.0])
    T[0, 3] = shift
    moved = in_one_world(capture, np.stack([np.eye(4), T]))
    told = [looks_elsewhere(moved, state) for state in moved.states]
    assert told[0] is None and (told[1] is not None) == strange
    assert looks_elsewhere(replace(moved, worlds="similar"), moved.states[1]) is None


@pytest.mark.parametrize(("shift", "refused"), [(0, False), (1, False), (8, True)])
def test_states_that_look_too_far_apart_for_a_fit_are_refused(capture, shift, refused):
    T = np.eye(4)
    T[0, 3] = shift
    moved = in_one_world(capture, np.stack([np.eye(4), T]))
    frames = [frame for state in moved.states for frame in state.frames]
    moved = replace(moved, normalization=Normalization.from_frames(frames))
    if refused:
        with pytest.raises(InputError, match="state_1: its cameras do not look where .* --worlds similar .* shared"):
            require_one_place(moved)
    else:
        require_one_place(moved)
    require_one_place(replace(moved, worlds="similar"))


@pytest.mark.parametrize("value", ["similar", "everywhere", ["rigid"]])
def test_the_capture_says_how_worlds_differ(layout, value):
    file = layout / "state_1" / "transforms.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "worlds": value}))
    if value == "similar":
        assert load_capture(layout).worlds == "similar"
    else:
        with pytest.raises(CaptureError, match='"worlds" is .*shared, rigid, similar'):
            load_capture(layout)
