"""Handing a recording to Nerfstudio: the base of all dataparsers."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import torch
from nerfstudio.cameras.camera_utils import auto_orient_and_center_poses
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from aenerf_ns.camera.alignment import Similarity
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.metadata_keys import REFERENCE_SECONDS, TRAJECTORY_SECONDS
from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, Trajectory, homogeneous
from aenerf_ns.errors import DataError, reading
from aenerf_ns.recording.images import check_image
from aenerf_ns.recording.options import EventDataParserConfig
from aenerf_ns.recording.recording import Capture, Recording, Split
from aenerf_ns.recording.scene import SCENE_KEY, SceneRecording
from aenerf_ns.recording.time_units import require_one_unit
from aenerf_ns.recording.views import (
    require_distinct_times,
    seconds_on_trajectory,
    thin_views,
    viewer_cameras,
    views_within,
)

# Extents of the trajectory. Nerfstudio's cameras are float32: further out they would be rounded by a pixel and more.
_MAX_REFERENCE_DISTANCE = 1e4
# Limits of half the side and of the corners of a scene box, in the units of the poses, whatever these are.
_MIN_BOX, _MAX_BOX = 1e-6, 1e6
_ESTIMATE = "aenerf convert DATA --output FOLDER --poses events"


class EventDataParser(DataParser):
    """Hand a recording to Nerfstudio.

    Training cameras are poses on the estimated trajectory; evaluation cameras are the reference views of a split. A
    format implements :meth:`read_recording`. A format whose poses may be missing also implements :meth:`poses_path` and
    :meth:`read_capture`. A format that is found without being named also states its files in its configuration
    (``markers``).
    """

    config: EventDataParserConfig
    guessed_format: str | None = None
    """The name of this format, where it was recognized and not named: an error may mean that it is another."""

    @property
    def data(self) -> Path:
        """The dataset's folder, or the file or folder in it that chooses a part."""
        return Path(self.config.data)

    @abstractmethod
    def read_recording(self) -> Recording:
        """Read the dataset, except for its events.

        Raises:
            DataError: a file is missing or its content cannot be used.
        """

    def poses_path(self) -> Path | None:
        """Return the file or folder of the dataset's poses, which may be missing. None: they cannot be missing."""
        return None

    def read_capture(self) -> tuple[Capture, list[tuple[int, Path]]]:
        """Read a dataset without poses: its cameras, and the times in nanoseconds and the files of its frames.

        Called where the file of :meth:`poses_path` is missing: a format that overrides one overrides both. Here the
        whole recording is read, and its reader says what is missing.
        """
        recording = self.read_recording()
        return recording, recording.frames

    def read_frames(self) -> tuple[Capture, list[tuple[int, Path]]]:
        """Read what poses can be estimated from: the events, and the timed reference views.

        Returns:
            The recording, or its capture alone where it has no poses, and the frames in the order of time: nanoseconds
            on the clock of the events, and files.

        Raises:
            DataError: a file is missing or its content cannot be used.
        """
        with reading(self.data):
            # Given poses without true ones are an error, not a recording without poses.
            if self._lacks_poses() and getattr(self.config, "trajectory", None) is None:
                capture, frames = self.read_capture()
                if capture.has_own_frames:
                    require_distinct_times([time for time, _ in frames], self.data)
                capture.event_file.drop_malformed = self.config.drop_malformed
                self._check_lens(capture.event_camera, "event camera")
                return capture, sorted(frames)
            recording = self._recording
            found = dict(recording.frames)
            if self.poses_path() is not None:
                # Poses may be estimated at more times than those of the given ones.
                found = dict(self.read_capture()[1]) | found
            return recording, sorted(found.items())

    @property
    def recording(self) -> Recording:
        """The recording, read once.

        Raises:
            DataError: a file is missing or its content cannot be used, or the lens is not known.
        """
        if self._recording.intrinsics_origin == "guessed":
            remedy = f"calibrate it, or have them estimated together with poses: {_ESTIMATE}"
            raise DataError(self.data, "the intrinsics of the event camera are not known", remedy)
        return self._recording

    @cached_property
    def _recording(self) -> Recording:
        try:
            with reading(self.data):
                if self._lacks_poses():
                    problem = "there are no such poses"
                    if getattr(self.config, "trajectory", None) is not None:
                        problem += ", which --trajectory needs as the true ones"
                    remedy = f"give them, or have them estimated: {_ESTIMATE}"
                    raise DataError(str(self.poses_path()), problem, remedy)
                recording = self.read_recording()
        except DataError as error:
            if self.guessed_format is None:
                raise
            hint = f"the format {self.guessed_format} was guessed: where it is another, name it, in aenerf as --format"
            raise DataError(error.source, error.problem, f"{error.remedy} ({hint})") from None
        if self.config.max_pose_gap_ns is not None:
            recording = replace(recording, max_pose_gap=self.config.max_pose_gap_ns)
        recording.event_file.drop_malformed = self.config.drop_malformed
        self._check_lens(recording.event_camera, "event camera")
        if any(recording.reference_views.values()):
            self._check_lens(recording.frame_camera, "camera of the images")
        return recording

    def _lacks_poses(self) -> bool:
        # Where the whole dataset is missing, its reader says so.
        path = self.poses_path()
        return path is not None and self.data.exists() and not path.exists()

    def scales_poses(self, recording: Recording) -> bool:
        """Return whether training scales the poses of a recording that this parser has read."""
        return bool(self.config.auto_scale_poses) or recording.scene_box is not None

    def _check_lens(self, camera: CameraIntrinsics, name: str) -> None:
        """Raise a DataError for a lens whose distortion cannot be inverted at any pixel."""
        if not camera.has_valid_pixels():
            problem = f"the {name} sees nothing: its distortion {list(camera.distortion)} can be inverted at no pixel"
            raise DataError(self.data, problem, "check the order and the model of its parameters")

    def _generate_dataparser_outputs(self, split: Split = "train", **kwargs: object) -> DataparserOutputs:
        recording = self.recording
        window = self.time_window
        refractory = recording.sensor.refractory_period
        if refractory >= window.end - window.start:
            problem = f"the refractory period of {refractory} ns is longer than the recording"
            raise DataError(self.data, problem, "give it in nanoseconds")
        cropped = recording.trajectory.crop(window.start, window.end)
        transform, scale, scene_box = self._world_transform(cropped, recording.scene_box)
        rotation, translation = transform.split((3, 1), -1)
        frame = Similarity(torch.tensor(scale, dtype=torch.float64), rotation, scale * translation[:, 0])

        def to_scene(poses: Tensor) -> Tensor:
            return frame(poses[:, :3] @ OPENCV_TO_OPENGL)

        trajectory = recording.trajectory.transform(to_scene).crop(window.start, window.end)
        ground_truth = recording.ground_truth
        if ground_truth is not None:
            ground_truth = ground_truth.transform(to_scene)
            trajectory.knots_covered_by(ground_truth)
        camera = recording.event_camera if split == "train" else recording.frame_camera
        if split == "train":
            times, images = viewer_cameras(trajectory, recording.reference_views["train"])
            cameras = camera.cameras(trajectory.interpolate(times))
            cameras.metadata[TRAJECTORY_SECONDS] = trajectory.seconds(times)[:, None]
        else:
            views = thin_views(views_within(recording.reference_views[split], window), recording.max_views)
            poses = torch.stack([v.camera_to_world for v in views]) if views else torch.zeros(0, 4, 4).double()
            poses = to_scene(poses)
            _check_distance(poses, trajectory if ground_truth is None else ground_truth)
            cameras = camera.cameras(poses)
            cameras.metadata[REFERENCE_SECONDS] = seconds_on_trajectory(views, trajectory)
            times, images = torch.zeros(0, dtype=torch.int64), {i: view.file for i, view in enumerate(views)}
        for file in images.values():
            check_image(file, recording.frame_camera)
        # Nerfstudio wants a file name for every camera, also for one without an image.
        names = [images.get(index, self.data / f"camera_{index:05d}") for index in range(len(cameras))]
        scene = SceneRecording(
            frame=frame,
            trajectory=trajectory,
            ground_truth=ground_truth,
            event_camera=recording.event_camera,
            event_file=recording.event_file,
            sensor=recording.sensor,
            window=window,
            camera=camera,
            camera_times=times,
            has_image=[index in images for index in range(len(cameras))],
            image_encoding=recording.image_encoding,
            bounded=recording.scene_box is not None,
            frames=_frames(recording, window) if split == "train" else (),
            is_whole=self.config.start_time_ns is None and self.config.end_time_ns is None,
        )
        return DataparserOutputs(
            image_filenames=names,
            cameras=cameras,
            scene_box=SceneBox(aabb=scene_box.float()),
            dataparser_transform=transform.float(),
            dataparser_scale=scale,
            alpha_color=None if recording.image_background is None else torch.tensor(recording.image_background),
            metadata={SCENE_KEY: scene},
        )

    @cached_property
    def time_window(self) -> TimeWindow:
        """The time that is used: what both events and poses cover, without the gaps of the poses.

        Raises:
            DataError: events and poses do not overlap.
        """
        recording, config = self.recording, self.config
        start, end = self.event_span(recording, config.start_time_ns, config.end_time_ns)
        if start == end and config.start_time_ns is None and config.end_time_ns is None:
            raise DataError(str(config.data), f"all its events are at {start} ns", "check the unit of the times")
        if start >= end:
            problem = f"nothing is left from {start} to {end} ns"
            raise DataError(str(config.data), problem, "widen the time window (--start-time-ns, --end-time-ns)")
        covered = recording.trajectory.crop(start, end)
        start, end = max(start, covered.start), min(end, covered.end)
        return TimeWindow(start, end, self._pose_gaps(recording, start, end))

    def event_span(self, recording: Recording, start: int | None, end: int | None) -> tuple[int, int]:
        """Return the times of the first and the last event of a recording that this parser has read, in nanoseconds.

        ``start`` and ``end`` stand in place of these. Where both are given, the events are not looked at.

        Raises:
            DataError: the events are missing, or fit the poses only if the times of either have another unit.
        """
        if start is not None and end is not None:
            return start, end
        options = [name for name in ("event_time_unit", "time_unit") if hasattr(self.config, name)]
        first, last = require_one_unit(recording.event_file, recording.trajectory, *options or ("",))
        return first if start is None else start, last if end is None else end

    def resolved_config(self) -> EventDataParserConfig:
        """Return the configuration with the time window that is used, so that opening a trained run needs no events."""
        return replace(self.config, start_time_ns=self.time_window.start, end_time_ns=self.time_window.end)

    def _pose_gaps(self, recording: Recording, start: int, end: int) -> tuple[tuple[int, int], ...]:
        """Return where within the time window the poses are too far apart for interpolation."""
        longest = recording.max_pose_gap
        gaps = [gap for gap in recording.trajectory.known_time(longest).gaps if gap[0] < end and gap[1] > start]
        if longest is not None and gaps:
            seconds = sum(last - first for first, last in gaps) * 1e-9
            first, last = max(gaps, key=lambda gap: gap[1] - gap[0])
            CONSOLE.print(
                f"The poses have {len(gaps)} gap(s) of more than {longest * 1e-9:g} s, {seconds:.1f} s in all, the "
                f"longest from {first * 1e-9:.3f} to {last * 1e-9:.3f} s: what happened there is left out."
            )
        return tuple(gaps)

    def _world_transform(self, trajectory: Trajectory, box: Tensor | None) -> tuple[Tensor, float, Tensor]:
        """Return the (3, 4) motion and the scale after it that bring the world to the scene's frame, and the scene box.

        They may depend on the estimated trajectory and the stated box only, never on a true pose. The box is
        (2, 3), in the scene's frame.
        """
        poses = homogeneous(trajectory.camera_to_worlds) @ OPENCV_TO_OPENGL
        if box is not None:
            center, half = (box[0] + box[1]) / 2, (box[1] - box[0]) / 2
            if not (half > _MIN_BOX).all() or not (box.abs() < _MAX_BOX).all():
                remedy = f"give a box that holds the scene, with sides of {_MIN_BOX:g} to {_MAX_BOX:g}"
                raise DataError(self.data, f"the scene box has the corners {box.tolist()}", remedy)
            transform = torch.cat([torch.eye(3, dtype=torch.float64), -center[:, None]], -1)
            scale = self.config.scale_factor / float(half.max())
            return transform, scale, torch.stack([-half, half]) * scale
        # The framework takes float32, which rounds positions far from the origin, such as those of a map.
        center = poses[:, :3, 3].mean(0) * (self.config.center_method != "none")
        poses[:, :3, 3] -= center
        try:
            oriented, transform = auto_orient_and_center_poses(
                poses.float(), method=self.config.orientation_method, center_method=self.config.center_method
            )
        except torch.linalg.LinAlgError as error:
            problem = "all cameras look in one direction and have no focus"
            raise DataError(trajectory.source, problem, "give --center-method poses") from error
        transform = transform.double()
        transform[:, 3] -= transform[:, :3] @ center
        scale = self.config.scale_factor
        if self.config.auto_scale_poses:
            extent = float(oriented[:, :3, 3].abs().max())
            if extent < 1e-6:
                problem = f"the camera moves by no more than {extent:.2g}, which gives the scene no scale"
                remedy = "record with a moving camera, or give --auto-scale-poses False"
                raise DataError(trajectory.source, problem, remedy)
            scale /= extent
        return transform, scale, torch.tensor([[-1.0] * 3, [1.0] * 3])


def _frames(recording: Recording, window: TimeWindow) -> tuple[tuple[int, Path], ...]:
    """Return times and files of the training images that were taken in a time window, by the event camera."""
    if not recording.has_own_frames:
        return ()
    views = recording.reference_views["train"]
    return tuple((view.time, view.file) for view in views if view.time is not None and window.contains(view.time))


def _check_distance(poses: Tensor, reference: Trajectory) -> None:
    """Raise a DataError for reference views that single precision would displace."""
    positions = reference.camera_to_worlds[..., 3]
    extent = float((positions - positions.mean(0)).norm(dim=-1).max())
    distance = float(poses[..., 3].abs().max()) if len(poses) else 0.0
    if distance > _MAX_REFERENCE_DISTANCE * extent > 0:
        raise DataError(
            reference.source,
            f"a reference view is {distance / extent:.3g} times as far from the estimated poses as these poses extend",
            "subtract one offset from the positions of these poses and of the reference views",
        )
