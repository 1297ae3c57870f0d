"""What the two simulations have in common: the sensor, the errors of the poses, and the number of images."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from aenerf_ns.cli.ranges import require_range, require_seed
from aenerf_ns.events.sensor import BayerPattern, SensorModel, sensor_values
from aenerf_ns.files.output_paths import require_absent
from aenerf_ns.simulator.options import DURATIONS, MIN_CONTRAST_THRESHOLD, SENSORS, SensorName, SensorNoise

if TYPE_CHECKING:
    from aenerf_ns.camera.trajectory import Trajectory

# Wider than anybody needs. Outside them a simulation would run for days, or fill the memory.
_RANGES = {
    "positive_contrast_threshold": (MIN_CONTRAST_THRESHOLD, 1e3),
    "negative_contrast_threshold": (MIN_CONTRAST_THRESHOLD, 1e3),
    "refractory_period_ns": (0, 10**12),
    "pose_noise_degrees": (0, 180),
    "pose_noise_translation": (0, 1e6),
    "pose_noise_correlation_time": (1e-6, 1e6),
    "contrast_threshold_spread": (0, 10),
    "leak_rate": (0, 1e6),
    "shot_noise_rate": (0, 1e6),
    "bandwidth": (1e-3, 1e9),
    "noise_rate_spread": (0, 2),
    "hot_pixel_fraction": (0, 1),
    "hot_pixel_rate": (0, 1e6),
    "readout_rate": (1e3, 1e12),
    "time_resolution_ns": (1, 10**9),
    "frame_rate": (1e-3, 1e6),
    "max_displacement": (1e-2, 1e2),
    "train_images": (0, 100_000),
    "validation_views": (0, 100_000),
    "test_views": (0, 100_000),
    "width": (1, 1 << 14),
    "height": (1, 1 << 14),
    "duration": DURATIONS,
    "pose_rate": (1e-3, 1e6),
    "exposure": (1e-9, 1e3),
}


@dataclass
class SimulationCommand:
    """A command that simulates an event camera and writes a dataset."""

    output: Path
    """Dataset folder to create."""
    _: KW_ONLY
    pose_noise_degrees: float = 0.0
    """Error of the estimated rotations: root mean square of its angle, in degrees."""
    pose_noise_translation: float = 0.0
    """Error of the estimated positions: root mean square of its length, in scene units (meters)."""
    pose_noise_correlation_time: float = 0.25
    """Correlation time of the pose errors in seconds."""
    pose_noise_kind: Literal["smooth", "gauss-markov"] = "smooth"
    """Whether the errors change smoothly, or as a first-order Gauss-Markov process that jumps from pose to pose."""
    sensor: SensorName = "ideal"
    """A sensor of this kind (docs/simulator.md lists its values). The options below change single values of it."""
    positive_contrast_threshold: float | None = None
    """C+: rise of log-radiance that triggers an event. By default 0.25."""
    negative_contrast_threshold: float | None = None
    """C-: fall of log-radiance that triggers an event. By default 0.25."""
    refractory_period_ns: int | None = None
    """Time for which a pixel is blind after each event, in nanoseconds."""
    noise: tyro.conf.OmitArgPrefixes[SensorNoise] = field(default_factory=SensorNoise)
    bayer_pattern: BayerPattern = ""
    """Color filters of a color sensor: of the first two pixels of the first row, then of the second."""
    max_displacement: float = 0.5
    """Pixels that 99 % of the picture may move between two rendered frames, or between two frames along the flow."""
    train_images: int = 50
    """Reference images along the trajectory. They are not used for training."""
    validation_views: int = 20
    """Reference views around the trajectory, or frames of the video, for color correction."""
    test_views: int = 20
    """Reference views from other positions, or other frames of the video, for evaluation."""
    seed: int = 0
    """Seed of everything random: the scene, the sensor, the pose noise and the test views."""

    @property
    def pose_noise(self) -> tuple[float, float]:
        """Error of the estimated poses: degrees and scene units."""
        return self.pose_noise_degrees, self.pose_noise_translation

    def require_possible(self) -> None:
        """Raise a DataError if the output exists or a number is out of range."""
        require_absent(self.output)
        for name, value in {**vars(self), **vars(self.noise)}.items():
            if name in _RANGES and value is not None:
                require_range(name.replace("_", "-"), value, *_RANGES[name])
        require_seed(self.seed)

    def make_sensor(self) -> tuple[SensorModel, SensorNoise]:
        """Make the sensor and its noise."""
        sensor, noise = SENSORS[self.sensor]
        given = {name: value for name, value in vars(self.noise).items() if value is not None}
        return replace(sensor, **sensor_values(self)), replace(noise, **given)

    def add_pose_noise(self, poses: Trajectory) -> Trajectory:
        """Add errors to true poses."""
        if not any(self.pose_noise):
            return poses
        from aenerf_ns.camera.noise import perturb

        return perturb(poses, *self.pose_noise, self.pose_noise_correlation_time, self.seed, self.pose_noise_kind)
