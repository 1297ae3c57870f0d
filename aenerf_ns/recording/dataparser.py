"""How Nerfstudio is given a recording: the base of all dataparsers, and their options."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from nerfstudio.cameras.camera_utils import auto_orient_and_center_poses
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from aenerf_ns.camera.ray_tags import REFERENCE_SECONDS, TRAJECTORY_SECONDS
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, Trajectory, homogeneous
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.time_window import TimeWindow
from aenerf_ns.files.tum_trajectory import read_tum_trajectory
from aenerf_ns.recording.images import check_image
from aenerf_ns.recording.recording import FrameSequence, Recording, ReferenceView, Split
from aenerf_ns.recording.scene import SCENE, Scene

# In extents of the trajectory. Nerfstudio's cameras are float32: further out they would be rounded by a pixel and more.
_MAX_REFERENCE_DISTANCE = 1e4

# Training cameras are only there to be seen: the framework's viewer and its start-up slow down with their number.
_MAX_SHOWN = 24


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
    max_pose_gap_ns: int | None = None
    """Leave out what happened between consecutive poses that are further apart than this, in nanoseconds. By default
    what the dataset states, and else poses are interpolated however far apart they are."""

    def setup(self, **kwargs: Any) -> Any:
        """The dataparser."""
        for option in fields(self):
            path = getattr(self, option.name)
            if isinstance(path, Path):
                # A run's saved configuration is also read in other working directories.
                setattr(self, option.name, path.absolute())
        return super().setup(**kwargs)


@dataclass
class PublishedDataParserConfig(EventDataParserConfig):
    """What the formats of other projects have in common."""

    _target: type = field(default_factory=lambda: EventDataParser)
    auto_scale_poses: bool = False
    """Poses are in metres, and slow recordings move little compared to the scene's distance."""
    positive_contrast_threshold: float | None = None
    """C+, in place of the dataset's or of what is assumed of its sensor. The size of both thresholds only sets the
    scale of the log-radiance, which colour correction finds."""
    negative_contrast_threshold: float | None = None
    """C-, likewise; its ratio to C+ matters."""
    refractory_period_ns: int | None = None
    """Time for which a pixel is blind after each event, in nanoseconds, likewise."""
    trajectory: Path | None = None
    """Estimated poses of the event camera, as t tx ty tz qx qy qz qw in seconds, camera-to-world, to be used in place
    of the dataset's. The dataset's then only serve to evaluate them."""

    def sensor(self, stated: SensorModel) -> SensorModel:
        """The sensor, with what the options give in place of what the dataset states.

        Raises:
            DataError: a value cannot be.
        """
        given: dict[str, Any] = {
            "positive_contrast_threshold": self.positive_contrast_threshold,
            "negative_contrast_threshold": self.negative_contrast_threshold,
            "refractory_period": self.refractory_period_ns,
        }
        try:
            return replace(stated, **{name: value for name, value in given.items() if value is not None})
        except ValueError as error:
            raise DataError(str(self.data), str(error), "correct it among the options") from None

    def estimated(self, reference: Trajectory) -> tuple[Trajectory, Trajectory | None]:
        """The estimated trajectory and, where that is another, the true one, of the dataset's own trajectory."""
        return (reference, None) if self.trajectory is None else (read_tum_trajectory(self.trajectory), reference)


@dataclass
class ObjectDataParserConfig(PublishedDataParserConfig):
    """The formats of objects on a uniform background."""

    scene_half_extent: float | None = None
    """Half the side of a cube around the origin that holds the whole scene, in the units of the poses; 0 for a scene
    without bounds. By default as the dataset's authors have it."""

    def scene_box(self, stated: float) -> Tensor | None:
        """The (2, 3) corners of the cube, where there is one."""
        half = stated if self.scene_half_extent is None else self.scene_half_extent
        if half < 0:
            raise DataError(str(self.data), f"scene_half_extent is {half}", "give a length, or 0 for no bounds")
        return torch.tensor([[-half] * 3, [half] * 3], dtype=torch.float64) if half else None


