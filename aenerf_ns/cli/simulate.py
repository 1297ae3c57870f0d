"""``aenerf simulate``: make a dataset of a built-in scene or of a mesh."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.camera.lens import EventCamera
from aenerf_ns.camera.noise import perturb
from aenerf_ns.camera.trajectory import Trajectory, homogeneous
from aenerf_ns.cli.dataset_format import training_command
from aenerf_ns.cli.termination import ended_by_exception
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import BayerPattern, SensorModel
from aenerf_ns.recording.output_lock import OutputLock
from aenerf_ns.recording.recording import Split
from aenerf_ns.recording.writer import NativeDatasetWriter
from aenerf_ns.simulator.esim import SensorNoise
from aenerf_ns.simulator.open_scene import open_scene
from aenerf_ns.simulator.simulated_poses import poses_from_frames
from aenerf_ns.simulator.simulation import Simulation


@dataclass
class Simulate:
    """Simulate an event camera that moves through a scene, and write a dataset for ns-train aenerf."""

    output: Path
    """Dataset folder to create."""
    scene: str = "room"
    """room: a furnished room seen from inside. object: a toy locomotive seen from around it. shiny_object: the
    same, varnished and polished. A .glb, .obj or .ply file: a mesh seen from around it. A .json file: a mesh, its light
    and the camera's path (docs/simulator.md)."""
    speed: Literal["easy", "hard"] = "easy"
    """easy: constant speed. hard: the same path at 8^sin(2 pi t) times that speed."""
    width: int = 346
    """Pixel columns of the sensor."""
    height: int = 260
    """Pixel rows of the sensor."""
    duration: float | None = None
    """Seconds that the path takes at constant speed. Default: the duration in scene.json, or 4."""
    pose_rate: float = 250.0
    """Poses a second in the trajectories; with --poses colmap, in the true trajectory."""
    poses: Literal["noise", "colmap"] = "noise"
    """Source of the estimated poses. noise: the true poses with noise. colmap: COLMAP estimates a pose for each frame
    of a camera at the event sensor's place, as in a DAVIS, and may lose or misplace frames."""
    frame_rate: float = 25.0
    """Frames a second for COLMAP."""
    exposure: float = 0.003
    """Seconds for which a frame is exposed. Motion blurs the frame meanwhile."""
    pose_noise_degrees: float = 0.0
    """Error of the estimated rotations: root mean square of its angle, in degrees."""
    pose_noise_translation: float = 0.0
    """Error of the estimated positions: root mean square of its length, in scene units (metres)."""
    pose_noise_correlation_time: float = 0.25
    """Correlation time of the pose errors in seconds."""
    positive_contrast_threshold: float = 0.25
    """C+: rise of log-radiance that triggers an event."""
    negative_contrast_threshold: float = 0.25
    """C-: fall of log-radiance that triggers an event."""
    refractory_period_ns: int = 0
    """Time for which a pixel is blind after each event, in nanoseconds."""
    noise: tyro.conf.OmitArgPrefixes[SensorNoise] = field(default_factory=SensorNoise)
    bayer_pattern: BayerPattern = ""
    """RGGB for a colour sensor."""
    max_displacement: float = 0.5
    """Pixels that 99 % of the picture may move between two rendered frames."""
    train_images: int = 50
    """Reference images along the trajectory. They are not used for training."""
    validation_views: int = 20
    """Reference views around the trajectory, for colour correction."""
    test_views: int = 20
    """Reference views from other places, for evaluation."""
    seed: int = 0
    """Seed of everything random: the scene, the sensor, the pose noise and the test views."""

    def main(self) -> None:
        """Render the scene along its path and write the dataset."""
        with ended_by_exception(), OutputLock(self.output) as lock:
            self._simulate(lock)

    def _simulate(self, lock: OutputLock) -> None:
        counts = (self.train_images, self.validation_views, self.test_views)
        if min(counts) < 0:
            raise DataError("aenerf simulate", f"numbers of images {counts}", "they must not be negative")
        scene = open_scene(self.scene, self.seed)
        for note in scene.notes:
            CONSOLE.print(note, highlight=False, markup=False)
        held_out: dict[Split, torch.Tensor] = {
            "val": torch.from_numpy(scene.validation_views(self.validation_views)),
            "test": torch.from_numpy(scene.test_views(self.test_views, self.seed)),
        }
        try:
            camera = EventCamera(self.width, self.height, *scene.intrinsics(self.width, self.height))
            sensor = SensorModel(
                self.positive_contrast_threshold,
                self.negative_contrast_threshold,
                self.refractory_period_ns,
                self.bayer_pattern,
            )
            simulation = Simulation(
                scene,
                camera,
                sensor,
                self.speed,
                scene.duration if self.duration is None else self.duration,
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
            f"Train with: {training_command(self.output)}"
        )

    def _estimate(
        self, simulation: Simulation, camera: EventCamera, truth: Trajectory
    ) -> tuple[Trajectory, dict[str, Any] | None]:
        """Return the estimated trajectory and, if COLMAP estimated it, COLMAP's report."""
        noise = (self.pose_noise_degrees, self.pose_noise_translation)
        if self.poses == "noise":
            return perturb(truth, *noise, self.pose_noise_correlation_time, self.seed), None
        if any(noise):
            raise DataError(
                "aenerf simulate",
                f"pose noise {noise} with --poses colmap",
                "leave the pose noise out, because COLMAP makes errors of its own",
            )
        estimated, report, summary = poses_from_frames(
            simulation, camera, truth, self.frame_rate, self.exposure, self.seed
        )
        CONSOLE.print(summary)
        return estimated, report
