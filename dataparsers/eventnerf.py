"""The format of EventNeRF (Rudnev et al. 2023).

It follows the format of NeRF++: text files of matrices. The unit of the events' times is not stated.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import Trajectory, require_rigid
from aenerf_ns.errors import DataError, value_errors_as_data_error
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.event_arrays import XYTP_MEMBERS, ArrayEventFile
from aenerf_ns.files.limits import list_files, read_text, require_one, visible_files
from aenerf_ns.files.text import TimeUnit, parse_numbers
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.options import ObjectDataParserConfig
from aenerf_ns.recording.recording import Capture, Recording, ReferenceView, Split
from aenerf_ns.recording.views import image_files, image_files_of_poses, views_on_trajectory

# A DAVIS 346C.
_WIDTH, _HEIGHT = 346, 260
# NeRF++ scales the cameras of a scene into the unit sphere.
_UNIT_SPHERE = 1.0
# A matrix has 20 numbers.
_MAX_BYTES = 1 << 16


@dataclass
class EvenPosesDataParserConfig(ObjectDataParserConfig):
    """The options of formats whose poses have no times: the poses are evenly spread over the events."""

    time_unit: TimeUnit | None = None
    """Unit of the times of the events. By default whole numbers are microseconds and decimals seconds."""
    first_pose_time_ns: int | None = None
    """Time of the first pose on the clock of the events, in nanoseconds. The format states the default. A run's saved
    configuration holds the value that was used."""
    last_pose_time_ns: int | None = None
    """Time of the last pose on the clock of the events, in nanoseconds. By default the time of the last event."""

    def make_even_recording(
        self, capture: Capture, poses: Tensor, source: Path, images: Path, first: int | None = None
    ) -> Recording:
        """Make a recording of poses at even times, in the unit sphere.

        The first and the last time are stored in the configuration, so that opening a trained run needs no events.

        Args:
            capture: the cameras and their events, whose span gives the times that nothing else states.
            poses: (N, 4, 4) camera-to-world.
            source: the file or folder of the poses, for messages.
            images: folder of an image for each pose, or of none.
            first: default time of the first pose in nanoseconds. None: the time of the first event.

        Raises:
            DataError: there is no time for the poses.
        """
        if self.first_pose_time_ns is None:
            self.first_pose_time_ns = capture.event_file.time_span()[0] if first is None else first
        if self.last_pose_time_ns is None:
            self.last_pose_time_ns = capture.event_file.time_span()[1]
        duration, steps = self.last_pose_time_ns - self.first_pose_time_ns, max(len(poses) - 1, 1)
        if duration < steps:
            problem = f"its {len(poses)} poses are from {self.first_pose_time_ns} to {self.last_pose_time_ns} ns"
            remedy = "give an earlier --first-pose-time-ns or a later --last-pose-time-ns"
            raise DataError(str(self.data), problem, remedy)
        times = [self.first_pose_time_ns + duration * index // steps for index in range(len(poses))]
        reference = Trajectory(times, poses, source)
        # There may be no images.
        timed = list(zip(times, image_files_of_poses(images, len(poses)), strict=False))
        views, box = views_on_trajectory(timed, reference), self.scene_box(_UNIT_SPHERE)
        return self.make_recording(reference, capture, reference_views=views, scene_box=box)


@dataclass
class EventNeRFDataParserConfig(EvenPosesDataParserConfig):
    """EventNeRF."""

    markers = ("train/events/*.npz", "train/intrinsics")
    _target: type = field(default_factory=lambda: EventNeRFDataParser)
    color: bool = True
    """Whether the sensor has the color filter RGGB."""

    @classmethod
    def recognizes(cls, data: Path) -> bool:
        return any((split / "pose").is_dir() or (split / "events").is_dir() for split in _training_splits(data))


class EventNeRFDataParser(EventDataParser):
    """Read the training split of a scene, and the views of its splits "validation" and "test" where there are any.

    Where a scene has several training splits, the folder of one is given in place of the scene's.
    """

    config: EventNeRFDataParserConfig

    def read_recording(self) -> Recording:
        split = self._split()
        capture, _ = self.read_capture()
        # Pose i of N is at i / (N - 1) of the time of the last event.
        recording = self.config.make_even_recording(capture, _read_poses(split), split / "pose", split / "rgb", 0)
        views = {**recording.reference_views, **_held_out_views(split.parent)}
        return replace(recording, reference_views=views)

    def poses_path(self) -> Path:
        return self._split() / "pose"

    def read_capture(self) -> tuple[Capture, list[tuple[int, Path]]]:
        split = self._split()
        # A trained run is opened without its events.
        events = visible_files(split / "events", "*.npz") or [split / "events" / "events.npz"]
        file = require_one(events, split / "events", "files *.npz", "leave the events of the scene only")
        capture = self.config.make_capture(
            SensorModel(bayer_pattern="RGGB" if self.config.color else ""),
            has_assumed_thresholds=True,
            event_file=ArrayEventFile(file, _WIDTH, _HEIGHT, XYTP_MEMBERS, self.config.time_unit),
            event_camera=read_intrinsics(split / "intrinsics", _WIDTH, _HEIGHT),
            image_encoding="srgb",
        )
        # The images have no times but those of the poses.
        return capture, []

    def _split(self) -> Path:
        splits = _training_splits(self.data)
        return require_one(splits, self.data, "training splits (train/intrinsics)", "give the folder of one as --data")


def _training_splits(data: Path) -> list[Path]:
    folders = [data] if (data / "intrinsics").is_dir() else data.glob("train*")
    return sorted(folder for folder in folders if (folder / "intrinsics").is_dir())


def _held_out_views(scene: Path) -> dict[Split, list[ReferenceView]]:
    """Read the views of the splits "validation" and "test". Where one has none, both share the views of the other."""
    found: list[list[ReferenceView]] = []
    for name in ("validation", "test"):
        if image_files(scene / name / "rgb"):
            poses = _read_poses(scene / name)
            files = image_files_of_poses(scene / name / "rgb", len(poses))
            found.append([ReferenceView(file, pose, None) for file, pose in zip(files, poses, strict=True)])
    if len(found) == 1:
        found = [found[0][::2], found[0][1::2]]
    return dict(zip(("val", "test"), found, strict=False))


def _read_poses(split: Path) -> Tensor:
    """Read the (N, 4, 4) float64 camera-to-world poses of a split, OpenCV camera axes."""
    poses = torch.stack([torch.from_numpy(read_matrix(file, 4)) for file in list_files(split / "pose", "*.txt")])
    require_rigid(poses, split / "pose")
    return poses


def read_matrix(path: Path, *num_rows: int) -> np.ndarray:
    """Read the (rows, 4) float64 matrix in a text file.

    Args:
        path: the file.
        num_rows: the numbers of rows that the matrix may have.

    Raises:
        DataError: the file is missing or malformed, or a number is not finite.
    """
    fields = read_text(path, _MAX_BYTES).split()
    if len(fields) not in [4 * rows for rows in num_rows]:
        problem = f"it holds {len(fields)} numbers"
        raise DataError(path, problem, f"it must hold {' or '.join(f'{rows} x 4' for rows in num_rows)}")
    matrix = parse_numbers(path, [fields]).reshape(-1, 4)
    if not np.isfinite(matrix).all():
        raise DataError(path, "a number is not finite", "drop it, and its image")
    return matrix


def read_intrinsics(folder: Path, width: int, height: int) -> CameraIntrinsics:
    """Read the lens in the first file of a folder: a 4 x 4 matrix and perhaps a fifth line with k1 and k2.

    Raises:
        DataError: the folder holds no file, or the file is malformed.
    """
    file = list_files(folder, "*.txt")[0]
    matrix = read_matrix(file, 4, 5).tolist()
    k1, k2 = matrix[4][:2] if len(matrix) == 5 else (0.0, 0.0)
    with value_errors_as_data_error(file, "it must hold the matrix of the intrinsics"):
        # NeRF++ counts pixels from the edge of the image, as CameraIntrinsics does.
        pinhole = matrix[0][0], matrix[1][1], matrix[0][2], matrix[1][2]
        return CameraIntrinsics(width, height, *pinhole, distortion=(k1, k2, 0.0, 0.0, 0.0))
