"""Move an event camera through a scene."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from aenerf_ns.camera.alignment import pose_errors
from aenerf_ns.camera.image_encoding import encode, to_channels
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.progress import track
from aenerf_ns.simulator.esim import NOISELESS, EventSimulator
from aenerf_ns.simulator.frames import frame_parameters
from aenerf_ns.simulator.options import SensorNoise
from aenerf_ns.simulator.paths import SpeedProfile
from aenerf_ns.simulator.scene import SimulationScene

# An edge that crosses a pixel hides its rays one by one. With 4 rays, each of these steps fires events of its own.
RAYS_PER_PIXEL = 16
"""Rays per pixel of the pictures that events are made of, and of the reference pictures."""

# Exposures are means of many pictures, which smooth these steps.
_RAYS_OF_EXPOSURES = 4


class ReferencePicture(NamedTuple):
    """The picture from a pose, gray for a monochrome sensor."""

    display: NDArray[np.uint8]  # (height, width, 3), sRGB
    linear: NDArray[np.uint16]  # (height, width, 3), linear radiance; 65535 stands for 1, which is display white
    depth: NDArray[np.float32]  # (height, width) along the optical axis at the pixels' centers, inf for no hit


class Simulation:
    """One pass of an event camera along a scene's path.

    Args:
        scene: the scene and the path.
        camera: the lens, which must be free of distortion.
        sensor, noise, seed: see :class:`~aenerf_ns.simulator.esim.EventSimulator`.
        speed, easy_duration: see :class:`~aenerf_ns.simulator.paths.SpeedProfile`.
        max_displacement: pixels that 99 % of the picture may move between two rendered frames.

    Raises:
        ValueError: the duration is too short.

    Attributes:
        simulator: the sensor.
    """

    def __init__(
        self,
        scene: SimulationScene,
        camera: CameraIntrinsics,
        sensor: SensorModel,
        speed: Literal["easy", "hard"],
        easy_duration: float,
        max_displacement: float,
        seed: int,
        noise: SensorNoise = NOISELESS,
    ) -> None:
        self._scene, self._camera, self._sensor = scene, camera, sensor
        self._intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
        self._profile = SpeedProfile(speed, easy_duration)
        self.simulator = EventSimulator(camera.width, camera.height, sensor, noise, seed=seed)
        self._frames = frame_parameters(scene, self._intrinsics, camera.width, camera.height, max_displacement)
        self._times = _nanoseconds(self._profile.time(self._frames))
        if (np.diff(self._times) <= 0).any():
            raise ValueError(f"duration must be long enough to tell its frames apart, not {easy_duration} s")

    def trajectory(self, pose_rate: float) -> Trajectory:
        """Return the true trajectory, ``pose_rate`` poses a second, camera-to-world, OpenCV axes, in meters."""
        end = self._profile.duration
        seconds = np.append(np.arange(0, end - 0.5 / pose_rate, 1 / pose_rate), end)
        return Trajectory(_nanoseconds(seconds), self._poses(self._profile.parameter(seconds)))

    def pose(self, time: int) -> Tensor:
        """Return the true (4, 4) pose at a time in nanoseconds."""
        return self._poses(np.atleast_1d(self._profile.parameter(time * 1e-9)))[0]

    def _poses(self, parameters: NDArray[np.float64]) -> Tensor:
        return torch.from_numpy(np.stack([self._scene.path(float(s)) for s in parameters.clip(0, 1)]))

    def events(self) -> Iterator[EventStream]:
        """Render the path densely and yield the events of each frame interval. Call it once."""
        for parameter, time in zip(track(self._frames, "Simulating events"), self._times, strict=True):
            image = self._render(self._scene.path(float(parameter)), RAYS_PER_PIXEL)[0]
            yield self.simulator(image, int(time))

    def frame_times(self, frame_rate: float, exposure: float) -> NDArray[np.int64]:
        """Return the middles of the exposures of a camera that takes frames along the path, in nanoseconds.

        ``exposure`` is in seconds. The first exposure begins with the path, and the last one ends within it.

        Raises:
            ValueError: a number is not positive, an exposure takes longer than a frame, or the path is too short for
                two frames.
        """
        if not 0 < frame_rate < np.inf or not 0 < exposure * frame_rate <= 1:
            raise ValueError(f"{frame_rate} frames a second of {exposure} s each cannot be taken")
        room = self._profile.duration - exposure
        if room < 1 / frame_rate:
            raise ValueError(f"{frame_rate} frames a second are fewer than two in {self._profile.duration:.3f} s")
        # Rounding must not lose the last frame if the path holds a whole number of frames.
        return _nanoseconds(exposure / 2 + np.arange(int(room * frame_rate * (1 + 1e-12)) + 1) / frame_rate)

    def blurred_frame(self, time: int, exposure: float) -> NDArray[np.uint8]:
        """Render the sRGB picture of an exposure.

        A sensor sums light, so the picture is the mean of linear radiance over the exposure. The mean is taken by the
        midpoint rule, in steps within which the image moves no more than between two frames of the events.

        Args:
            time: middle of the exposure in nanoseconds.
            exposure: its duration in seconds.

        Returns:
            (height, width) for a monochrome sensor, (height, width, 3) for a color sensor.
        """
        middle, half = time * 1e-9, exposure / 2
        ends = np.interp([middle - half, middle + half], self._times * 1e-9, np.arange(len(self._times)))
        steps = max(int(np.ceil(ends[1] - ends[0])), 1)
        seconds = middle + exposure * ((np.arange(steps) + 0.5) / steps - 0.5)
        parameters = self._profile.parameter(seconds).clip(0, 1)
        radiance = sum(self._render(self._scene.path(float(s)), _RAYS_OF_EXPOSURES)[0] for s in parameters) / steps
        seen = to_channels(torch.from_numpy(radiance), self._sensor.num_channels)
        return _display(seen.squeeze(-1))

    def estimate_poses(
        self, truth: Trajectory, frame_rate: float, exposure: float, seed: int
    ) -> tuple[Trajectory, dict[str, Any], str]:
        """Run COLMAP on the frames of a camera at the event sensor's position, as in a DAVIS.

        The poses stay as COLMAP's incremental mapper leaves them, as in published datasets.

        The truth provides only what pictures cannot: the position, orientation and scale of the world.

        Args:
            truth: the true trajectory.
            frame_rate: frames a second.
            exposure: seconds for which a frame is exposed. Motion blurs the frame meanwhile.
            seed: of COLMAP.

        Returns:
            the estimated trajectory, a report of its making and its errors, and a summary in words.

        Raises:
            ValueError: frame rate and exposure do not fit each other or the path.
            DataError: COLMAP finds no poses.
        """
        # Imported lazily, because few simulations need COLMAP.
        from aenerf_ns.pose_estimation.from_frames import compare_with_truth, estimate_poses

        times = self.frame_times(frame_rate, exposure)
        frames = (self.blurred_frame(int(time), exposure) for time in times)
        found = estimate_poses(frames, times, self._camera, "frames of aenerf simulate", seed, adjusted=False)
        true_poses = torch.stack([self.pose(time)[:3] for time in found.trajectory.times.tolist()])
        estimated, errors = compare_with_truth(found.trajectory, true_poses)
        knots = truth.knots_between(estimated.start, estimated.end)
        if len(knots) < 2:
            problem = f"COLMAP's poses span {len(estimated)} frames, and fewer than two of the true poses"
            raise DataError("aenerf simulate", problem, "give a higher --pose-rate")
        between = pose_errors(estimated.interpolate(knots), truth.interpolate(knots))
        settings = {"frame_rate": frame_rate, "exposure_seconds": exposure}
        report = {**settings, **found.report(), "errors": errors, "errors_between_frames": between}
        summary = (
            f"{found.summary()}\nMean errors {errors['rotation_error_degrees']:.2f} degrees and "
            f"{errors['translation_error']:.2g} m at the frames, {between['rotation_error_degrees']:.2f} degrees and "
            f"{between['translation_error']:.2g} m interpolated between them; {errors['misplaced_frames']} frames "
            f"misplaced, {errors['flipped_frames']} of them flipped."
        )
        return estimated, report, summary

    def reference_picture(self, camera_to_world: NDArray[np.float64] | Tensor) -> ReferencePicture:
        """Render the picture from a (4, 4) pose, without noise or blur."""
        pose = np.asarray(camera_to_world)
        seen = to_channels(torch.from_numpy(self._render(pose, RAYS_PER_PIXEL)[0]), self._sensor.num_channels)
        seen = seen.expand(-1, -1, 3)
        linear = (encode(seen, "linear") * 65535).round().numpy().astype(np.uint16)
        return ReferencePicture(_display(seen), linear, self._render(pose, 1)[1])

    def _render(self, camera_to_world: NDArray[np.float64], samples: int) -> tuple[NDArray[np.float32], ...]:
        camera = self._camera
        return self._scene.renderer.render(camera_to_world, self._intrinsics, camera.width, camera.height, samples)


def _display(radiance: Tensor) -> NDArray[np.uint8]:
    """Return the 8-bit sRGB picture of linear radiance."""
    return (encode(radiance, "srgb") * 255).round().to(torch.uint8).numpy()


def _nanoseconds(seconds: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.rint(seconds * 1e9).astype(np.int64)
