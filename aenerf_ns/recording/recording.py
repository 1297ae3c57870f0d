"""A recording: what every dataset format gives."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from torch import Tensor

from aenerf_ns.camera.image_encoding import ImageEncoding
from aenerf_ns.camera.lens import EventCamera
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventFile

Split = Literal["train", "val", "test"]


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
        max_pose_gap: nanoseconds; where poses are further apart, the camera's way between them is not known. None:
            poses are interpolated however far apart they are.
        max_views: how many of the views of a split that were taken on the trajectory are used at most, evenly spread
            over the time window; None: all.
        image_background: RGB in [0, 1] behind images that have an alpha channel, or None where that is ignored.
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
    max_pose_gap: int | None = None
    max_views: int | None = None
    image_background: tuple[float, float, float] | None = None

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