class EventDataParser(DataParser):
    """Gives Nerfstudio places on the estimated trajectory as training cameras and the reference views of a split for
    evaluation. A format implements :meth:`read_recording`, and those that are found without being named
    :meth:`recognises`.
    """

    config: EventDataParserConfig
    layout: ClassVar[str] = ""
    """The files that :meth:`recognises` looks for, for messages."""

    @classmethod
    def recognises(cls, data: Path) -> bool:
        """Whether ``data`` looks like this format, from the names of its files alone."""
        return False

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
        window = self._time_window(recording, say=split == "train")
        trajectory = recording.trajectory.between(window.start, window.end).mapped(
            lambda poses: poses @ OPENCV_TO_OPENGL
        )
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
            views = _views_within(recording.reference_views[_as_split(split)], window)
            views = thinned(views, recording.max_views)
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
            alpha_color=None if recording.image_background is None else torch.tensor(recording.image_background),
            metadata={
                SCENE: Scene(
                    trajectory=trajectory,
                    ground_truth=ground_truth,
                    event_camera=recording.event_camera,
                    event_file=recording.event_file,
                    sensor=recording.sensor,
                    window=window,
                    camera_times=times,
                    has_image=[index in images for index in range(len(cameras))],
                    image_encoding=recording.image_encoding,
                    bounded=recording.scene_box is not None,
                )
            },
        )

    def _time_window(self, recording: Recording, say: bool) -> TimeWindow:
        """Resolve the time window and store it in the configuration, so that opening a trained run needs no events."""
        config = self.config
        start, end = config.start_time_ns, config.end_time_ns
        if start is None or end is None:
            first, last = recording.event_file.ordered_time_span()
            start, end = first if start is None else start, last if end is None else end
        if start >= end:
            raise DataError(
                str(config.data),
                f"nothing is left from {start} to {end} ns",
                "widen the time window (--start-time-ns, --end-time-ns)",
            )
        covered = recording.trajectory.between(start, end)
        config.start_time_ns, config.end_time_ns = max(start, covered.start), min(end, covered.end)
        return TimeWindow(
            config.start_time_ns,
            config.end_time_ns,
            self._pose_gaps(recording, config.start_time_ns, config.end_time_ns, say),
        )

    def _pose_gaps(self, recording: Recording, start: int, end: int, say: bool) -> tuple[tuple[int, int], ...]:
        """Return where within the time window the poses are too far apart for interpolation."""
        longest = self.config.max_pose_gap_ns
        if longest is not None and longest <= 0:
            raise DataError(str(self.config.data), f"max_pose_gap_ns is {longest}", "give a positive number")
        longest = recording.max_pose_gap if longest is None else longest
        gaps = [gap for gap in recording.trajectory.window(longest).gaps if gap[0] < end and gap[1] > start]
        if longest is not None and gaps and say:
            seconds = sum(last - first for first, last in gaps) * 1e-9
            first, last = max(gaps, key=lambda gap: gap[1] - gap[0])
            CONSOLE.print(
                f"The poses have {len(gaps)} gap(s) of more than {longest * 1e-9:g} s, {seconds:.1f} s in all, the "
                f"longest from {first * 1e-9:.3f} to {last * 1e-9:.3f} s: what happened there is left out."
            )
        return tuple(gaps)

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


def _views_within(views: list[ReferenceView], window: TimeWindow) -> list[ReferenceView]:
    kept = [view for view in views if view.time is None or window.contains(view.time)]
    if len(kept) < len(views):
        CONSOLE.print(
            f"{len(views) - len(kept)} of {len(views)} reference images are left out: they were taken outside the "
            f"events' {window.start} to {window.end} ns or in a gap of the poses."
        )
    return kept


def thinned(views: list[ReferenceView], max_views: int | None) -> list[ReferenceView]:
    """The views, of those that were taken on the trajectory at most ``max_views``, evenly spread over them."""
    timed = [view for view in views if view.time is not None]
    if max_views is None or len(timed) <= max_views:
        return views
    kept = [timed[round(i * (len(timed) - 1) / max(max_views - 1, 1))] for i in range(max_views)]
    return [*kept, *(view for view in views if view.time is None)]


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
