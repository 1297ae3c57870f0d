"""TUM-VIE (Klenk et al. 2021) as downloaded: Prophesee event cameras, motion capture, and kb4 fisheye lenses."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, Literal, TypeVar

import msgspec
import numpy as np
import torch
from torch import Tensor

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.errors import DataError, value_errors_as_data_error
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.event_hdf5 import COLUMNS_IN_GROUP, Hdf5TableFile
from aenerf_ns.files.json_file import read_json
from aenerf_ns.files.limits import require_one, visible_files
from aenerf_ns.files.tum_trajectory import poses_from_quaternions, read_tum_trajectory
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.options import PublishedDataParserConfig
from aenerf_ns.recording.recording import Capture, Recording
from aenerf_ns.recording.views import read_image_times, views_on_trajectory

_EVENT_FILE = re.compile(r"(?P<sequence>.+)-events_(?P<side>left|right)\.h5")
# Sequences recorded with calibration A, and parts of them, begin so. All others were recorded with calibration B.
_SET_A = ("loop-floor", "mocap-desk", "skate-easy")
# Indices of the event camera and of the frame camera in the lists of the calibration.
_INDICES = {"left": (2, 0), "right": (3, 1)}
# Nanoseconds between poses of the motion capture that make a gap.
_MAX_MOCAP_GAP = 50_000_000
# The ratio C+ / C- and the refractory period (ns) are the estimates of Robust e-NeRF.
_SENSOR = SensorModel(1.458 * 0.25, 0.25, 1375)

T = TypeVar("T")


class _Pose(msgspec.Struct):
    px: float
    py: float
    pz: float
    qx: float
    qy: float
    qz: float
    qw: float

    def matrix(self, path: Path) -> Tensor:
        """Return the (4, 4) float64 matrix. Errors name ``path``, the file."""
        values = np.array([msgspec.structs.astuple(self)])
        return poses_from_quaternions(path, values[:, :3], values[:, 3:])[0]


class _Lens(msgspec.Struct):
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    k3: float
    k4: float


class _Camera(msgspec.Struct):
    camera_type: Literal["kb4"]
    intrinsics: _Lens


class _Cameras(msgspec.Struct):
    """Left and right frame camera, left and right event camera."""

    T_imu_cam: tuple[_Pose, _Pose, _Pose, _Pose]
    intrinsics: tuple[_Camera, _Camera, _Camera, _Camera]
    resolution: tuple[tuple[int, int], tuple[int, int], tuple[int, int], tuple[int, int]]


class _Mocap(msgspec.Struct):
    T_imu_marker: _Pose


class _File(msgspec.Struct, Generic[T]):
    value0: T


@dataclass
class TumVieDataParserConfig(PublishedDataParserConfig):
    """TUM-VIE (raw download)."""

    markers = ("SEQUENCE-events_left.h5", "SEQUENCE-vi_gt_data")
    _target: type = field(default_factory=lambda: TumVieDataParser)
    max_pose_gap_ns: int | None = None
    """Leave out everything between consecutive poses that are further apart than this, in nanoseconds. By default 50 ms
    for the motion capture at 120 Hz, which covers only the start and the end of long sequences."""

    @classmethod
    def recognizes(cls, data: Path) -> bool:
        return bool(_event_files(data))


class TumVieDataParser(EventDataParser):
    """Read a sequence from the folder that it and the calibration were downloaded to.

    Where the folder holds several sequences, the event file of one is given in place of the folder. The event file of
    the right camera selects the right cameras.
    """

    config: TumVieDataParserConfig

    def read_recording(self) -> Recording:
        events, sequence, side = _choose(self.data)
        capture, imu_from_event, imu_from_frame = self._read_cameras()
        # The motion capture gives the poses of its marker.
        path = _find_calibration(events.parent, "mocap-imu-calibration", sequence)
        imu_from_marker = read_json(path, _File[_Mocap]).value0.T_imu_marker.matrix(path)
        marker_from_event = torch.linalg.inv(imu_from_marker) @ imu_from_event
        mocap = self.poses_path()
        reference = read_tum_trajectory(mocap, "us").transform(lambda poses: poses @ marker_from_event)
        image_folder = mocap.parent / f"{side}_images"
        images = read_image_times(image_folder, image_folder / f"image_timestamps_{side}.txt", "us")
        longest = self.config.max_pose_gap_ns or _MAX_MOCAP_GAP
        views = views_on_trajectory(images, reference, torch.linalg.inv(imu_from_event) @ imu_from_frame, longest)
        max_pose_gap = _MAX_MOCAP_GAP if self.config.trajectory is None else None
        return self.config.make_recording(reference, capture, max_pose_gap=max_pose_gap, reference_views=views)

    def poses_path(self) -> Path:
        events, sequence, _ = _choose(self.data)
        return events.parent / f"{sequence}-vi_gt_data" / "mocap_data.txt"

    def read_capture(self) -> tuple[Capture, list[tuple[int, Path]]]:
        # The images are of the other camera.
        return self._read_cameras()[0], []

    def _read_cameras(self) -> tuple[Capture, Tensor, Tensor]:
        """Read the cameras, and the (4, 4) motions from the event and the frame camera's coordinates to the IMU's."""
        events, sequence, side = _choose(self.data)
        path = _find_calibration(events.parent, "camera-calibration", sequence)
        cameras = read_json(path, _File[_Cameras]).value0
        (event_camera, imu_from_event), (frame_camera, imu_from_frame) = (
            _read_camera(path, cameras, index) for index in _INDICES[side]
        )
        capture = self.config.make_capture(
            _SENSOR,
            event_file=Hdf5TableFile(events, event_camera.width, event_camera.height, COLUMNS_IN_GROUP),
            event_camera=event_camera,
            frame_camera=frame_camera,
        )
        return capture, imu_from_event, imu_from_frame


def _event_files(data: Path) -> list[Path]:
    """List the event files of the left cameras of all sequences. The files may be missing, as where a trained run is
    opened: any other part of a sequence suffices."""
    if _EVENT_FILE.fullmatch(data.name):
        return [data]
    parts = ("-events_left.h5", "-vi_gt_data")
    names = {path.name.removesuffix(part) for part in parts for path in visible_files(data, f"?*{part}")}
    return [data / f"{name}-events_left.h5" for name in sorted(names)]


def _choose(data: Path) -> tuple[Path, str, str]:
    """Return the event file, its sequence and its side."""
    sequences = "sequences (SEQUENCE-events_left.h5)"
    file = require_one(_event_files(data), data, sequences, "give the event file of one as --data")
    match = _EVENT_FILE.fullmatch(file.name)
    assert match is not None
    return file, match["sequence"], match["side"]


def _find_calibration(folder: Path, kind: str, sequence: str) -> Path:
    """Return the path of a sequence's calibration file, which is beside the sequence or one folder up."""
    name = f"{kind}{'A' if sequence.startswith(_SET_A) else 'B'}.json"
    for path in (folder / name, folder.parent / name):
        if path.is_file():
            return path
    raise DataError(folder / name, "there is no such file", "download the dataset's calibration to this folder")


def _read_camera(path: Path, cameras: _Cameras, index: int) -> tuple[CameraIntrinsics, Tensor]:
    """Return a camera's lens, and the (4, 4) motion from its coordinates to the IMU's."""
    lens = msgspec.structs.astuple(cameras.intrinsics[index].intrinsics)
    with value_errors_as_data_error(path):
        camera = CameraIntrinsics.from_opencv(cameras.resolution[index], lens[:4], lens[4:], "kb4")
    return camera, cameras.T_imu_cam[index].matrix(path)
