"""A viewer of a small run in the tests' own process, and something that passes for its browser."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Any

import msgspec
import numpy as np
import torch
import websockets.sync.client
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.engine.trainer import writer
from nerfstudio.viewer.viewer import Viewer

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.rotation import rotation_from_vector
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.recording.writer import NativeDatasetWriter
from aenerf_ns.training.pipeline import AENeRFPipeline
from helpers.streams import random_stream

SIZE, DURATION, NUM_EVENTS = (24, 16), 2.0, 1000


def make_recording(folder: Path, true_poses: bool = True) -> Path:
    """Write a dataset of 1000 random events in 2 s, whose true poses, where there are any, are turned by degrees."""
    width, height = SIZE
    knots = np.linspace(0, DURATION * 1e9, 9).astype(np.int64)
    poses = torch.eye(4, dtype=torch.float64).repeat(9, 1, 1)
    poses[:, 0, 3] = torch.linspace(-0.5, 0.5, 9)
    poses[:, 1, 3] = torch.linspace(-1, 1, 9) ** 2 / 4
    turned = poses.clone()
    turned[:, :3, :3] = rotation_from_vector(0.1 * torch.sin(torch.arange(27.0).reshape(9, 3)).double())
    camera = CameraIntrinsics(width, height, 20.0, 20.0, 12.0, 8.0)
    with NativeDatasetWriter(folder, camera, SensorModel(0.2, 0.3), "srgb") as made:
        made.events.append(random_stream(NUM_EVENTS, width, height, int(DURATION * 1e9)))
        made.add_trajectories(Trajectory(knots, poses), Trajectory(knots, turned) if true_poses else None)
        for _ in range(2):
            made.add_image("val", np.full((height, width, 3), 102, np.uint8), poses[0])
    return folder


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


@contextmanager
def viewer_of(pipeline: AENeRFPipeline, folder: Path) -> Iterator[Viewer]:
    """Run Nerfstudio's viewer of a pipeline, as training does."""
    config = ViewerConfig(websocket_host="127.0.0.1", websocket_port=free_port())
    viewer = Viewer(config, folder / "run" / "viewer.log", folder, pipeline, train_lock=Lock())
    try:
        viewer.init_scene(pipeline.datamanager.train_dataset, "training")
        yield viewer
    finally:
        # Threads that render while the process ends would break it off.
        machines = list(viewer.render_statemachines.values())
        for machine in machines:
            machine.running = False
        for machine in machines:
            machine.join()
        viewer.viser_server.stop()
        writer.GLOBAL_BUFFER.clear()


@contextmanager
def browser_of(viewer: Viewer) -> Iterator[Browser]:
    """Connect with what passes for a browser."""
    port = viewer.viser_server.get_port()
    # Closing would wait until all messages that nobody reads are there.
    address = f"ws://127.0.0.1:{port}"
    with websockets.sync.client.connect(address, max_size=None, close_timeout=0.1) as connection:
        browser = Browser(connection)
        browser.look_from((0.0, 0.0, 3.0))
        yield browser


class Browser:
    """Sends what a browser sends, and waits for what it is sent."""

    def __init__(self, connection: websockets.sync.client.ClientConnection) -> None:
        self._connection = connection
        self._waiting: list[dict[str, Any]] = []

    def look_from(self, position: tuple[float, float, float]) -> None:
        """Tell where the view's camera is. The first time, the viewer takes the browser for connected."""
        self._send(
            "ViewerCameraMessage", wxyz=[1.0, 0.0, 0.0, 0.0], position=list(position), fov=1.0, aspect=1.5,
            look_at=[0.0, 0.0, 0.0], up_direction=[0.0, 0.0, 1.0],
        )  # fmt: skip

    def click(self, element: Any) -> None:
        """Click a button."""
        self._send("GuiUpdateMessage", id=element.gui_handle._impl.id, updates={"value": True})

    def wait_for(self, kind: str, **fields: Any) -> dict[str, Any]:
        """Return the next message of a kind with some values. Messages before it are passed over."""
        return self.until(kind, **fields)[-1]

    def until(self, kind: str, **fields: Any) -> list[dict[str, Any]]:
        """Return all messages up to the next one of a kind with some values."""
        passed: list[dict[str, Any]] = []
        deadline = time.monotonic() + 30
        while time.monotonic() < deadline:
            while self._waiting:
                passed.append(message := self._waiting.pop(0))
                if message["type"] == kind and all(message[name] == value for name, value in fields.items()):
                    return passed
            received = msgspec.msgpack.decode(self._connection.recv(timeout=30, decode=False))
            self._waiting += received["messages"] if isinstance(received, dict) else received
        raise AssertionError(f"no {kind} among {[message['type'] for message in passed]}")

    def _send(self, kind: str, **fields: Any) -> None:
        self._connection.send(msgspec.msgpack.encode({"type": kind, **fields}))


def sent(viewer: Viewer, kind: str, name: str | None = None) -> list[Any]:
    """Return the messages of a kind that a browser which connects is sent."""
    kept = list(viewer.viser_server._websock_server._broadcast_buffer.message_from_id.values())
    return [m for m in kept if type(m).__name__ == kind and name in (None, getattr(m, "name", None))]
