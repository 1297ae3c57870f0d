"""The user's own recording: a file of events, the camera's calibration, and poses from any source."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from aenerf_ns.camera.image_encoding import ImageEncoding
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.errors import DataError
from aenerf_ns.files.calibration import Calibration, read_calibration, require_no_names
from aenerf_ns.files.colmap import read_colmap_focal_shares, read_colmap_poses
from aenerf_ns.files.event_reader import EventFile
from aenerf_ns.files.limits import require_one
from aenerf_ns.files.open import SUFFIXES, open_event_file
from aenerf_ns.files.text import TimeUnit
from aenerf_ns.files.tum_trajectory import read_tum_trajectory
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.options import PublishedDataParserConfig
from aenerf_ns.recording.recording import Capture, Recording
from aenerf_ns.recording.views import IMAGE_LIST, read_image_list, require_distinct_times, views_on_trajectory

CALIBRATIONS = ("calibration.json", "camchain.yaml", "camera_info.yaml")
"""A recording's folder holds its calibration in one of these files."""
# COLMAP's own estimate may be off by some percent.
_MAX_FOCAL_RATIO = 1.15


@dataclass
class OwnRecordingDataParserConfig(PublishedDataParserConfig):
    """A recording of your own."""

    markers = (
        f"events{{{','.join(SUFFIXES)}}} (or such a file of any name in place of the folder)",
        f"{' or '.join(CALIBRATIONS)}, where there is one",
        "poses in trajectory.txt or a COLMAP model in colmap, where there are any",
    )
    _target: type = field(default_factory=lambda: OwnRecordingDataParser)
    events: Path | None = None
    """The file of events. By default the one that is given in place of the folder, or the file in the folder that is
    named "events", with the suffix of any format."""
    event_topic: str | None = None
    """Topic of a bag, or number of the stream of an AEDAT4 file, where several hold events."""
    event_time_unit: TimeUnit | None = None
    """Unit of the times in npz, npy, csv and text files, and in HDF5 files that state none. By default whole numbers
    are microseconds and decimals seconds."""
    calibration: Path | None = None
    """The cameras: calibration.json, the camchain.yaml that Kalibr writes, or the camera_info.yaml of one camera that
    ROS writes. By default the file of one of these names in the folder."""
    event_camera: str | None = None
    """Name of the event camera in a camchain of several cameras, such as cam1."""
    frame_camera: str | None = None
    """Name in a camchain of several cameras of the one that took the images, which may be the event camera."""
    poses: Path | None = None
    """Poses of the event camera as t tx ty tz qx qy qz qw in seconds, camera-to-world, OpenCV camera axes, or
    the folder of a COLMAP model. By default trajectory.txt in the folder."""
    colmap: Path | None = None
    """Folder of a COLMAP model, in place of the poses. images.txt must list the images of the model with their times.
    By default "colmap" in the folder, where there is no trajectory.txt."""
    images: Path | None = None
    """List of the images: on each line the time in seconds and the file. By default images.txt in the folder, if it is
    there."""
    image_encoding: ImageEncoding | None = None
    """Whether the images' values are sRGB or linear, in place of the calibration's."""

    @classmethod
    def recognizes(cls, data: Path) -> bool:
        # Poses and calibration may be missing: they can be estimated. Events may, where a trained run is opened.
        has_poses = (data / "trajectory.txt").is_file() or (data / "colmap").is_dir()
        has_calibration = any((data / name).is_file() for name in CALIBRATIONS)
        has_events = any((data / f"events{suffix}").is_file() for suffix in SUFFIXES)
        return has_events or (has_calibration and has_poses) or (_is_event_file(data) and data.is_file())


