"""The native dataset format (docs/dataset_format.md)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, Trajectory, homogeneous
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.event_hdf5 import Hdf5EventFile
from aenerf_ns.files.json_object import JsonObject, read_camera, read_image_encoding
from aenerf_ns.files.tum_trajectory import read_tum_trajectory
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.options import EventDataParserConfig, SensorOptions
from aenerf_ns.recording.recording import SPLITS, Recording, ReferenceView, Split


@dataclass
class NativeDataParserConfig(SensorOptions, EventDataParserConfig):
    """aenerf-ns dataset folder."""

    markers = ("transforms.json", "trajectory_estimated.txt")
    _target: type = field(default_factory=lambda: NativeDataParser)
    auto_scale_poses: bool | None = None
    """Scale the estimated poses to fit in a box of +/- 1. By default as the dataset states: aenerf convert and aenerf
    reconstruct keep the default of the format that they read, and other datasets are scaled. Where the poses are not
    scaled, choose a scale_factor that brings the scene to a size of about 1 instead."""
    poses: Literal["estimated", "ground-truth"] = "estimated"
    """Which trajectory to train on. Training on the true one shows how much the errors of the estimated one cost."""


class NativeDataParser(EventDataParser):
    """Read a dataset folder that holds transforms.json, an event file and trajectory_estimated.txt."""

    config: NativeDataParserConfig

    def read_recording(self) -> Recording:
        folder = Path(self.config.data)
        meta = JsonObject.read(folder / "transforms.json")
        if self.config.auto_scale_poses is None:
            self.config.auto_scale_poses = meta.get("auto_scale_poses", bool, True)
        block = meta.block("event_camera")
        event_camera = read_camera(block, "width", "height")
        true_poses = folder / "trajectory_ground_truth.txt"
        trained_on = folder / "trajectory_estimated.txt" if self.config.poses == "estimated" else true_poses
        trajectory = read_tum_trajectory(trained_on)
        ground_truth = read_tum_trajectory(true_poses) if true_poses.exists() else None
        frames = meta.get("frames", list, [])
        sensor = self._sensor(block)
        box = meta.get("scene_box", list, None)
        max_pose_gap = meta.get("max_pose_gap_ns", int, None)
        if max_pose_gap is not None and max_pose_gap <= 0:
            raise meta.error("max_pose_gap_ns", f"is {max_pose_gap}, not a positive number of nanoseconds")
        return Recording(
            event_file=Hdf5EventFile(block.file("file"), event_camera.width, event_camera.height),
            event_camera=event_camera,
            sensor=sensor,
            trajectory=trajectory,
            frame_camera=read_camera(meta, "w", "h") if frames else event_camera,
            reference_views=_reference_views(
                meta,
                frames,
                trajectory if ground_truth is None else ground_truth,
                ground_truth is not None,
                block.rigid_motion("T_frame_event"),
            ),
            image_encoding=read_image_encoding(meta),
            scene_box=None if box is None else _scene_box(meta, box),
            ground_truth=ground_truth,
            max_pose_gap=max_pose_gap,
        )

    def _sensor(self, block: JsonObject) -> SensorModel:
        """Return the sensor with the values of the options, and the dataset's values where the options give none."""
        values = self.config.given_sensor_values()
        for name in ("positive_contrast_threshold", "negative_contrast_threshold"):
            if name not in values:
                values[name] = block.get(name, float)
        if "refractory_period" not in values:
            values["refractory_period"] = block.get("refractory_period_ns", int, 0)
        pattern = block.get("bayer_pattern", str, "")
        try:
            return SensorModel(**values, bayer_pattern=pattern)
        except ValueError as error:
            raise DataError(block.path, f"event_camera: {error}", "correct it there or among the options") from None


def _scene_box(meta: JsonObject, value: list) -> Tensor:
    box = meta.numbers("scene_box", value, (2, 3))
    if (box[0] >= box[1]).any():
        raise meta.error("scene_box", f"has corners {box.tolist()}, the first not below the second")
    return box


def _reference_views(
    meta: JsonObject, frames: list, trajectory: Trajectory, has_ground_truth: bool, frame_from_event: Tensor | None
) -> dict[Split, list[ReferenceView]]:
    """Return the images of each split. A frame that has a time but no pose gets the reference trajectory's pose."""
    if frame_from_event is None:
        frame_from_event = torch.eye(4, dtype=torch.float64)
    views: dict[str, ReferenceView] = {}
    known: set[str] = set()
    num_without_pose = 0
    for index in range(len(frames)):
        frame = meta.entry_block("frames", index)
        name = frame.get("file_path", str)
        if name in known:
            raise frame.error("file_path", f"names {name} again")
        known.add(name)
        file = frame.file("file_path")
        if not file.is_file():
            raise frame.error("file_path", f"names {name}, which does not exist")
        time = frame.time("timestamp")
        pose = frame.rigid_motion("transform_matrix")
        if pose is None and time is not None and has_ground_truth and not trajectory.start <= time <= trajectory.end:
            num_without_pose += 1
            continue
        if pose is not None:
            pose = pose @ OPENCV_TO_OPENGL
        elif time is not None:
            pose = homogeneous(trajectory.interpolate(time)) @ torch.linalg.inv(frame_from_event)
        else:
            raise frame.error("transform_matrix", "is missing, and so is timestamp")
        views[name] = ReferenceView(file, pose, time)
    if num_without_pose:
        CONSOLE.print(
            f"{num_without_pose} of {len(frames)} frames are left out: the true trajectory has no pose for them."
        )
    splits: dict[Split, list[ReferenceView]] = {}
    for split in SPLITS:
        names = meta.names(f"{split}_filenames")
        unknown = [name for name in names if name not in known]
        if unknown:
            raise meta.error(f"{split}_filenames", f"names {unknown[0]}, which is not among the frames")
        splits[split] = [views[name] for name in names if name in views]
    return splits


native_dataparser = DataParserSpecification(config=NativeDataParserConfig(), description="aenerf-ns dataset folder")
