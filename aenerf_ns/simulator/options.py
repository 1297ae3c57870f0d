"""The choices that a simulation has, apart from the code that makes it: commands show them without importing it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.limits import require_file

BUILT_IN = ("room", "object", "shiny_object")
"""Names of the built-in scenes."""
MESH_SUFFIXES = (".glb", ".obj", ".ply")
"""Endings of names of mesh files."""
BLENDER_SUFFIX = ".blend"
DURATIONS = (1e-3, 1e5)
"""Shortest and longest duration in seconds."""
MIN_CONTRAST_THRESHOLD = 0.01
"""Threshold below which no pixel of the simulator's sensors lies, whatever the spread."""
Interpolation = Literal["linear", "flow"]
"""How the log-radiance changes between two frames of a video."""


def require_scene_file(path: Path) -> None:
    """Raise a DataError unless a path leads to a file that may be a mesh, a .blend or a scene.json."""
    if path.suffix.lower() not in (*MESH_SUFFIXES, BLENDER_SUFFIX, ".json"):
        remedy = "give a built-in scene, a .glb, .obj, .ply or .blend file, or a scene.json"
        raise DataError(path, "an unknown scene", remedy)
    require_file(path, "check its name")


@dataclass(frozen=True)
class SensorNoise:
    """How a sensor differs from an ideal one. None is what an ideal sensor has; as an option, what --sensor has."""

    contrast_threshold_spread: float | None = None
    """Standard deviation of the thresholds over the pixels."""
    bandwidth: float | None = None
    """Cutoff frequency in Hz of a pixel that sees white. It falls with the light, to a fourteenth in the dark."""
    leak_rate: float | None = None
    """Positive events a second that a pixel fires in steady light, because its reference leaks."""
    shot_noise_rate: float | None = None
    """Events a second that a dark pixel fires at random. A bright pixel fires a quarter of them."""
    noise_rate_spread: float | None = None
    """Standard deviation over the pixels of the logarithm to base 10 of the rates of leak and shot noise."""
    hot_pixel_fraction: float | None = None
    """Fraction of the pixels that are hot."""
    hot_pixel_rate: float | None = None
    """Events a second that a hot pixel fires at random, whatever the light."""
    readout_rate: float | None = None
    """Events a second that the sensor can read out. Others wait, and pixels that wait fire no further events."""
    time_resolution_ns: int | None = None
    """Nanoseconds from one tick of the sensor's clock to the next. Times are rounded down to a tick."""


_DAVIS346 = SensorNoise(
    contrast_threshold_spread=0.03,
    bandwidth=300,
    leak_rate=0.1,
    shot_noise_rate=0.001,
    noise_rate_spread=0.1,
    hot_pixel_fraction=2e-4,
    hot_pixel_rate=150,
    readout_rate=12e6,
    time_resolution_ns=1000,
)
_DAVIS = SensorModel(refractory_period=500_000)

SensorName = Literal["ideal", "davis240", "davis346", "davis346-dim", "gen4"]
SENSORS: dict[SensorName, tuple[SensorModel, SensorNoise]] = {
    "ideal": (SensorModel(), SensorNoise(hot_pixel_rate=150)),
    "davis240": (_DAVIS, replace(_DAVIS346, contrast_threshold_spread=0.035)),
    "davis346": (_DAVIS, _DAVIS346),
    "davis346-dim": (_DAVIS, replace(_DAVIS346, bandwidth=30, shot_noise_rate=5)),
    "gen4": (
        SensorModel(refractory_period=10_000),
        replace(_DAVIS346, bandwidth=1000, hot_pixel_fraction=5e-5, hot_pixel_rate=20, readout_rate=1066e6),
    ),
}
"""Sensors by name. The sources of the values are in docs/simulator.md."""
