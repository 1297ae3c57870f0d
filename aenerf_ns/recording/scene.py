"""A recording in the frame and the units of the scene, as dataset, sampler and model take it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from aenerf_ns.camera.alignment import Similarity
from aenerf_ns.camera.image_encoding import ImageEncoding
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, Trajectory
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.event_reader import EventFile

SCENE_KEY = "scene"
"""The key of the :class:`SceneRecording` in the metadata of Nerfstudio's dataparser outputs and datasets."""


@dataclass(frozen=True)
class SceneRecording:
    """The part of a recording that the dataparser hands on. What has a name of
    :class:`~aenerf_ns.recording.recording.Recording` is the same, but for the world of the poses.

    Attributes:
        frame: maps the recording's world, in the units of its poses, to the scene's.
        trajectory: the estimated trajectory of the event camera, camera-to-world, OpenGL camera axes, scene units.
        ground_truth: the true trajectory, with the same conventions, or None where it is not known.
        camera: of the split's pictures: the event camera in the train split, else the frame camera.
        window: the time that is used: the time that both events and poses cover, without the gaps of the poses.
        camera_times: (N,) times of the training cameras in nanoseconds; none for the other splits.
        has_image: whether each camera of the split has an image.
        bounded: whether the dataset states a box that holds the whole scene.
        frames: times in nanoseconds within the window, and files, of the train split's images that the event camera's
            lens took at known times; none for the other splits. Only a method that says so trains on them.
        is_whole: whether nobody chose the window: it follows from events and poses.
    """

    frame: Similarity
    trajectory: Trajectory
    ground_truth: Trajectory | None
    event_camera: CameraIntrinsics
    event_file: EventFile
    sensor: SensorModel
    window: TimeWindow
    camera: CameraIntrinsics
    camera_times: Tensor
    has_image: list[bool]
    image_encoding: ImageEncoding
    bounded: bool
    frames: tuple[tuple[int, Path], ...] = ()
    is_whole: bool = False

    @property
    def scale(self) -> float:
        """Units of the scene in a unit of the recording."""
        return float(self.frame.scale)

    def to_scene(self, poses: Tensor) -> Tensor:
        """Map (..., 3 or 4, 4) float64 camera-to-world poses of the recording, OpenCV camera axes, to (..., 3, 4)
        poses in the scene's frame and units, OpenGL camera axes."""
        return self.frame(poses[..., :3, :].cpu() @ OPENCV_TO_OPENGL)

    def to_recording(self, poses: Tensor) -> Tensor:
        """Map (..., 3, 4) poses of the scene back to the recording: the inverse of :meth:`to_scene`."""
        return self.frame.inverse()(poses.cpu().double()) @ OPENCV_TO_OPENGL
