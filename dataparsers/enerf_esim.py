"""The synthetic scenes of E-NeRF (Klenk et al. 2023): the output of ESIM in NumPy files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.errors import DataError, value_errors_as_data_error
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.files.event_arrays import XYTP_MATRIX, ArrayEventFile, load_npy
from aenerf_ns.files.event_reader import EventFile
from aenerf_ns.files.limits import list_files, require_one, visible_files
from aenerf_ns.files.tum_trajectory import read_tum_trajectory
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.options import PublishedDataParserConfig
from aenerf_ns.recording.recording import Capture, Recording
from aenerf_ns.recording.views import read_image_times, views_on_trajectory


class EsimEventFolder(EventFile):
    """A folder of .npy files with rows of x, y, t in nanoseconds and p: one stream, in the order of the names."""

    def _files(self) -> list[ArrayEventFile]:
        paths = list_files(self.path, "*.npy")
        files = [ArrayEventFile(path, self.width, self.height, XYTP_MATRIX, "ns") for path in paths]
        for file in files:
            file.drop_malformed, file.left_out = self.drop_malformed, self.left_out
        return files

    def read_chunks(self) -> Iterator[EventStream]:
        for file in self._files():
            yield from file.read_chunks()

    def read_time_span(self) -> tuple[int, int] | None:
        files = [file for file in self._files() if file.count()]
        return (files[0].time_span()[0], files[-1].time_span()[1]) if files else None

    def read_count(self) -> int:
        return sum(file.count() or 0 for file in self._files())


@dataclass
class ENeRFEsimDataParserConfig(PublishedDataParserConfig):
    """E-NeRF's ESIM scenes."""

    markers = ("events/*.npy", "poses_bounds.npy")
    _target: type = field(default_factory=lambda: ENeRFEsimDataParser)

    @classmethod
    def recognizes(cls, data: Path) -> bool:
        return (data / "events").is_dir() and (data / "poses_bounds.npy").is_file()


class ENeRFEsimDataParser(EventDataParser):
    """Read a scene of E-NeRF. Its images come from the event sensor."""

    config: ENeRFEsimDataParserConfig

    def read_recording(self) -> Recording:
        capture, images = self.read_capture()
        reference = read_tum_trajectory(self.poses_path(), "ns")
        return self.config.make_recording(reference, capture, reference_views=views_on_trajectory(images, reference))

    def poses_path(self) -> Path:
        lists = visible_files(self.data, "*poses_all*.txt") or [self.data / "poses_all.txt"]
        return require_one(lists, self.data, "files *poses_all*.txt", "leave the poses of the scene only")

    def read_capture(self) -> tuple[Capture, list[tuple[int, Path]]]:
        camera = _read_camera(self.data / "poses_bounds.npy")
        events = EsimEventFolder(self.data / "events", camera.width, camera.height)
        images = read_image_times(self.data / "images", self.data / "images" / "image_stamps_ns.txt", "ns")
        return self.config.make_capture(SensorModel(), True, event_file=events, event_camera=camera), images


def _read_camera(path: Path) -> CameraIntrinsics:
    """Read the lens in LLFF's poses_bounds.npy: no distortion, and the principal point in the middle of the image."""
    bounds = load_npy(path)
    if bounds.ndim != 2 or bounds.shape[1] != 17 or len(bounds) == 0 or bounds.dtype.kind != "f":
        raise DataError(path, f"it has type {bounds.dtype} and shape {bounds.shape}", "it must be N x 17 decimals")
    # A row is a 3 x 5 matrix and two depths. The last column of the matrix is height, width and focal length.
    height, width, focal = np.asarray(bounds[0, :15], dtype=np.float64).reshape(3, 5)[:, 4].tolist()
    with value_errors_as_data_error(path, "its fifth column must hold height, width and focal length"):
        return CameraIntrinsics.from_opencv((width, height), (focal, focal, width / 2, height / 2))
