"""``aenerf simulate-video``: the events of a video's camera, as a dataset or as a recording without poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from aenerf_ns.cli.console import say
from aenerf_ns.cli.dataset import say_scene_box, training_command
from aenerf_ns.cli.four_words import four_words
from aenerf_ns.cli.simulation import SimulationCommand
from aenerf_ns.cli.termination import exclusive_output
from aenerf_ns.errors import DataError, reading, require_file, value_errors_as_data_error
from aenerf_ns.events.sensor import SensorModel, require_event_sensor_size
from aenerf_ns.simulator.options import Interpolation, SensorNoise

if TYPE_CHECKING:
    from torch import Tensor

    from aenerf_ns.camera.intrinsics import CameraIntrinsics
    from aenerf_ns.camera.trajectory import Trajectory
    from aenerf_ns.pose_estimation.video import Video
    from aenerf_ns.recording.output_lock import OutputLock
    from aenerf_ns.recording.writer import NativeDatasetWriter, PoselessRecordingWriter
    from aenerf_ns.simulator.esim import EventSimulator
    from aenerf_ns.simulator.video_events import VideoInterval

_COMMAND = "aenerf simulate-video"


@dataclass
class SimulateVideo(SimulationCommand):
    """Simulate an event camera in place of the camera of a video, and write a dataset for ns-train aenerf. Only events
    and images are written without --trajectory and without --poses colmap."""

    video: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="VIDEO")]
    """The video: a file, or a folder of images with the list images.txt of their times (on each line: t[s] file)."""
    interpolation: Interpolation = "flow"
    """How the log-radiance changes between two frames of the video. flow: it moves along optical flow. linear: each
    pixel changes linearly in time. linear is faster, but wrong where the picture moves by pixels between frames."""
    poses: Literal["given", "colmap"] = "given"
    """given: the poses of --trajectory, or none. colmap: COLMAP estimates a pose for each frame, and may lose or
    misplace frames."""
    trajectory: Path | None = None
    """Poses of the video's camera, as t tx ty tz qx qy qz qw in seconds on the clock of the video, camera-to-world,
    OpenCV camera axes. Needs the camera's intrinsics."""
    intrinsics: Annotated[tuple[float, float, float, float] | None, four_words(float, "FL_X FL_Y CX CY")] = None
    """Intrinsics of the video's camera without distortion, in pixels. CX and CY count from the edge of the
    image."""
    calibration: Path | None = None
    """The video's camera: calibration.json, or the camchain.yaml that Kalibr writes. Without this option and without
    --intrinsics, --poses colmap estimates the lens."""
    event_camera: str | None = None
    """Name of the video's camera in a camchain of several cameras, such as cam1."""
    frame_rate: float | None = None
    """The rate at which the camera took the frames, in place of the times that the video states, as for slow motion."""

    def main(self) -> None:
        """Read the video and write the dataset."""
        self.require_possible()
        self._require_compatible()
        sensor, noise = self.make_sensor()
        with reading(self.video):
            if not self.video.exists():
                raise DataError(self.video, "there is no such video", "give a file, or a folder of images")
        for file in (self.trajectory, self.calibration):
            if file is not None:
                require_file(file, "check its name")
        with exclusive_output(self.output) as lock, value_errors_as_data_error(_COMMAND, f"see {_COMMAND} --help"):
            self._simulate(sensor, noise, lock)

    def _require_compatible(self) -> None:
        """Raise a DataError for options that contradict each other."""
        if self.calibration is not None and self.intrinsics is not None:
            raise DataError(_COMMAND, "--calibration and --intrinsics are both given", "leave out one of them")
        if self.event_camera is not None and self.calibration is None:
            raise DataError(_COMMAND, "--event-camera without --calibration", "give the camchain that has the camera")
        if any(self.pose_noise) and self.poses == "colmap":
            remedy = "leave the pose noise out, because COLMAP makes errors of its own"
            raise DataError(_COMMAND, f"pose noise {self.pose_noise} with --poses colmap", remedy)
        if any(self.pose_noise) and self.trajectory is None:
            raise DataError(_COMMAND, f"pose noise {self.pose_noise} without poses to add it to", "give --trajectory")
        if self.trajectory is not None:
            if self.poses == "colmap":
                raise DataError(_COMMAND, "--trajectory with --poses colmap", "leave out one of them")
            if self.calibration is None and self.intrinsics is None:
                remedy = "give --calibration or --intrinsics, or let COLMAP estimate lens and poses with --poses colmap"
                raise DataError(_COMMAND, "--trajectory without the intrinsics of the camera", remedy)

    def _simulate(self, sensor: SensorModel, noise: SensorNoise, lock: OutputLock) -> None:
        import numpy as np

        from aenerf_ns.pose_estimation.video import open_video
        from aenerf_ns.simulator.video_events import video_simulator

        video = open_video(self.video, self.frame_rate)
        require_event_sensor_size(video.width, video.height, self.video, "scale the frames down")
        camera = self._read_camera(video)
        poses = self._find_poses(video, camera)
        simulator = video_simulator(video, sensor, noise, self.seed)
        if poses is None:
            written = self._write_poseless(lock, video, camera, simulator)
        else:
            written = self._write_dataset(lock, video, simulator, poses)
        if simulator.num_lost_events:
            say(simulator.readout_note())
        longest = np.diff(video.times).max() * 1e-6
        say(
            f"{written}\nEvents between two frames, up to {longest:.3g} ms apart, are interpolated. What moves faster "
            "than the frames follow, what blur smears, and what is clipped to white or black in the video is lost."
        )

    def _read_camera(self, video: Video) -> CameraIntrinsics | None:
        """Read the lens of the video's camera, or return None where no option states it."""
        from aenerf_ns.camera.intrinsics import CameraIntrinsics
        from aenerf_ns.files.calibration import read_calibration

        if self.calibration is not None:
            calibration = read_calibration(self.calibration, self.event_camera)
            if calibration.intrinsics_origin == "guessed":
                remedy = "state them, or leave --calibration out and estimate them with --poses colmap"
                raise DataError(self.calibration, "it states no focal lengths and no principal point", remedy)
            camera = calibration.event_camera
            if (camera.width, camera.height) != (video.width, video.height):
                size = f"{camera.width} x {camera.height}"
                problem = f"its camera has {size} pixels, the frames of {video.source} {video.width} x {video.height}"
                raise DataError(self.calibration, problem, "give the calibration of the frames as they are")
            return camera
        if self.intrinsics is not None:
            with value_errors_as_data_error("--intrinsics", "give fl_x fl_y cx cy in pixels"):
                return CameraIntrinsics(video.width, video.height, *self.intrinsics)
        return None

    def _find_poses(self, video: Video, camera: CameraIntrinsics | None) -> _VideoPoses | None:
        """Read or estimate the poses of the video's camera, or return None where no option asks for them."""
        from aenerf_ns.files.tum_trajectory import read_tum_trajectory
        from aenerf_ns.pose_estimation.from_frames import estimate_poses

        if self.trajectory is not None:
            assert camera is not None
            given = read_tum_trajectory(self.trajectory)
            given.crop(int(video.times[0]), int(video.times[-1]))
            return _VideoPoses(camera, self.add_pose_noise(given), given if any(self.pose_noise) else None)
        if self.poses == "colmap":
            lens = (video.width, video.height) if camera is None else camera
            found = estimate_poses(video, video.times, lens, video.source, self.seed)
            say(found.summary())
            report = found.report()
            if camera is None:
                report["intrinsics"] = found.camera.to_transforms()
                say(f"The intrinsics were estimated with the poses: {found.camera.summary()}.")
            say_scene_box(found.scene_box)
            return _VideoPoses(found.camera, found.trajectory, None, report, found.scene_box, camera is None)
        return None

    def _write_dataset(self, lock: OutputLock, video: Video, simulator: EventSimulator, poses: _VideoPoses) -> str:
        """Write a dataset folder, and describe it in one line."""
        from aenerf_ns.recording.recording import Split
        from aenerf_ns.recording.views import spread_evenly
        from aenerf_ns.recording.writer import NativeDatasetWriter

        reference = poses.estimated if poses.truth is None else poses.truth
        # The first frame lies before all events.
        taken = video.times[1:][reference.time_without_gaps().contains(video.times[1:])].tolist()
        chosen: dict[Split, list[int]] = {
            "train": spread_evenly(taken, self.train_images),
            "val": spread_evenly(taken[::2], self.validation_views),
            "test": spread_evenly(taken[1::2], self.test_views),
        }
        sensor = simulator.sensor
        with NativeDatasetWriter(
            lock, poses.camera, sensor, "srgb", poses.scene_box, has_estimated_intrinsics=poses.has_estimated_lens
        ) as writer:
            writer.add_trajectories(poses.estimated, poses.truth)
            if poses.report is not None:
                writer.add_poses_report(poses.report)
            for frame, time, _ in self._write_events(writer, video, simulator):
                for split, times in chosen.items():
                    if time in times:
                        writer.add_image(split, frame, reference.interpolate(time), time)
        counts = ", ".join(f"{len(times)} {split}" for split, times in chosen.items())
        return (
            f"{self.output}: {writer.events.num_events:,} events of {len(video.times)} frames, "
            f"{len(poses.estimated)} poses, images: {counts}.\nTrain with: {training_command(self.output)}"
        )

    def _write_poseless(
        self, lock: OutputLock, video: Video, camera: CameraIntrinsics | None, simulator: EventSimulator
    ) -> str:
        """Write the events and images of a video without poses, and describe them in one line."""
        from aenerf_ns.recording.views import spread_evenly
        from aenerf_ns.recording.writer import PoselessRecordingWriter

        kept = spread_evenly(video.times.tolist(), self.train_images + self.validation_views + self.test_views)
        with PoselessRecordingWriter(lock, camera, simulator.sensor) as writer:
            for frame, time, _ in self._write_events(writer, video, simulator):
                if time in kept:
                    writer.add_image(frame, time)
        missing = ""
        if camera is None:
            stated = f'"bandwidth_hz": {writer.sensor.bandwidth:.4g}, thresholds and refractory period of this command'
            if writer.sensor.bayer_pattern:
                stated = f'"bayer_pattern": "{writer.sensor.bayer_pattern}", {stated}'
            missing = f'calibration.json (with "image_encoding": "srgb", {stated}) and '
        return (
            f"{self.output}: {writer.events.num_events:,} events of {len(video.times)} frames, {len(kept)} images, "
            f"no poses.\nTo train on them, add {missing}trajectory.txt (docs/your_data.md)."
        )

    def _write_events(
        self, writer: NativeDatasetWriter | PoselessRecordingWriter, video: Video, simulator: EventSimulator
    ) -> Iterator[VideoInterval]:
        """Write the events of a video, and yield its frames with their events."""
        from aenerf_ns.simulator.video_events import video_events

        writer.add_contrast_thresholds(simulator.positive_contrast_threshold, simulator.negative_contrast_threshold)
        for interval in video_events(video, simulator, self.interpolation, self.max_displacement):
            writer.events.append(interval.events)
            yield interval
        writer.sensor = simulator.recorded_sensor()
        if writer.events.num_events == 0:
            raise DataError(video.source, "no pixel changes by a contrast threshold", "give a video of a moving camera")


@dataclass(frozen=True)
class _VideoPoses:
    """The lens and the poses of a video's camera, the true poses if others are estimated, and what COLMAP found."""

    camera: CameraIntrinsics
    estimated: Trajectory
    truth: Trajectory | None = None
    report: dict[str, Any] | None = None
    scene_box: Tensor | None = None
    has_estimated_lens: bool = False
