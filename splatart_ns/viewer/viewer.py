"""The viewer: what the panel says is what browsers show."""

from __future__ import annotations

import contextlib
import io
import json
import math
import queue
import socket
import time
from collections.abc import Callable, Iterator
from itertools import cycle

import numpy as np
import torch
import trimesh
import viser
from PIL import Image
from torch import Tensor

from splatart_ns.bundle.articulated_splat import ArticulatedSplat
from splatart_ns.bundle.camera import ELEVATION, FIELD_OF_VIEW, front_azimuth, orbit_camera
from splatart_ns.bundle.configurations import Configuration, sweep
from splatart_ns.errors import InputError
from splatart_ns.viewer.axis import Axes
from splatart_ns.viewer.panel import Panel
from splatart_ns.viewer.renderer import Eye, Renderer

_ROWS = 1024
"""Of an image at rest, and of one that is saved."""
_MOVING_ROWS = (160, 1024)
"""Of an image while something moves: as many as are made in `_MOVING_SECONDS`, at least and at most."""
_MOVING_SECONDS = 0.04
_REST_SECONDS = 0.25
"""So long nothing has moved when an image at rest is made."""
_FRAMES = 60
"""Of a joint's sweep."""
_FRAME_SECONDS = 1 / 20
_IDLE_SECONDS = 1.0
_MAX_ASPECT = 4.0
_BACKDROP = 100.0
"""Radius, in radii of the object."""


