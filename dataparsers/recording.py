"""What every dataset format gives, and how Nerfstudio is given it: the base of all dataparsers."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

import torch
from nerfstudio.cameras.camera_utils import auto_orient_and_center_poses
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image
from torch import Tensor

from aenerf_ns.errors import DataError
from aenerf_ns.event_camera import REFERENCE_SECONDS, TRAJECTORY_SECONDS, EventCamera
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventFile
from aenerf_ns.image_encoding import ImageEncoding
from aenerf_ns.trajectory.trajectory import OPENCV_TO_OPENGL, Trajectory, homogeneous

Split = Literal["train", "val", "test"]

# In extents of the trajectory. Nerfstudio's cameras are float32: further out they would be rounded by a pixel and more.
_MAX_REFERENCE_DISTANCE = 1e4

# Training cameras are only there to be seen: the framework's viewer and its start-up slow down with their number.
_MAX_SHOWN = 24


@dataclass(frozen=True)
class ReferenceView:
    """An image with its pose. Reference images serve evaluation, colour correction and the viewer, never training.

    Attributes:
        file: the image.
        camera_to_world: (4, 4) float64 pose, OpenCV camera axes, in the world of the recording's
            :attr:`~Recording.reference_trajectory`.
        time: in nanoseconds on the clock of the events, or None for an image that was not taken on the trajectory.
    """

    file: Path
    camera_to_world: Tensor
    time: int | None


@dataclass(frozen=True)
class Recording:
    """A recording of an event camera, in the world frame and the units of its poses.

    Attributes:
        event_file: the events, not yet read.
        event_camera: the event camera's lens.
        sensor: the event camera's contrast thresholds, refractory period and Bayer pattern.
        trajectory: the estimated trajectory of the event camera, camera-to-world, OpenCV camera axes.
        frame_camera: the lens of the camera that took the reference views.
        reference_views: the images of each split.
        image_encoding: whether the images' values are sRGB or linear in radiance.
        scene_box: (2, 3) smallest and largest corner of a box that holds the whole scene, or None for a scene
            without bounds.
        ground_truth: the true trajectory, camera-to-world, OpenCV camera axes, in a world of any position, orientation
            and scale, or None where it is not known. It serves evaluation only.
    """

    event_file: EventFile
    event_camera: EventCamera
    sensor: SensorModel
    trajectory: Trajectory
    frame_camera: EventCamera
    reference_views: dict[Split, list[ReferenceView]]
    image_encoding: ImageEncoding
    scene_box: Tensor | None = None
    ground_truth: Trajectory | None = None

    @property
    def reference_trajectory(self) -> Trajectory:
        """The best there is to compare with: the true trajectory, or where it is not known the estimated one."""
        return self.trajectory if self.ground_truth is None else self.ground_truth


@dataclass(frozen=True)
class FrameSequence:
    """A recording as it is before it has poses, with the frames that they can be estimated from.

    Attributes:
        event_file: the events, not yet read.
        event_camera: the event camera's lens.
        sensor: the event camera's contrast thresholds, refractory period and Bayer pattern.
        frame_camera: the lens of the camera that took the frames.
        files: the frames, in the order of time.
        times: when they were taken, in nanoseconds on the clock of the events.
        image_encoding: whether the frames' values are sRGB or linear in radiance.
        recording: the recording with its given poses, or None where it has none.
    """

    event_file: EventFile
    event_camera: EventCamera
    sensor: SensorModel
    frame_camera: EventCamera
    files: list[Path]
    times: list[int]
    image_encoding: ImageEncoding
    recording: Recording | None


@dataclass
class EventDataParserConfig(DataParserConfig):
    """What all event dataparsers have in common."""

    _target: type = field(default_factory=lambda: EventDataParser)
    scale_factor: float = 1.0
    """Factor on the camera positions, after the automatic scale."""
    auto_scale_poses: bool = True
    """Scale the estimated poses to fit in a box of +/- 1. Turn it off where the camera moves little compared to the
    distance of the scene, and choose a scale_factor that brings the scene to a size of about 1 instead."""
    orientation_method: Literal["pca", "up", "vertical", "none"] = "up"
    """How to turn the world. Not used where the dataset states a scene box."""
    center_method: Literal["poses", "focus", "none"] = "poses"
    """Where to put the origin. Not used where the dataset states a scene box."""
    start_time_ns: int | None = None
    """Leave out what happened before this time on the clock of the events, in nanoseconds. By default the first event
    or pose, whichever is later. A run's saved configuration holds the value that was used."""
    end_time_ns: int | None = None
    """Leave out what happened after this time, likewise."""


