"""A recording: the one form that every dataset format is read into."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from aenerf_ns.camera.image_encoding import ImageEncoding
from aenerf_ns.camera.intrinsics import CameraIntrinsics, Origin
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.event_reader import EventFile

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = ("train", "val", "test")


@dataclass(frozen=True)
class ReferenceView:
    """An image with its pose, for evaluation, color correction and the viewer.

    Only ``e2vid-nerf`` trains on images: those of the train split, which ``aenerf reconstruct`` makes of the events.

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
class Capture:
    """The cameras and their events, without any poses.

    Attributes:
        event_file: the events, not yet read.
        event_camera: the event camera's lens.
        sensor: the event camera's.
        frame_camera: the lens of the camera that took the images.
        image_encoding: whether the images' values are sRGB or linear in radiance.
        has_assumed_thresholds: whether neither the dataset nor an option states the contrast thresholds.
        intrinsics_origin: where the event camera's lens comes from. A guessed one has to be estimated together with the
            poses.
        frame_from_event: (4, 4) float64, takes points from the event camera's to the frame camera's coordinates, where
            the format keeps it.
    """

    event_file: EventFile
    event_camera: CameraIntrinsics
    sensor: SensorModel
    frame_camera: CameraIntrinsics
    image_encoding: ImageEncoding
    has_assumed_thresholds: bool = field(default=False, kw_only=True)
    intrinsics_origin: Origin = field(default="given", kw_only=True)
    frame_from_event: Tensor | None = field(default=None, kw_only=True)

    @property
    def has_own_frames(self) -> bool:
        """Whether the images are of the event camera's own lens. Two cameras of one kind may share nominal values."""
        motion = self.frame_from_event
        is_apart = motion is not None and not torch.equal(motion, torch.eye(4).to(motion))
        return self.frame_camera == self.event_camera and not is_apart


@dataclass(frozen=True)
class Recording(Capture):
    """A capture with poses, in the world frame and the units of its poses.

    Attributes:
        trajectory: the estimated trajectory of the event camera, camera-to-world, OpenCV camera axes.
        reference_views: the images of each split.
        scene_box: (2, 3) smallest and largest corner of a box that holds the whole scene, or None for a scene
            without bounds.
        ground_truth: the true trajectory, camera-to-world, OpenCV camera axes, or None where it is not known. Its
            world may have any position, orientation and scale. It serves evaluation only.
        max_pose_gap: nanoseconds. Between poses that are further apart, the camera's path is not known. None: poses
            are interpolated however far apart they are.
        max_views: the largest number of timed views of a split that are used, evenly spread over the time window.
            None: all are used.
        image_background: RGB in [0, 1] behind images that have an alpha channel. None: the channel is ignored.
    """

    trajectory: Trajectory
    reference_views: dict[Split, list[ReferenceView]]
    scene_box: Tensor | None = None
    ground_truth: Trajectory | None = None
    max_pose_gap: int | None = None
    max_views: int | None = None
    image_background: tuple[float, float, float] | None = None

    @property
    def reference_trajectory(self) -> Trajectory:
        """The trajectory to compare with: the true one where it is known, else the estimated one."""
        return self.trajectory if self.ground_truth is None else self.ground_truth

    @property
    def frames(self) -> list[tuple[int, Path]]:
        """The times in nanoseconds and the files of the reference views that have a time, in the order of time."""
        views = [view for split in self.reference_views.values() for view in split]
        return sorted({view.time: view.file for view in views if view.time is not None}.items())
