"""The viewer as a browser hears it, without a browser."""

import math
import socket
import time
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from viewer_client import ViewerClient, free_port

from splatart_ns.bundle import ArticulatedSplat, save_bundle
from splatart_ns.bundle.configurations import read_configuration
from splatart_ns.errors import InputError
from splatart_ns.viewer.viewer import Viewer


@pytest.fixture
def viewer(bundle):
    viewer = Viewer(ArticulatedSplat(bundle), "127.0.0.1", free_port())
    with ThreadPoolExecutor() as threads:
        running = threads.submit(viewer.run)
        yield viewer
        viewer.stop()
        running.result(timeout=10)  # raises what `run` raised


@pytest.fixture
def client(viewer):
    client = ViewerClient(viewer.server.get_port(), alive=lambda: True, seconds=30)
    rest_image(client)
    yield client
    client.close()


def images(client, start=0):
    found = [m["rgb_bytes"] for m in client.messages[start:] if m["type"] == "BackgroundImageMessage"]
    return [cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) for data in found]


def rest_image(client, start=0):
    """The first image at rest among the messages from `start` on."""
    while True:
        full = [image for image in images(client, start) if len(image) == 1024]
        if full:
            return full[0]
        client._receive()


def click(client, label):
    button = client.wait_for(lambda m: m["type"] == "GuiAddButtonMessage" and m["label"] == label)
    client._send({"type": "GuiUpdateMessage", "id": button["id"], "updates": {"value": True}})


def switch(client, label, value):
    box = client.wait_for(lambda m: m["type"] == "GuiAddCheckboxMessage" and m["label"].strip("\u00a0") == label)
    client.move(box, value)


def download(client):
    start = client.wait_for(lambda m: m["type"] == "FileTransferStart")
    part = client.wait_for(lambda m: m["type"] == "FileTransferPart")
    assert len(part["content"]) == start["size_bytes"]
    return start["filename"], part["content"]


def test_a_moved_slider_changes_the_image_and_goes_into_the_file(viewer, client, bundle, tmp_path):
    before, start = rest_image(client), len(client.messages)
    client.move(client.slider("hinge (degree)"), -60.0)
    after = rest_image(client, start)
    assert np.abs(after.astype(int) - before).max() > 100
    assert len(images(client, start)[0]) < 1024  # a small image comes first
    click(client, "Configuration (JSON)")
    name, content = download(client)
    assert name == "configuration.json"
    (tmp_path / name).write_bytes(content)
    assert read_configuration(tmp_path / name, bundle) == pytest.approx({"hinge": math.radians(-60), "runner": 0.0})


def test_reset_brings_the_first_image_back(viewer, client):
    before = rest_image(client)
    client.move(client.slider("runner (metre)"), 0.3)
    rest_image(client, len(client.messages))
    start = len(client.messages)
    click(client, "Reset")
    assert np.abs(rest_image(client, start).astype(int) - before).mean() < 0.1
    assert viewer.panel.q == {"hinge": 0.0, "runner": 0.0}


def test_reset_ends_a_sweep(viewer, client):
    switch(client, "Sweep", True)
    while viewer.panel.q["hinge"] > -0.1:
        client._receive()
    click(client, "Reset")
    while viewer.panel.sweep.value:
        client._receive()
    rest_image(client, len(client.messages))
    assert viewer.panel.q == {"hinge": 0.0, "runner": 0.0}


def test_a_hidden_part_leaves_image_and_picture(client):
    start = len(client.messages)
    switch(client, "lid", False)
    image = rest_image(client, start)
    assert (image[..., 1].astype(int) - image[..., 2] > 150).sum() == 0  # no green but in the white
    click(client, "Picture (PNG)")
    name, content = download(client)
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    assert name == "picture.png" and picture.shape == (1024, 1024, 3)
    assert np.abs(picture.astype(int) - image).mean() < 2


def test_part_colours_recolour(client):
    start, before = len(client.messages), rest_image(client)
    switch(client, "Part colours", True)
    assert np.abs(rest_image(client, start).astype(int) - before).max() > 50


def test_a_click_selects_a_part_and_another_ends_it(viewer, client):
    before = rest_image(client)
    rows, columns = np.nonzero(before[..., 1].astype(int) - before[..., 2] > 150)  # the lid is green
    lid = float(np.median(columns) / before.shape[1]), float(np.median(rows) / before.shape[0])
    for place, selected in ((lid, "lid"), (lid, None), (lid, "lid"), ((0.01, 0.01), None)):
        start = len(client.messages)
        ray = {"ray_origin": (0.0, 0.0, 0.0), "ray_direction": (0.0, 0.0, 1.0)}
        told = {"type": "SceneNodeClickMessage", "name": "/backdrop", "instance_index": None, "screen_pos": place}
        client._send({**told, **ray})
        image = rest_image(client, start).astype(int)
        assert viewer.panel.selected == selected
        assert (np.abs(image - before).mean() > 1) == (selected is not None)
        assert np.abs(image - before)[rows, columns].mean() < 3


def test_a_sweep_moves_one_joint_after_the_other_until_somebody_takes_over(viewer, client):
    switch(client, "Sweep", True)
    seen = []
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline and not any(q["runner"] > 0.3 for q in seen):
        seen.append(viewer.panel.q)
        client._receive()
    assert min(q["hinge"] for q in seen) < -1.5
    assert max(q["runner"] for q in seen if q["hinge"] < -0.1) == 0
    client.move(client.slider("hinge (degree)"), -10.0)
    while viewer.panel.sweep.value or viewer._sweep is not None:
        assert time.monotonic() < deadline
        client._receive()
    assert viewer.panel.q["hinge"] == pytest.approx(math.radians(-10), abs=1e-6)


def test_a_browser_that_leaves_is_not_missed(viewer, client):
    hasty = ViewerClient(viewer.server.get_port(), alive=lambda: True, seconds=30)
    rest_image(hasty)
    left = max(viewer.server.get_clients().values(), key=lambda connected: connected.client_id)
    hasty.close()
    while left.client_id in viewer.server.get_clients():
        client._receive()
    viewer._jobs.put(lambda: viewer._save_picture(left))
    start = len(client.messages)
    client.move(client.slider("runner (metre)"), 0.2)
    rest_image(client, start)


def test_joint_axes_go_with_the_part_that_carries_them(bundle):
    bundle.joints[1].parent = "lid"
    viewer = Viewer(ArticulatedSplat(bundle), "127.0.0.1", free_port())
    hinge, runner = (node for _, node in viewer.axes._nodes)
    viewer.panel.sliders[0].value = -90.0
    viewer.axes.move(viewer._motions())
    assert hinge.wxyz == pytest.approx([1, 0, 0, 0])
    assert np.abs(runner.wxyz) == pytest.approx([math.sqrt(0.5), 0, math.sqrt(0.5), 0])
    viewer.axes.show(False)
    assert not hinge.visible
    viewer.server.stop()


def test_a_port_in_use_is_refused_with_a_way_out(bundle):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=f"127.0.0.1, port {port} cannot be opened .*--port"):
            Viewer(ArticulatedSplat(bundle), "127.0.0.1", port)


@pytest.mark.parametrize(("option", "value"), [("--port", 0), ("--port", 70000), ("--host", "203.0.113.1")])
def test_the_command_refuses_what_it_cannot_open(bundle, run_main, tmp_path, option, value):
    save_bundle(bundle, tmp_path / "bundle")
    code, _, errors = run_main("view", tmp_path / "bundle", option, value)
    assert code == 2 and option in errors and errors.count("\n") == 1