class EventDataParser(DataParser):
    """Gives Nerfstudio places on the estimated trajectory as training cameras and the reference views of a split for
    evaluation. A format implements :meth:`read_recording` and nothing else.
    """

    config: EventDataParserConfig

    @abstractmethod
    def read_recording(self) -> Recording:
        """Reads all but the events.

        Raises:
            DataError: a file is missing or its content cannot be used.
        """

    def read_frames(self) -> FrameSequence:
        """Reads what poses can be estimated from: the timed reference views. A format whose poses may be missing
        overrides it.

        Raises:
            DataError: a file is missing or its content cannot be used.
        """
        recording = self.recording
        timed = {v.time: v.file for views in recording.reference_views.values() for v in views if v.time is not None}
        return FrameSequence(
            event_file=recording.event_file,
            event_camera=recording.event_camera,
            sensor=recording.sensor,
            frame_camera=recording.frame_camera,
            files=[timed[time] for time in sorted(timed)],
            times=sorted(timed),
            image_encoding=recording.image_encoding,
            recording=recording,
        )

    @cached_property
    def recording(self) -> Recording:
        """What :meth:`read_recording` gives, read once."""
        return self.read_recording()

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs: object) -> DataparserOutputs:
        recording = self.recording
        start, end = self._time_window(recording)
        trajectory = recording.trajectory.between(start, end).mapped(lambda poses: poses @ OPENCV_TO_OPENGL)
        transform, scale, scene_box = self._world_transform(trajectory, recording.scene_box)

        def to_scene(poses: Tensor) -> Tensor:
            moved = transform @ poses
            return torch.cat([moved[..., :3], scale * moved[..., 3:]], -1)

        trajectory = trajectory.mapped(to_scene)
        ground_truth = recording.ground_truth
        if ground_truth is not None:
            ground_truth = ground_truth.mapped(lambda poses: to_scene(poses @ OPENCV_TO_OPENGL))
            trajectory.knots_covered_by(ground_truth)
        if split == "train":
            times, images = _training_views(trajectory, recording.reference_views["train"])
            cameras = recording.event_camera.cameras(trajectory.interpolate(times))
            cameras.metadata[TRAJECTORY_SECONDS] = trajectory.seconds(times)[:, None]
        else:
            views = _views_within(recording.reference_views[_as_split(split)], start, end)
            for view in views:
                check_image(view.file, recording.frame_camera)
            poses = torch.stack([v.camera_to_world for v in views]) if views else torch.zeros(0, 4, 4).double()
            poses = to_scene(poses @ OPENCV_TO_OPENGL)
            _check_distance(poses, trajectory if ground_truth is None else ground_truth)
            cameras = recording.frame_camera.cameras(poses)
            cameras.metadata[REFERENCE_SECONDS] = _reference_seconds(views, trajectory)
            times, images = torch.zeros(0, dtype=torch.int64), {i: view.file for i, view in enumerate(views)}
        # The framework wants a name for every camera, also for one without an image.
        names = [images.get(index, Path(self.config.data) / f"camera_{index:05d}") for index in range(len(cameras))]
        return DataparserOutputs(
            image_filenames=names,
            cameras=cameras,
            scene_box=SceneBox(aabb=scene_box.float()),
            dataparser_transform=transform.float(),
            dataparser_scale=scale,
            metadata={
                "trajectory": trajectory,
                "ground_truth": ground_truth,
                "event_camera": recording.event_camera,
                "event_file": recording.event_file,
                "sensor": recording.sensor,
                "time_window": (start, end),
                "camera_times": times,
                "has_image": [index in images for index in range(len(cameras))],
                "image_encoding": recording.image_encoding,
                "bounded": recording.scene_box is not None,
            },
        )

    def _time_window(self, recording: Recording) -> tuple[int, int]:
        """Resolves the time window and stores it in the configuration, so that opening a trained run needs no
        events."""
        config = self.config
        start, end = config.start_time_ns, config.end_time_ns
        if start is None or end is None:
            first, last = recording.event_file.time_span()
            if last < first:
                raise DataError(
                    recording.event_file.path,
                    f"its last event, at {last} ns, is before its first, at {first} ns",
                    "sort the events by time",
                )
            start, end = first if start is None else start, last if end is None else end
        if start >= end:
            raise DataError(
                str(config.data),
                f"nothing is left from {start} to {end} ns",
                "widen the time window (--start-time-ns, --end-time-ns)",
            )
        covered = recording.trajectory.between(start, end)
        config.start_time_ns, config.end_time_ns = max(start, covered.start), min(end, covered.end)
        return config.start_time_ns, config.end_time_ns

    def _world_transform(self, trajectory: Trajectory, box: Tensor | None) -> tuple[Tensor, float, Tensor]:
        """The (3, 4) motion and then the scale that bring the world to the scene's frame, and the scene box there.

        Only the estimated trajectory and the stated box may enter here, never a true pose.
        """
        poses = homogeneous(trajectory.camera_to_worlds)
        if box is not None:
            center, half = (box[0] + box[1]) / 2, (box[1] - box[0]) / 2
            transform = torch.cat([torch.eye(3, dtype=torch.float64), -center[:, None]], -1)
            scale = self.config.scale_factor / float(half.max())
            return transform, scale, torch.stack([-half, half]) * scale
        oriented, transform = auto_orient_and_center_poses(
            poses.float(), method=self.config.orientation_method, center_method=self.config.center_method
        )
        transform = transform.double()
        scale = self.config.scale_factor
        if self.config.auto_scale_poses:
            extent = float(oriented[:, :3, 3].abs().max())
            if extent < 1e-6:
                raise DataError(
                    trajectory.source,
                    f"the camera moves by no more than {extent:.2g}, which gives the scene no scale",
                    "record with a moving camera, or give --auto-scale-poses False",
                )
            scale /= extent
        return transform, scale, torch.tensor([[-1.0] * 3, [1.0] * 3])


