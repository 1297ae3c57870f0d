"""``aenerf simulate``: make a dataset of a built-in scene, of a mesh or of a video."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.noise import perturb
from aenerf_ns.camera.trajectory import Trajectory, homogeneous
from aenerf_ns.cli.arguments import SimulateArguments
from aenerf_ns.cli.dataset_format import training_command
from aenerf_ns.cli.termination import ended_by_exception
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel, require_event_sensor_size
from aenerf_ns.files.calibration import read_calibration
from aenerf_ns.files.tum_trajectory import read_tum_trajectory
from aenerf_ns.poses_from_frames.structure_from_motion import estimate_poses
from aenerf_ns.poses_from_frames.video import Video, open_video
from aenerf_ns.recording.output_lock import OutputLock
from aenerf_ns.recording.recording import Split
from aenerf_ns.recording.views import evenly_spread
from aenerf_ns.recording.writer import NativeDatasetWriter, PoselessRecordingWriter
from aenerf_ns.simulator.open_scene import open_scene
from aenerf_ns.simulator.simulated_poses import poses_from_frames
from aenerf_ns.simulator.simulation import Simulation
from aenerf_ns.simulator.video_events import VideoInterval, video_events

_FRAME_RATE = 25.0


@dataclass
class Simulate(SimulateArguments):
    __doc__ = SimulateArguments.__doc__

    def main(self) -> None:
        """Render the scene along its path, or read the video, and write the dataset."""
        self.judge()
        with ended_by_exception(), OutputLock(self.output) as lock:
            if self.video is None:
                self._simulate_scene(lock)
            else:
                self._simulate_video(self.video, lock)

    def _simulate_scene(self, lock: OutputLock) -> None:
        scene = open_scene(self.scene, self.seed)
        duration = scene.duration if self.duration is None else self.duration
        self.require_poses(duration)
        for note in scene.notes:
            CONSOLE.print(note, highlight=False, markup=False)
        held_out: dict[Split, torch.Tensor] = {
            "val": torch.from_numpy(scene.validation_views(self.validation_views)),
            "test": torch.from_numpy(scene.test_views(self.test_views, self.seed)),
        }
        try:
            camera = CameraIntrinsics(self.width, self.height, *scene.intrinsics(self.width, self.height))
            sensor = self.sensor()
            simulation = Simulation(
                scene,
                camera,
                sensor,
                self.speed,
                duration,
                self.max_displacement,
                self.seed,
                self.noise,
            )
            truth = simulation.trajectory(self.pose_rate)
            estimated, report = self._estimate(simulation, camera, truth)
        except DataError:
            raise
        except ValueError as error:
            raise DataError("aenerf simulate", str(error), "see aenerf simulate --help") from error
        num_events = 0
        with NativeDatasetWriter(lock, camera, sensor, "srgb", scene.aabb) as writer:
            writer.add_trajectories(estimated, truth)
            if report is not None:
                writer.add_poses_report(report)
            for events in simulation.events():
                writer.events.append(events)
                num_events += len(events)
            for time in np.linspace(estimated.start, estimated.end, self.train_images, dtype=np.int64).tolist():
                # The picture is taken from the true pose. The dataset stores the estimated pose beside it.
                pose = homogeneous(estimated.interpolate(time))
                seen = simulation.reference_picture(simulation.pose(time))
                writer.add_image("train", seen.display, pose, time, linear=seen.linear, depth=seen.depth)
            for split, poses in held_out.items():
                for pose in poses:
                    seen = simulation.reference_picture(pose)
                    writer.add_image(split, seen.display, pose, linear=seen.linear, depth=seen.depth)
        CONSOLE.print(
            f"{self.output}: {num_events:,} events in {truth.duration:.2f} s, {len(estimated)} poses, "
            f"{self.train_images} train, {self.validation_views} validation and {self.test_views} test images.\n"
            f"Train with: {training_command(self.output)}",
            highlight=False,
            soft_wrap=True,
        )

    def _estimate(
        self, simulation: Simulation, camera: CameraIntrinsics, truth: Trajectory
    ) -> tuple[Trajectory, dict[str, Any] | None]:
        """Return the estimated trajectory and, if COLMAP estimated it, COLMAP's report."""
        noise = (self.pose_noise_degrees, self.pose_noise_translation)
        if self.poses == "noise":
            return perturb(truth, *noise, self.pose_noise_correlation_time, self.seed), None
        estimated, report, summary = poses_from_frames(
            simulation,
            camera,
            truth,
            _FRAME_RATE if self.frame_rate is None else self.frame_rate,
            self.exposure,
            self.seed,
        )
        CONSOLE.print(summary)
        return estimated, report

    def _simulate_video(self, source: Path, lock: OutputLock) -> None:
        video = open_video(source, self.frame_rate)
        require_event_sensor_size(video.width, video.height, source, "scale the frames down")
        camera = self._video_camera(video)
        try:
            sensor = self.sensor()
            poses = self._video_poses(video, camera)
            intervals = video_events(video, sensor, self.noise, self.interpolation, self.max_displacement, self.seed)
            if poses is None:
                written = self._write_events(lock, video, camera, sensor, intervals)
            else:
                written = self._write_dataset(lock, video, sensor, poses, intervals)
        except DataError:
            raise
        except ValueError as error:
            raise DataError("aenerf simulate", str(error), "see aenerf simulate --help") from error
        longest = np.diff(video.times).max() * 1e-6
        CONSOLE.print(
            f"{written}\nEvents between two frames, up to {longest:.3g} ms apart, are interpolated. What moves faster "
            "than the frames follow, what blur smears, and what is clipped to white or black in the video is lost.",
            highlight=False,
            soft_wrap=True,
        )

    def _video_camera(self, video: Video) -> CameraIntrinsics | None:
        """Return the lens of the video's camera, or None where no option states it."""
        if self.calibration is not None:
            camera = read_calibration(self.calibration, self.event_camera).event_camera
            if (camera.width, camera.height) != (video.width, video.height):
                raise DataError(
                    self.calibration,
                    f"its camera has {camera.width} x {camera.height} pixels, the frames of {video.source} "
                    f"{video.width} x {video.height}",
                    "give the calibration of the frames as they are",
                )
            return camera
        if self.intrinsics is not None:
            try:
                return CameraIntrinsics(video.width, video.height, *self.intrinsics)
            except ValueError as error:
                raise DataError("aenerf simulate", f"--intrinsics: {error}", "give fl_x fl_y cx cy in pixels") from None
        return None

    def _video_poses(self, video: Video, camera: CameraIntrinsics | None) -> _VideoPoses | None:
        """Return where the video's camera was, or None where no option tells."""
        noise = (self.pose_noise_degrees, self.pose_noise_translation)
        if self.trajectory is not None:
            assert camera is not None
            given = read_tum_trajectory(self.trajectory)
            given.crop(int(video.times[0]), int(video.times[-1]))
            if not any(noise):
                return _VideoPoses(camera, given)
            return _VideoPoses(camera, perturb(given, *noise, self.pose_noise_correlation_time, self.seed), given)
        if self.poses == "colmap":
            lens = (video.width, video.height) if camera is None else camera
            found = estimate_poses(video, video.times, lens, video.source, self.seed)
            CONSOLE.print(found.summary(), highlight=False, soft_wrap=True)
            if camera is None:
                CONSOLE.print(
                    f"COLMAP estimates the lens: focal length {found.camera.fx:.1f} pixels, radial distortion "
                    f"{found.camera.distortion[0]:.3g}.",
                    highlight=False,
                    soft_wrap=True,
                )
            return _VideoPoses(found.camera, found.trajectory, report=found.report())
        return None

    def _write_dataset(
        self,
        lock: OutputLock,
        video: Video,
        sensor: SensorModel,
        poses: _VideoPoses,
        intervals: Iterable[VideoInterval],
    ) -> str:
        """Write a dataset folder, and return a line about it."""
        reference = poses.estimated if poses.truth is None else poses.truth
        # The first frame lies before all events.
        taken = [time for time in video.times[1:].tolist() if reference.start <= time <= reference.end]
        chosen: dict[Split, list[int]] = {
            "train": evenly_spread(taken, self.train_images),
            "val": evenly_spread(taken[::2], self.validation_views),
            "test": evenly_spread(taken[1::2], self.test_views),
        }
        with NativeDatasetWriter(lock, poses.camera, sensor, "srgb") as writer:
            writer.add_trajectories(poses.estimated, poses.truth)
            if poses.report is not None:
                writer.add_poses_report(poses.report)
            num_events = 0
            for frame, time, events in intervals:
                writer.events.append(events)
                num_events += len(events)
                for split, times in chosen.items():
                    if time in times:
                        writer.add_image(split, frame, homogeneous(reference.interpolate(time)), time)
            _require_events(num_events, video)
        counts = ", ".join(f"{len(times)} {split}" for split, times in chosen.items())
        return (
            f"{self.output}: {num_events:,} events of {len(video.times)} frames, {len(poses.estimated)} poses, images: "
            f"{counts}.\nTrain with: {training_command(self.output)}"
        )

    def _write_events(
        self,
        lock: OutputLock,
        video: Video,
        camera: CameraIntrinsics | None,
        sensor: SensorModel,
        intervals: Iterable[VideoInterval],
    ) -> str:
        """Write the events and images of a video without poses, and return a line about them."""
        kept = evenly_spread(video.times.tolist(), self.train_images + self.validation_views + self.test_views)
        with PoselessRecordingWriter(lock, camera, sensor) as writer:
            num_events = 0
            for frame, time, events in intervals:
                writer.events.append(events)
                num_events += len(events)
                if time in kept:
                    writer.add_image(frame, time)
            _require_events(num_events, video)
        missing = "trajectory.txt" if camera is not None else "calibration.json and trajectory.txt"
        return (
            f"{self.output}: {num_events:,} events of {len(video.times)} frames, {len(kept)} images, no poses.\n"
            f"To train on them, add {missing} (docs/datasets/own_recording.md)."
        )


@dataclass(frozen=True)
class _VideoPoses:
    """The lens and the poses of a video's camera, the true poses if others are estimated, and COLMAP's report."""

    camera: CameraIntrinsics
    estimated: Trajectory
    truth: Trajectory | None = None
    report: dict[str, Any] | None = None


def _require_events(num_events: int, video: Video) -> None:
    if num_events == 0:
        raise DataError(video.source, "no pixel changes by a contrast threshold", "give a video of a moving camera")
