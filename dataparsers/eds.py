"""EDS (Hidalgo-Carrió et al. 2022) as downloaded: an event camera and a frame camera behind a beam splitter."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.dataparsers.own_recording import CALIBRATIONS
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.calibration import read_calibration
from aenerf_ns.files.event_hdf5 import COLUMNS_AT_TOP, Hdf5TableFile
from aenerf_ns.files.tum_trajectory import read_tum_trajectory
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.options import PublishedDataParserConfig
from aenerf_ns.recording.recording import Capture, Recording
from aenerf_ns.recording.views import read_image_times, views_on_trajectory

# The sequences do not contain their calibration. This is the authors' ("03_calib" in uzh-rpg/bundles-eds).
# Distortion: k1, k2, p1, p2.
_EVENT_CAMERA = CameraIntrinsics.from_opencv(
    (640, 480),
    (560.8520948927032, 560.6295819972383, 313.00733235019237, 217.32858679842997),
    (-0.09776467241921379, 0.2143738428636279, -0.004710710105172864, -0.004215916089401789),
)
_FRAME_CAMERA = CameraIntrinsics.from_opencv(
    (640, 480),
    (766.536025127154, 767.5749459126396, 291.0503512057777, 227.4060484950132),
    (-0.36965913545735024, 0.17414034009883844, 0.003915245015812422, 0.003666687416655559),
)
# Takes points from the frame camera's to the event camera's coordinates.
_EVENT_FROM_FRAME = (
    (0.9998964430808897, -0.0020335804041023736, -0.014246672065022661, -0.00011238613157578769),
    (0.001703024953250547, 0.9997299470300024, -0.023176123864880376, -0.0005981481496958399),
    (0.014289955220253567, 0.02314946137886846, 0.9996298813149167, -0.004416681577516066),
    (0.0, 0.0, 0.0, 1.0),
)


@dataclass
class EdsDataParserConfig(PublishedDataParserConfig):
    """EDS (raw download)."""

    markers = ("events.h5", "stamped_groundtruth.txt")
    _target: type = field(default_factory=lambda: EdsDataParser)
    calibration: Path | None = None
    """Kalibr's camchain, in place of the authors' calibration. cam0 is the frame camera, cam1 the event camera."""

    @classmethod
    def recognizes(cls, data: Path) -> bool:
        # Other programs write poses under this name, too. A folder that states a lens is of another camera.
        return super().recognizes(data) and not any((data / name).exists() for name in CALIBRATIONS)


class EdsDataParser(EventDataParser):
    """Read a sequence: its events, the poses of the event camera, and the images of the frame camera."""

    config: EdsDataParserConfig

    def read_recording(self) -> Recording:
        reference = read_tum_trajectory(self.poses_path())
        capture, images = self.read_capture()
        views = views_on_trajectory(images, reference, self._calibration[2])
        return self.config.make_recording(reference, capture, reference_views=views)

    def poses_path(self) -> Path:
        return self.data / "stamped_groundtruth.txt"

    def read_capture(self) -> tuple[Capture, list[tuple[int, Path]]]:
        camera, frame_camera, _ = self._calibration
        events = Hdf5TableFile(self.data / "events.h5", camera.width, camera.height, COLUMNS_AT_TOP)
        images = read_image_times(self.data / "images", self.data / "images_timestamps.txt", "us")
        return self.config.make_capture(
            SensorModel(), True, event_file=events, event_camera=camera, frame_camera=frame_camera
        ), images

    @cached_property
    def _calibration(self) -> tuple[CameraIntrinsics, CameraIntrinsics, Tensor]:
        """Event camera, frame camera, and the (4, 4) motion from frame camera to event camera coordinates."""
        path = self.config.calibration
        if path is None:
            return _EVENT_CAMERA, _FRAME_CAMERA, torch.tensor(_EVENT_FROM_FRAME, dtype=torch.float64)
        read = read_calibration(path, "cam1", "cam0")
        return read.event_camera, read.frame_camera, torch.linalg.inv(read.frame_from_event)
