"""A dataset format of your own: events in events.npz (x, y, t in µs, p in {0, 1}), poses in poses.txt.

Install it under the name npz-data by an entry point of your package:

    [project.entry-points."nerfstudio.dataparser_configs"]
    npz-data = "your_package.npz_format:npz_dataparser"
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from nerfstudio.plugins.registry_dataparser import DataParserSpecification

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.files.event_reader import EventFile
from aenerf_ns.files.tum_trajectory import read_tum_trajectory
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.options import EventDataParserConfig
from aenerf_ns.recording.recording import Recording


class NpzEventFile(EventFile):
    """Opened only when the events are needed. EventStream and EventFile check the events."""

    def read_chunks(self) -> Iterator[EventStream]:
        with np.load(self.path) as file:
            yield EventStream(
                file["x"].astype(np.uint16),
                file["y"].astype(np.uint16),
                file["t"].astype(np.int64) * 1_000,
                (2 * file["p"].astype(np.int8) - 1).astype(np.int8),
                self.width,
                self.height,
                self.path,
            )


@dataclass
class NpzDataParserConfig(EventDataParserConfig):
    """Events in events.npz, poses in poses.txt."""

    _target: type = field(default_factory=lambda: NpzDataParser)
    focal_length: float = 60.0
    """Focal length in pixels."""


class NpzDataParser(EventDataParser):
    """Read a folder, except for its events."""

    config: NpzDataParserConfig

    def read_recording(self) -> Recording:
        folder = Path(self.config.data)
        width, height, focal = 64, 48, self.config.focal_length
        camera = CameraIntrinsics(width, height, focal, focal, width / 2, height / 2)
        return Recording(
            event_file=NpzEventFile(folder / "events.npz", width, height),
            event_camera=camera,
            sensor=SensorModel(0.25, 0.25),
            trajectory=read_tum_trajectory(folder / "poses.txt"),
            frame_camera=camera,
            reference_views={"train": [], "val": [], "test": []},
            image_encoding="srgb",
        )


npz_dataparser = DataParserSpecification(config=NpzDataParserConfig(), description="events.npz and poses.txt")
