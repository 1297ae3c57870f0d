"""``aenerf simulate``: a dataset of a built-in scene or of a mesh."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.dataparsers.native_writer import NativeDatasetWriter
from aenerf_ns.errors import DataError
from aenerf_ns.event_camera import EventCamera
from aenerf_ns.events.sensor import BayerPattern, SensorModel
from aenerf_ns.scenes import open_scene
from aenerf_ns.simulation import Simulation
from aenerf_ns.structure_from_motion import compare_with_truth, estimate_poses
from aenerf_ns.trajectory.alignment import pose_errors
from aenerf_ns.trajectory.noise import perturb
from aenerf_ns.trajectory.trajectory import Trajectory, homogeneous


@dataclass
class Simulate:
    """Simulate an event camera that moves through a scene, and write a dataset for ns-train aenerf."""

    output: Path
    """Dataset folder to create."""
    scene: str = "room"
    """room: a furnished room seen from inside; object: one seen from around it; or a file: a mesh (.glb, .obj, .ply)
    to be seen from around it, or a scene.json with a mesh, its light and the camera's path (docs/simulator.md)."""
    speed: Literal["easy", "hard"] = "easy"
    """Constant speed, or the same path at 8^sin(2 pi t) times that speed."""
    width: int = 346
    """Pixel columns of the sensor."""
    height: int = 260
    """Pixel rows of the sensor."""
    duration: float = 4.0
    """Seconds that the path takes at constant speed."""
    pose_rate: float = 250.0
    """Poses a second in the trajectories; with --poses colmap, in the true one."""
    poses: Literal["noise", "colmap"] = "noise"
    """Where the estimated poses come from: the true ones with noise, or COLMAP run on the frames of a camera beside the
    event sensor, as in a DAVIS. COLMAP gives a pose a frame, and may lose or misplace some."""
    frame_rate: float = 25.0
    """Frames a second that COLMAP gets."""
    exposure: float = 0.003
    """Seconds for which a frame is exposed, and blurred by motion."""
    pose_noise_degrees: float = 0.0
    """Error of the estimated rotations: root mean square of its angle, in degrees."""
    pose_noise_translation: float = 0.0
    """Error of the estimated positions: root mean square of its length, in scene units (metres)."""
    pose_noise_correlation_time: float = 0.25
    """Seconds over which the pose errors are alike."""
    positive_contrast_threshold: float = 0.25
    """C+: rise of log-radiance that triggers an event."""
    negative_contrast_threshold: float = 0.25
    """C-: fall of log-radiance that triggers an event."""
    contrast_threshold_spread: float = 0.0
    """Standard deviation of the thresholds over the pixels."""
    refractory_period_ns: int = 0
    """Time for which a pixel is blind after each event, in nanoseconds."""
    bayer_pattern: BayerPattern = ""
    """RGGB for a colour sensor."""
    max_displacement: float = 0.5
    """Pixels that the image may move between two rendered frames."""
    train_images: int = 50
    """Reference images along the trajectory. They are never trained on."""
    validation_views: int = 20
    """Reference views around the trajectory, for colour correction."""
    test_views: int = 20
    """Reference views from novel places, for evaluation."""
    seed: int = 0
    """Seed of everything random: the scene, the sensor, the pose noise and the test views."""

    def main(self) -> None:
        """Renders the scene along its path and writes the dataset."""
        if self.output.exists():
            raise DataError(self.output, "the folder exists already", "remove it or choose another --output")
        counts = (self.train_images, self.validation_views, self.test_views)
        if min(counts) < 0:
            raise DataError("aenerf simulate", f"numbers of images {counts}", "they must not be negative")
        scene = open_scene(self.scene, self.seed)
        for note in scene.notes:
            CONSOLE.print(note, highlight=False, markup=False)
        validation = torch.from_numpy(scene.validation_views(self.validation_views))
        test = torch.from_numpy(scene.test_views(self.test_views, self.seed))
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
                self.duration,
                self.max_displacement,
                self.contrast_threshold_spread,
                self.seed,
            )
            truth = simulation.trajectory(self.pose_rate)
            estimated, report = self._estimate(simulation, camera, truth)
        except DataError:
            raise
        except ValueError as error:
            raise DataError("aenerf simulate", str(error), "see aenerf simulate --help") from error
        num_events = 0
        with NativeDatasetWriter(self.output, camera, sensor, "srgb", scene.aabb) as writer:
            writer.add_trajectories(estimated, truth)
            if report is not None:
                writer.add_poses_report(report)
            for events in simulation.events():
                writer.events.append(events)
                num_events += len(events)
            for time in np.linspace(estimated.start, estimated.end, self.train_images, dtype=np.int64).tolist():
                # The picture shows what is true; the pose beside it is what the user of the dataset is given.
                pose = homogeneous(estimated.interpolate(time))
                writer.add_image("train", simulation.reference_image(simulation.pose(time)), pose, time)
            for pose in validation:
                writer.add_image("val", simulation.reference_image(pose), pose)
            for pose in test:
                writer.add_image("test", simulation.reference_image(pose), pose)
        seconds = (truth.end - truth.start) * 1e-9
        CONSOLE.print(
            f"{self.output}: {num_events:,} events in {seconds:.2f} s, {len(estimated)} poses, {self.train_images} "
            f"train, {self.validation_views} validation and {self.test_views} test images.\n"
            f"Train with: ns-train aenerf --data {self.output}"
        )

    def _estimate(
        self, simulation: Simulation, camera: EventCamera, truth: Trajectory
    ) -> tuple[Trajectory, dict[str, Any] | None]:
        """The estimated trajectory, and where structure from motion was run, what it says of itself."""
        noise = (self.pose_noise_degrees, self.pose_noise_translation)
        if self.poses == "noise":
            return perturb(truth, *noise, self.pose_noise_correlation_time, self.seed), None
        if any(noise):
            raise DataError(
                "aenerf simulate",
                f"pose noise {noise} with --poses colmap",
                "leave it out: COLMAP errs by itself",
            )
        times = simulation.frame_times(self.frame_rate, self.exposure)
        frames = (simulation.blurred_frame(int(time), self.exposure) for time in times)
        found = estimate_poses(frames, times, camera, "frames of aenerf simulate", self.seed)
        true_poses = torch.stack([simulation.pose(time)[:3] for time in found.trajectory.times.tolist()])
        # Only the world's position, orientation and scale, which no picture tells, are taken from the truth.
        estimated, errors = compare_with_truth(found.trajectory, true_poses)
        knots = truth.knots_covered_by(estimated)
        between = pose_errors(estimated.interpolate(knots), truth.interpolate(knots))
        CONSOLE.print(
            f"{found.summary()}\nMean errors {errors['rotation_error_degrees']:.2f} degrees and "
            f"{errors['translation_error']:.2g} m at the frames, {between['rotation_error_degrees']:.2f} degrees and "
            f"{between['translation_error']:.2g} m interpolated between them; {errors['misplaced_frames']} frames "
            f"misplaced, {errors['flipped_frames']} of them flipped."
        )
        settings = {"frame_rate": self.frame_rate, "exposure_seconds": self.exposure}
        return estimated, {**settings, **found.report(), "errors": errors, "errors_between_frames": between}