class OwnRecordingDataParser(EventDataParser):
    """Read a recording from the files that the options name, or from the files of the default names in a folder, which
    may be given by its file of events."""

    config: OwnRecordingDataParserConfig

    def read_recording(self) -> Recording:
        config = self.config
        capture, timed = self.read_capture()
        frame_from_event = capture.frame_from_event
        assert frame_from_event is not None
        poses = self.poses_path()
        if poses == config.colmap or poses.is_dir():
            if not timed:
                remedy = "write a line for each: time[s] file"
                raise DataError(self._image_list, "there is no such list of images", remedy)
            reference = _read_colmap(poses, timed, self._image_list, frame_from_event, capture)
        else:
            reference = read_tum_trajectory(poses)
        event_from_frame = torch.linalg.inv(frame_from_event)
        views = views_on_trajectory(timed, reference, event_from_frame, max_pose_gap=config.max_pose_gap_ns)
        return config.make_recording(reference, capture, reference_views=views)

    def poses_path(self) -> Path:
        config = self.config
        if config.colmap and config.poses:
            raise DataError("event-recording-data", "--poses and --colmap are both given", "leave out one of them")
        stated = config.colmap or config.poses
        if stated is not None and not stated.exists():
            option = "--colmap" if config.colmap else "--poses"
            raise DataError(stated, "there are no poses", f"correct {option}, or leave it out")
        trajectory, model = self._folder / "trajectory.txt", self._folder / "colmap"
        return stated or (model if model.is_dir() and not trajectory.is_file() else trajectory)

    def read_capture(self) -> tuple[Capture, list[tuple[int, Path]]]:
        config = self.config
        if not self._folder.is_dir():
            raise DataError(self._folder, "there is no such folder", "give the folder of the recording as --data")
        images = self._image_list
        timed = read_image_list(images) if config.images is not None or images.is_file() else []
        calibration = self._read_calibration(bool(timed))
        if config.image_encoding is not None:
            calibration = replace(calibration, image_encoding=config.image_encoding)
        events = self._event_file(calibration.event_camera.width, calibration.event_camera.height)
        return config.make_capture(event_file=events, **vars(calibration)), timed

    @property
    def _folder(self) -> Path:
        return self.data.parent if _is_event_file(self.data) else self.data

    @property
    def _image_list(self) -> Path:
        return self.config.images or self._folder / IMAGE_LIST

    def _read_calibration(self, has_images: bool) -> Calibration:
        config, file = self.config, self.config.calibration
        if file is None:
            found = [self._folder / name for name in CALIBRATIONS if (self._folder / name).is_file()]
            if not found:
                require_no_names(self._folder, config.event_camera, config.frame_camera)
                # Only the size of the camera is known, which the event file states.
                events = self._event_file()
                camera = CameraIntrinsics.guess(events.width, events.height)
                motion = torch.eye(4, dtype=torch.float64)
                return Calibration(camera, camera, motion, intrinsics_origin="guessed")
            file = require_one(found, self._folder, f"of {' and '.join(CALIBRATIONS)}", "give one as --calibration")
        return read_calibration(file, config.event_camera, config.frame_camera, has_images)

    def _event_file(self, width: int | None = None, height: int | None = None) -> EventFile:
        config = self.config
        if config.events is None and _is_event_file(self.data):
            config.events = self.data
        elif config.events is None:
            files = sorted(file for suffix in SUFFIXES if (file := self.data / f"events{suffix}").is_file())
            what = f"files events{{{','.join(SUFFIXES)}}}"
            # Stored, so that opening a trained run needs no events.
            config.events = require_one(files, self.data, what, "give one as --events")
        return open_event_file(config.events, width, height, config.event_topic, config.event_time_unit)


def _is_event_file(data: Path) -> bool:
    # It may be gone when a trained run is opened.
    return data.suffix.lower() in SUFFIXES and not data.is_dir()


def _read_colmap(
    model: Path, timed: list[tuple[int, Path]], images: Path, frame_from_event: Tensor, capture: Capture
) -> Trajectory:
    """Return the event camera's trajectory: a pose for each image that a COLMAP model places."""
    folders = [folder for folder in (model, model / "sparse" / "0", model / "0") if any(folder.glob("images.*"))]
    model = folders[0] if folders else model
    poses = read_colmap_poses(model)
    lens = capture.frame_camera
    # A lens that is only guessed says nothing of the model's.
    shares = [] if capture.intrinsics_origin == "guessed" else read_colmap_focal_shares(model)
    for share in shares:
        if not 1 / _MAX_FOCAL_RATIO < share * lens.width / lens.fx < _MAX_FOCAL_RATIO:
            raise DataError(
                model,
                f"its focal length is {share * lens.width:.4g} px, that of the calibration {lens.fx:.4g} px",
                "move this folder away and estimate the poses again (aenerf convert --poses colmap), or correct the "
                "calibration",
            )
    if frame_from_event[:3, 3].norm() > 0:
        CONSOLE.print("The COLMAP model must have the unit of T_frame_event: the two are combined as they are.")
    times_of: dict[str, list[int]] = defaultdict(list)
    for time, file in timed:
        for first in range(1, len(file.parts)):
            times_of["/".join(file.parts[first:])].append(time)
    placed: list[tuple[int, Tensor]] = []
    for name, pose in poses.items():
        times = times_of[name]
        if len(times) != 1:
            raise DataError(images, f"it lists {name} {len(times)} times", "list every image of the COLMAP model once")
        placed.append((times[0], pose))
    require_distinct_times([time for time, _ in placed], images)
    known = dict(placed)
    order = sorted(known)
    if len(order) < len(timed):
        CONSOLE.print(f"COLMAP placed {len(order)} of the {len(timed)} images: poses are interpolated between these.")
    frames = torch.stack([known[time] for time in order])
    # Errors about times name the list of images, which holds the times.
    return Trajectory(order, frames @ frame_from_event, images)
