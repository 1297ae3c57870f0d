"""The options that dataparsers have in common."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from torch import Tensor

from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.errors import DataError, value_errors_as_data_error
from aenerf_ns.events.sensor import SensorModel, sensor_values, states_thresholds
from aenerf_ns.files.limits import MAX_TIME
from aenerf_ns.files.tum_trajectory import read_tum_trajectory
from aenerf_ns.recording.recording import Capture, Recording
from aenerf_ns.recording.views import MAX_VIEWS


@dataclass
class EventDataParserConfig(DataParserConfig):
    """The options of every event dataparser."""

    markers: ClassVar[tuple[str, ...]] = ()
    """Names of the files that tell this format from the others."""
    scale_factor: float = 1.0
    """Factor on the camera positions, after the automatic scale."""
    auto_scale_poses: bool | None = True
    """Scale the estimated poses to fit in a box of +/- 1. Turn it off where the camera moves little compared to the
    distance of the scene, and choose a scale_factor that brings the scene to a size of about 1 instead."""
    orientation_method: Literal["pca", "up", "vertical", "none"] = "up"
    """How to turn the world. Not used where the dataset states a scene box."""
    center_method: Literal["poses", "focus", "none"] = "poses"
    """Where to put the origin. Not used where the dataset states a scene box."""
    start_time_ns: int | None = None
    """Leave out everything before this time on the clock of the events, in nanoseconds. By default the first event or
    the first pose, whichever is later. A run's saved configuration holds the value that was used."""
    end_time_ns: int | None = None
    """Leave out everything after this time. By default the last event or the last pose, whichever is earlier."""
    max_pose_gap_ns: int | None = None
    """Leave out everything between consecutive poses that are further apart than this, in nanoseconds. By default the
    value that the dataset states; where it states none, poses are interpolated however far apart they are."""
    drop_malformed: bool = False
    """Leave out events outside the sensor or out of order, as long as they are at most a thousandth, and the piece in
    which an interrupted file ends, and say how many and where."""

    @classmethod
    def recognizes(cls, data: Path) -> bool:
        """Tell from names of files alone whether a folder has this format."""
        return all((data / name).exists() for name in cls.markers)

    def setup(self, **kwargs: Any) -> Any:
        """Return the dataparser.

        Raises:
            DataError: a whole number among the options is beyond all times, or the longest gap or the scale is not
                positive.
        """
        for option, value in vars(self).items():
            problem = f"--{option.replace('_', '-')} is {value}"
            if isinstance(value, int) and abs(value) > MAX_TIME:
                raise DataError(str(self.data), problem, "give nanoseconds, which have 19 digits at most")
            if option in ("max_pose_gap_ns", "scale_factor") and value is not None and not 0 < value < float("inf"):
                raise DataError(str(self.data), problem, "give a positive number")
        # A run's saved configuration is also read in other working directories.
        paths = {option: value.absolute() for option, value in vars(self).items() if isinstance(value, Path)}
        return super(EventDataParserConfig, replace(self, **paths)).setup(**kwargs)  # type: ignore[arg-type]


@dataclass
class SensorOptions:
    """Values of the sensor that take the place of the dataset's."""

    positive_contrast_threshold: float | None = None
    """C+, in place of the dataset's value or of the one assumed for its sensor. Without a bandwidth, the
    size of both thresholds only sets the scale of log-radiance, which color correction finds."""
    negative_contrast_threshold: float | None = None
    """C-, in place of the dataset's value or of the assumed one. Its ratio to C+ matters."""
    refractory_period_ns: int | None = None
    """Time for which a pixel is blind after each event, in nanoseconds, in place of the dataset's value."""
    bandwidth_hz: float | None = None
    """Cutoff frequency in Hz of the low-pass filter of a pixel that sees the recording's mean radiance, in place of the
    dataset's value. 0: pixels follow at once. With it, the size of the contrast thresholds matters."""


@dataclass
class PublishedDataParserConfig(SensorOptions, EventDataParserConfig):
    """The options that the formats of other projects have in common."""

    auto_scale_poses: bool | None = False
    """Scale the estimated poses to fit in a box of +/- 1. Off by default: poses are in meters, and slow recordings move
    little compared to the distance of the scene. Choose a scale_factor instead."""
    trajectory: Path | None = None
    """Estimated poses of the event camera, as t tx ty tz qx qy qz qw in seconds, camera-to-world, to be used in place
    of the dataset's. The dataset's poses then only serve to evaluate them."""

    def make_capture(self, sensor: SensorModel, has_assumed_thresholds: bool = False, **content: Any) -> Capture:
        """Make a capture, with what the options state in place of the dataset's own sensor.

        Args:
            sensor: the dataset's sensor, or the one assumed.
            has_assumed_thresholds: whether the dataset states no thresholds.
            content: further attributes of :class:`~aenerf_ns.recording.recording.Capture`. By default the event camera
                took the images, and they are linear.

        Raises:
            DataError: a value among the options is impossible.
        """
        defaults = {"frame_camera": content["event_camera"], "image_encoding": "linear"}
        is_assumed = has_assumed_thresholds and not states_thresholds(self)
        # Formats ask for the time span of the events, which depends on this, before the recording is made.
        content["event_file"].drop_malformed = self.drop_malformed
        with value_errors_as_data_error(str(self.data), "correct it among the options"):
            sensor = replace(sensor, **sensor_values(self))
        return Capture(sensor=sensor, has_assumed_thresholds=is_assumed, **{**defaults, **content})

    def make_recording(self, reference: Trajectory, capture: Capture, **content: Any) -> Recording:
        """Make a recording. Poses that the options give are the estimated ones, and the dataset's own are then true.

        Args:
            reference: the dataset's poses.
            capture: the cameras and their events.
            content: further attributes of :class:`~aenerf_ns.recording.recording.Recording`. By default as many images
                are used as of other published formats.
        """
        poses: dict[str, Any] = {"trajectory": reference}
        if self.trajectory is not None:
            poses = {"trajectory": read_tum_trajectory(self.trajectory), "ground_truth": reference}
        return Recording(**vars(capture), **poses, **{"max_views": MAX_VIEWS, **content})


@dataclass
class ObjectDataParserConfig(PublishedDataParserConfig):
    """The options of formats for objects on a uniform background."""

    scene_half_extent: float | None = None
    """Half the side of a cube around the origin that holds the whole scene, in the units of the poses; 0 for a scene
    without bounds. By default the value of the dataset's authors."""

    def scene_box(self, stated: float) -> Tensor | None:
        """Return the (2, 3) float64 corners of the cube, or None for a scene without bounds.

        Args:
            stated: half the side of the cube, where the options give none; 0 for a scene without bounds.

        Raises:
            DataError: the length is negative.
        """
        half = stated if self.scene_half_extent is None else self.scene_half_extent
        if half < 0:
            raise DataError(str(self.data), f"scene_half_extent is {half}", "give a length, or 0 for no bounds")
        return torch.tensor([[-half] * 3, [half] * 3], dtype=torch.float64) if half else None
