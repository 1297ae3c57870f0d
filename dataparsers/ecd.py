"""The text format of the Event Camera Dataset (Mueggler et al. 2017), which many DAVIS recordings use.

``events.txt`` (t x y p, polarity 0 or 1), ``images.txt`` (t file), ``groundtruth.txt`` (t px py pz qx qy qz qw,
camera-to-world, OpenCV axes) and ``calib.txt`` (fx fy cx cy k1 k2 p1 p2 k3).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.errors import DataError, value_errors_as_data_error
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.event_text import TextEventFile
from aenerf_ns.files.text import parse_numbers, read_rows
from aenerf_ns.files.tum_trajectory import read_tum_trajectory
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.images import open_image
from aenerf_ns.recording.options import PublishedDataParserConfig
from aenerf_ns.recording.recording import Capture, Recording
from aenerf_ns.recording.views import IMAGE_LIST, read_image_list, views_on_trajectory

# The camera that recorded the dataset.
_DAVIS240C = 240, 180


@dataclass
class EcdDataParserConfig(PublishedDataParserConfig):
    """Event Camera Dataset (text files)."""

    markers = ("events.txt", "calib.txt")
    _target: type = field(default_factory=lambda: EcdDataParser)
    width: int | None = None
    """Pixel columns of the sensor. By default those of the images, or 240 (DAVIS240C) where there are none."""
    height: int | None = None
    """Pixel rows of the sensor. By default those of the images, or 180 (DAVIS240C) where there are none."""


class EcdDataParser(EventDataParser):
    """Read a folder of the Event Camera Dataset. Its images alternate between the validation and the test split."""

    config: EcdDataParserConfig

    def read_recording(self) -> Recording:
        capture, images = self.read_capture()
        reference = read_tum_trajectory(self.poses_path())
        views = views_on_trajectory(images, reference)
        return self.config.make_recording(reference, capture, reference_views=views, max_views=None)

    def poses_path(self) -> Path:
        return self.data / "groundtruth.txt"

    def read_capture(self) -> tuple[Capture, list[tuple[int, Path]]]:
        if not self.data.is_dir():
            raise DataError(self.data, "there is no such folder", "give the folder that holds events.txt as --data")
        images = read_image_list(self.data / IMAGE_LIST) if (self.data / IMAGE_LIST).exists() else []
        stated = (self.config.width, self.config.height)
        size = _DAVIS240C
        if images:
            with open_image(images[0][1]) as image:
                size = image.size
        width, height = (own if given is None else given for given, own in zip(stated, size, strict=True))
        with value_errors_as_data_error(str(self.data), "correct --width or --height"):
            CameraIntrinsics.guess(width, height)
        camera = _read_calibration(self.data / "calib.txt", (width, height))
        if not images and None in stated:
            CONSOLE.print(f"The sensor's size {width} x {height} is a guess: if it is another, give width and height.")
        events = TextEventFile(self.data / "events.txt", width, height, "s")
        return self.config.make_capture(SensorModel(0.5, 0.5), True, event_file=events, event_camera=camera), images


def _read_calibration(path: Path, size: tuple[int, int]) -> CameraIntrinsics:
    rows, _, _ = read_rows(path, "fx fy cx cy k1 k2 p1 p2 k3")
    if not rows:
        raise DataError(path, "the file is empty", "it must hold fx fy cx cy k1 k2 p1 p2 k3")
    values = parse_numbers(path, rows)[0].tolist()
    with value_errors_as_data_error(path, "it must hold fx fy cx cy k1 k2 p1 p2 k3"):
        return CameraIntrinsics.from_opencv(size, values[:4], values[4:])
