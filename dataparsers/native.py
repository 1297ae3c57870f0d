"""The native dataset format (docs/dataset_format.md)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch
from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, homogeneous
from aenerf_ns.errors import DataError, value_errors_as_data_error
from aenerf_ns.events.sensor import SensorModel, sensor_values, states_thresholds
from aenerf_ns.files.event_hdf5 import Hdf5EventFile
from aenerf_ns.files.limits import file_inside
from aenerf_ns.files.transforms import EventCamera, Transforms, frame_from_event, read_transforms, rigid_motion
from aenerf_ns.files.tum_trajectory import read_tum_trajectory
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.options import EventDataParserConfig, SensorOptions
from aenerf_ns.recording.recording import SPLITS, Capture, Recording, ReferenceView, Split


@dataclass
class NativeDataParserConfig(SensorOptions, EventDataParserConfig):
    """aenerf-ns dataset folder."""

    markers = ("transforms.json", "trajectory_estimated.txt or events.h5")
    _target: type = field(default_factory=lambda: NativeDataParser)
    auto_scale_poses: bool | None = None
    """Scale the estimated poses to fit in a box of +/- 1. By default as the dataset states: aenerf convert and aenerf
    reconstruct keep the default of the format that they read, and other datasets are scaled. Where the poses are not
    scaled, choose a scale_factor that brings the scene to a size of about 1 instead."""
    poses: Literal["estimated", "ground-truth"] = "estimated"
    """Which trajectory to train on. Training on the true one shows how much the errors of the estimated one cost."""

    @classmethod
    def recognizes(cls, data: Path) -> bool:
        # Poses may be missing, and so may events, where a trained run is opened.
        has_content = any((data / name).is_file() for name in ("trajectory_estimated.txt", "events.h5"))
        return has_content and (data / "transforms.json").is_file()


class NativeDataParser(EventDataParser):
    """Read a dataset folder that holds transforms.json, an event file and trajectory_estimated.txt."""

    config: NativeDataParserConfig

    def read_recording(self) -> Recording:
        path, meta, capture = self._read_all_but_poses()
        if self.config.auto_scale_poses is None:
            self.config.auto_scale_poses = meta.auto_scale_poses
        true_poses = path.with_name("trajectory_ground_truth.txt")
        recording = Recording(
            **vars(capture),
            trajectory=read_tum_trajectory(self.poses_path()),
            reference_views={},
            scene_box=None if meta.scene_box is None else torch.tensor(meta.scene_box, dtype=torch.float64),
            ground_truth=read_tum_trajectory(true_poses) if true_poses.exists() else None,
            max_pose_gap=meta.max_pose_gap_ns,
        )
        return replace(recording, reference_views=_read_views(path, meta, recording))

    def poses_path(self) -> Path:
        return self.data / f"trajectory_{self.config.poses.replace('-', '_')}.txt"

    def read_capture(self) -> tuple[Capture, list[tuple[int, Path]]]:
        path, meta, capture = self._read_all_but_poses()
        timed = [(frame.timestamp, frame.file_path) for frame in meta.frames if frame.timestamp is not None]
        return capture, [(time, file_inside(path.parent, name, path)) for time, name in timed]

    def _read_all_but_poses(self) -> tuple[Path, Transforms, Capture]:
        """Return transforms.json, its content, and the cameras."""
        path = self.data / "transforms.json"
        meta, frame_camera = read_transforms(path)
        camera = meta.event_camera.intrinsics()
        if meta.event_camera.file is None:
            raise DataError(path, "event_camera: missing field file", "name the file of the events there")
        events = file_inside(path.parent, meta.event_camera.file, path)
        mount = meta.event_camera.T_frame_event
        capture = Capture(
            event_file=Hdf5EventFile(events, camera.width, camera.height),
            event_camera=camera,
            sensor=self._sensor(path, meta.event_camera),
            frame_camera=frame_camera,
            image_encoding=meta.image_encoding,
            intrinsics_origin=meta.event_camera.intrinsics_origin,
            has_assumed_thresholds=meta.event_camera.has_assumed_thresholds and not states_thresholds(self.config),
            frame_from_event=None if mount is None else rigid_motion(path, "event_camera.T_frame_event", mount),
        )
        return path, meta, capture

    def _sensor(self, path: Path, stated: EventCamera) -> SensorModel:
        """Return the sensor with the values of the options, and the dataset's values where the options give none."""
        values = {**sensor_values(stated), **sensor_values(self.config)}
        for name in ("positive_contrast_threshold", "negative_contrast_threshold"):
            if name not in values:
                raise DataError(path, f"event_camera: missing field {name}", "state it there or among the options")
        with value_errors_as_data_error(path, "correct it there or among the options"):
            return SensorModel(**values)


def _read_views(path: Path, meta: Transforms, recording: Recording) -> dict[Split, list[ReferenceView]]:
    """Return the images of each split. A frame that has a time but no pose gets the reference trajectory's pose."""
    truth = None if recording.ground_truth is None else recording.ground_truth.time_without_gaps()
    mount = torch.eye(4, dtype=torch.float64)
    if meta.event_camera.T_frame_event is not None or any(frame.transform_matrix is None for frame in meta.frames):
        mount = frame_from_event(path, meta.event_camera, recording.frame_camera)
    # None for a frame that is left out.
    views: dict[str, ReferenceView | None] = {}
    for index, frame in enumerate(meta.frames):
        name, time, key = frame.file_path, frame.timestamp, f"frames[{index}]"
        if name in views:
            raise DataError(path, f"{key} names {name} again", "list each image once")
        views[name] = None
        file = file_inside(path.parent, name, path)
        if not file.is_file():
            raise DataError(path, f"{key} names {name}, which does not exist", "copy the images too")
        if frame.transform_matrix is not None:
            pose = rigid_motion(path, f"{key}.transform_matrix", frame.transform_matrix) @ OPENCV_TO_OPENGL
        elif time is None:
            raise DataError(path, f"{key} has neither transform_matrix nor timestamp", "give one of them")
        elif truth is not None and not truth.contains(time):
            continue
        else:
            pose = homogeneous(recording.reference_trajectory.interpolate(time)) @ torch.linalg.inv(mount)
        views[name] = ReferenceView(file, pose, time)
    num_lost = sum(view is None for view in views.values())
    if num_lost:
        CONSOLE.print(f"{num_lost} of {len(views)} frames are left out: the true trajectory has no pose for them.")
    splits: dict[Split, list[ReferenceView]] = {}
    for split in SPLITS:
        names = getattr(meta, f"{split}_filenames")
        unknown = [name for name in names if name not in views]
        if unknown:
            problem = f"{split}_filenames names {unknown[0]}, which is not among the frames"
            raise DataError(path, problem, "add it there")
        splits[split] = [view for name in names if (view := views[name]) is not None]
    return splits
