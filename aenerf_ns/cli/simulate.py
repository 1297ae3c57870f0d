"""``aenerf simulate``: a dataset of a built-in scene, a mesh or a scene of Blender."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from aenerf_ns.cli.console import say
from aenerf_ns.cli.dataset import training_command
from aenerf_ns.cli.simulation import SimulationCommand
from aenerf_ns.cli.termination import exclusive_output
from aenerf_ns.errors import DataError, value_errors_as_data_error
from aenerf_ns.events.sensor import SensorModel, require_event_sensor_size
from aenerf_ns.files.limits import MAX_ROWS
from aenerf_ns.simulator.options import BUILT_IN, SensorNoise, require_scene_file

if TYPE_CHECKING:
    from aenerf_ns.recording.output_lock import OutputLock


@dataclass
class Simulate(SimulationCommand):
    """Simulate an event camera that moves through a scene, and write a dataset for ns-train aenerf."""

    scene: str = "room"
    """room: a furnished room seen from inside. object: a toy locomotive seen from around it. shiny_object: the
    same, varnished and polished. A .glb, .obj or .ply file: a mesh seen from around it. A .blend file: a scene of
    Blender, seen by its own camera if that moves. A .json file: one of these files, its light and the camera's path
    (docs/simulator.md)."""
    speed: Literal["easy", "hard"] = "easy"
    """easy: constant speed. hard: the same path at 8^sin(2 pi t) times that speed."""
    width: int = 346
    """Pixel columns of the sensor."""
    height: int = 260
    """Pixel rows of the sensor."""
    duration: float | None = None
    """Seconds that the path takes at constant speed. Default: that of the scene's file, or 4."""
    pose_rate: float = 250.0
    """Poses a second in the trajectories; with --poses colmap, in the true trajectory."""
    poses: Literal["noise", "colmap"] = "noise"
    """Source of the estimated poses. noise: the true poses with noise. colmap: COLMAP estimates a pose for each frame
    of a camera at the position of the event sensor, as in a DAVIS, and may lose or misplace frames."""
    frame_rate: float = 25.0
    """Frames a second for COLMAP."""
    exposure: float = 0.003
    """Seconds for which a frame is exposed. Motion blurs the frame meanwhile."""

    def main(self) -> None:
        """Render the scene along its path and write the dataset."""
        self.require_possible()
        require_event_sensor_size(self.width, self.height, "aenerf simulate")
        if self.duration is not None:
            self._require_poses(self.duration)
        if self.poses == "colmap" and any(self.pose_noise):
            remedy = "leave the pose noise out, because COLMAP makes errors of its own"
            raise DataError("aenerf simulate", f"pose noise {self.pose_noise} with --poses colmap", remedy)
        if self.scene not in BUILT_IN:
            require_scene_file(Path(self.scene))
        sensor, noise = self.make_sensor()
        with exclusive_output(self.output) as lock:
            self._simulate(sensor, noise, lock)

    def _require_poses(self, duration: float) -> None:
        """Raise a DataError if the trajectories of a duration in seconds have one pose, or more than readers take."""
        from aenerf_ns.simulator.paths import SpeedProfile

        num_poses = self.pose_rate * SpeedProfile(self.speed, duration).duration
        # The last pose is at the end, and one that is closer to it than half an interval is left out.
        if num_poses <= 0.5:
            raise DataError("--pose-rate", f"{self.pose_rate:g} a second gives one pose", "give a higher rate")
        if num_poses > MAX_ROWS:
            raise DataError("--pose-rate", f"it gives {num_poses:.3g} poses", "give a lower rate or --duration")

    def _simulate(self, sensor: SensorModel, noise: SensorNoise, lock: OutputLock) -> None:
        import numpy as np
        import torch

        from aenerf_ns.camera.intrinsics import CameraIntrinsics
        from aenerf_ns.recording.recording import Split
        from aenerf_ns.recording.writer import NativeDatasetWriter
        from aenerf_ns.simulator.open_scene import open_scene
        from aenerf_ns.simulator.simulation import Simulation

        scene = open_scene(self.scene, self.seed)
        duration = scene.duration if self.duration is None else self.duration
        self._require_poses(duration)
        for note in scene.notes:
            say(note)
        held_out: dict[Split, torch.Tensor] = {
            "val": torch.from_numpy(scene.path.validation_views(self.validation_views)),
            "test": torch.from_numpy(scene.path.test_views(self.test_views, self.seed)),
        }
        with value_errors_as_data_error("aenerf simulate", "see aenerf simulate --help"):
            camera = CameraIntrinsics(self.width, self.height, *scene.intrinsics(self.width, self.height))
            simulation = Simulation(
                scene, camera, sensor, self.speed, duration, self.max_displacement, self.seed, noise
            )
            truth = simulation.trajectory(self.pose_rate)
            report: dict[str, Any] | None = None
            if self.poses == "noise":
                estimated = self.add_pose_noise(truth)
            else:
                estimated, report, summary = simulation.estimate_poses(truth, self.frame_rate, self.exposure, self.seed)
                say(summary)
        with NativeDatasetWriter(lock, camera, sensor, "srgb", scene.aabb) as writer:
            writer.add_trajectories(estimated, truth)
            simulator = simulation.simulator
            writer.add_contrast_thresholds(simulator.positive_contrast_threshold, simulator.negative_contrast_threshold)
            if report is not None:
                writer.add_poses_report(report)
            for events in simulation.events():
                writer.events.append(events)
            writer.sensor = simulator.recorded_sensor()
            if writer.events.num_events == 0:
                remedy = "give lower thresholds, or a scene with more contrast"
                raise DataError(self.scene, "no pixel changes by a contrast threshold", remedy)
            times = np.linspace(estimated.start, estimated.end, self.train_images, dtype=np.int64).tolist()
            views: list[tuple[Split, torch.Tensor, int | None]] = [("train", simulation.pose(t), t) for t in times]
            views += [(split, pose, None) for split, poses in held_out.items() for pose in poses]
            for split, pose, time in views:
                seen = simulation.reference_picture(pose)
                writer.add_image(split, seen.display, pose, time, linear=seen.linear, depth=seen.depth)
        if simulator.num_lost_events:
            say(simulator.readout_note())
        say(
            f"{self.output}: {writer.events.num_events:,} events in {truth.duration:.2f} s, {len(estimated)} poses, "
            f"{self.train_images} train, {self.validation_views} validation and {self.test_views} test images.\n"
            f"Train with: {training_command(self.output)}"
        )