class Viewer:
    """A web server on `host` and `port` that shows a bundle. All that browsers ask for is done by `run`, in turn.

    Raises:
        InputError: when the port cannot be opened, or nothing of the bundle is visible.
    """

    def __init__(self, splat: ArticulatedSplat, host: str, port: int):
        self._splat, self._bundle = splat, splat.bundle
        self._renderer = Renderer(splat)
        require_free(host, port)
        self.server = viser.ViserServer(host, port, label=self._bundle.root, verbose=False)
        self.axes = Axes(self.server, self._bundle, splat.normalization)
        self.panel = Panel(self.server, self._bundle)
        self._backdrop = add_backdrop(self.server)
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._is_due = False
        """Whether an image of what moved is asked for already."""
        self._rest_at: float | None = None
        self._moving_rows = _MOVING_ROWS[0]
        self._sweep: Iterator[Configuration] | None = None
        self._next_frame = 0.0
        self._attach()
        self.server.on_client_connect(self._welcome)

    def run(self) -> None:
        """Serve until `stop` is called or the process is interrupted, then close the port."""
        try:
            while True:
                try:
                    job = self._jobs.get(timeout=self._wait())
                except queue.Empty:
                    job = self._go_on
                if job is None:
                    return
                job()
        finally:
            self.server.stop()

    def stop(self) -> None:
        """Let `run` return."""
        self._jobs.put(None)

    def _wait(self) -> float:
        due = self._next_frame if self._sweep is not None else self._rest_at
        return _IDLE_SECONDS if due is None else max(0.0, due - time.monotonic())

    def _go_on(self) -> None:
        """What is to be done when nobody asks for anything: the next frame of a sweep, or an image at rest."""
        frames = self._sweep  # another thread may end it
        if frames is not None:
            self._next_frame = time.monotonic() + _FRAME_SECONDS
            self.panel.q = next(frames)
        elif self._rest_at is not None:
            self._rest_at = None
            self._draw(_ROWS)

    def _attach(self) -> None:
        panel, jobs = self.panel, self._jobs
        for slider in panel.sliders:
            slider.on_update(self._take_over)
        for switch in (*panel.parts.values(), panel.by_part, panel.axes):
            switch.on_update(lambda _: self._changed())
        self._backdrop.on_click(lambda event: jobs.put(lambda: self._select(event)))
        panel.reset.on_click(lambda _: jobs.put(self._reset))
        panel.sweep.on_update(lambda _: jobs.put(self._start_or_stop_sweep))
        panel.save_configuration.on_click(lambda event: jobs.put(lambda: self._save_configuration(event.client)))
        panel.save_picture.on_click(lambda event: jobs.put(lambda: self._save_picture(event.client)))

    def _welcome(self, client: viser.ClientHandle) -> None:
        start = orbit_camera(np.zeros(3), 1.0, front_azimuth(self._bundle), ELEVATION, 1, 1)
        with client.atomic():
            client.camera.fov = FIELD_OF_VIEW
            client.camera.position = start.T_world_camera[:3, 3].numpy()
            client.camera.look_at = np.zeros(3)
        client.camera.on_update(lambda _: self._changed())
        self._changed()

    def _take_over(self, event: viser.GuiEvent) -> None:
        if event.client is not None:  # a person moved it, and not the sweep
            self._end_sweep()
        self._changed()

    def _end_sweep(self) -> None:
        self._sweep = None
        if self.panel.sweep.value:
            self.panel.sweep.value = False

    def _changed(self) -> None:
        """Ask for an image; one shows all that has changed until it is made."""
        if not self._is_due:
            self._is_due = True
            self._jobs.put(self._draw_moving)

    def _draw_moving(self) -> None:
        self._is_due = False
        start = time.monotonic()
        self._draw(self._moving_rows)
        faster = _MOVING_SECONDS / max(time.monotonic() - start, 1e-3)
        rows = round(self._moving_rows * min(max(math.sqrt(faster), 0.5), 1.5))
        self._moving_rows = min(max(rows, _MOVING_ROWS[0]), _MOVING_ROWS[1])
        self._rest_at = time.monotonic() + _REST_SECONDS

    def _draw(self, rows: int) -> None:
        self.axes.show(self.panel.axes.value)
        self.axes.move(self._motions())
        for client in self.server.get_clients().values():
            client.scene.set_background_image(self._image(client, rows), "jpeg", jpeg_quality=85)

    def _image(self, client: viser.ClientHandle, rows: int) -> np.ndarray:
        panel = self.panel
        return self._renderer.image(panel.q, _eye(client), rows, panel.hidden, panel.by_part.value, panel.selected)

    def _select(self, event: viser.SceneNodePointerEvent) -> None:
        """What was clicked at stands out; the background, or the same part once more, ends that."""
        part = self._renderer.part_at(self.panel.q, _eye(event.client), event.screen_pos, self.panel.hidden)
        self.panel.selected = None if part == self.panel.selected else part
        self._changed()

    def _motions(self) -> dict[str, Tensor]:
        """T[part] [4, 4] of the normalised world, as the sliders say."""
        poses, scene = self._splat.link_poses(self.panel.q), self._splat.normalization
        return {name: torch.from_numpy(scene.motion_to_normal(T.numpy())) for name, T in poses.items()}

    def _reset(self) -> None:
        self._end_sweep()
        self.panel.q = {}

    def _start_or_stop_sweep(self) -> None:
        wanted = self.panel.sweep.value
        if wanted != (self._sweep is not None):
            self._sweep = cycle(sweep(self._bundle, self.panel.q, _FRAMES)) if wanted else None

    def _save_configuration(self, client: viser.ClientHandle) -> None:
        _send(client, "configuration.json", (json.dumps(self.panel.q, indent=1) + "\n").encode())

    def _save_picture(self, client: viser.ClientHandle) -> None:
        file = io.BytesIO()
        Image.fromarray(self._image(client, _ROWS)).save(file, "PNG")
        _send(client, "picture.png", file.getvalue())


def _eye(client: viser.ClientHandle) -> Eye:
    camera = client.camera
    aspect = min(max(camera.aspect, 1 / _MAX_ASPECT), _MAX_ASPECT)
    return Eye(camera.wxyz, camera.position, camera.fov, aspect)


def add_backdrop(server: viser.ViserServer) -> viser.MeshHandle:
    """A sphere about everything that hears clicks anywhere and is not seen.

    viser's own clicks into the scene (`on_pointer_event`) stop the mouse from turning the view. Its faces look inwards,
    so that the outline which viser gives a mesh under the mouse lies on their backs.
    """
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=_BACKDROP)
    return server.scene.add_mesh_simple("/backdrop", sphere.vertices, sphere.faces[:, ::-1], opacity=0.0, side="front")


def _send(client: viser.ClientHandle, name: str, content: bytes) -> None:
    with contextlib.suppress(KeyError):  # the browser has gone
        client.send_file_download(name, content)


def require_free(host: str, port: int) -> None:
    """Raises InputError unless a server can listen on `host` and `port`; viser would take another port."""
    try:
        socket.create_server((host, port)).close()
    except OSError as error:
        mend = "give another --port, or the --host of a network of this machine"
        raise InputError(f"{host}, port {port} cannot be opened ({error.strerror}); {mend}") from error