def _as_split(split: str) -> Split:
    if split not in ("train", "val", "test"):
        raise ValueError(f"there is no split {split!r}")
    return split  # type: ignore[return-value]


def check_image(file: Path, camera: EventCamera) -> None:
    """Raises a DataError for an image that the framework would read wrongly."""
    with Image.open(file) as image:
        if image.size != (camera.width, camera.height):
            raise DataError(
                file,
                f"the image has {image.width} x {image.height} pixels, its camera {camera.width} x {camera.height}",
                "give the intrinsics of the images as they are",
            )
        if image.mode not in ("L", "RGB", "RGBA"):
            raise DataError(file, f"the image is of PIL's mode {image.mode}", "store 8 bits of grey or RGB")


def _check_distance(poses: Tensor, reference: Trajectory) -> None:
    """Raises a DataError for reference views that single precision would displace."""
    positions = reference.camera_to_worlds[..., 3]
    extent = float((positions - positions.mean(0)).norm(dim=-1).max())
    distance = float(poses[..., 3].abs().max()) if len(poses) else 0.0
    if distance > _MAX_REFERENCE_DISTANCE * extent > 0:
        raise DataError(
            reference.source,
            f"a reference view is {distance / extent:.3g} times as far from the estimated poses as these poses extend",
            "subtract one offset from the positions of these poses and of the reference views",
        )


def _views_within(views: list[ReferenceView], start: int, end: int) -> list[ReferenceView]:
    kept = [view for view in views if view.time is None or start <= view.time <= end]
    if len(kept) < len(views):
        CONSOLE.print(
            f"{len(views) - len(kept)} of {len(views)} reference images are left out: they were taken outside the "
            f"events' {start} to {end} ns."
        )
    return kept


def _training_views(trajectory: Trajectory, views: list[ReferenceView]) -> tuple[Tensor, dict[int, Path]]:
    """Where the viewer shows the camera: at knots and where images were taken, evenly thinned out.

    Returns:
        (N,) times in nanoseconds, and the images among them by index.
    """
    taken = {v.time: v.file for v in views if v.time is not None and trajectory.start <= v.time <= trajectory.end}
    shown = _thin_out(sorted(taken))
    times = sorted({*_thin_out(trajectory.times.tolist()), *shown})
    return torch.tensor(times), {times.index(time): taken[time] for time in shown}


def _reference_seconds(views: list[ReferenceView], trajectory: Trajectory) -> Tensor:
    """(N, 1) float64 seconds since the trajectory's start at which views were taken; NaN for those not on it."""
    times = torch.tensor([[trajectory.start if view.time is None else view.time] for view in views])
    seconds = trajectory.seconds(times.reshape(-1, 1))
    seconds[[view.time is None for view in views]] = torch.nan
    return seconds


def _thin_out(times: list[int]) -> list[int]:
    count = min(len(times), _MAX_SHOWN)
    return [times[round(i * (len(times) - 1) / max(count - 1, 1))] for i in range(count)]
