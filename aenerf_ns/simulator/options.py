"""The choices that a simulation has, apart from the code that makes it: commands show them without importing it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from aenerf_ns.errors import DataError
from aenerf_ns.files.limits import require_file

BUILT_IN = ("room", "object", "shiny_object")
"""Names of the built-in scenes."""
MESH_SUFFIXES = (".glb", ".obj", ".ply")
"""Endings of names of mesh files."""
DURATIONS = (1e-3, 1e5)
"""Shortest and longest duration in seconds."""
Interpolation = Literal["linear", "flow"]
"""How the log-radiance changes between two frames of a video."""


def require_scene_file(path: Path) -> None:
    """Raise a DataError unless a path leads to a file that may be a mesh or a scene.json."""
    if path.suffix.lower() not in (*MESH_SUFFIXES, ".json"):
        raise DataError(path, "an unknown scene", "give a built-in scene, a .glb, .obj or .ply file, or a scene.json")
    require_file(path)


@dataclass(frozen=True)
class SensorNoise:
    """How a sensor differs from an ideal one."""

    contrast_threshold_spread: float = 0.0
    """Standard deviation of the thresholds over the pixels."""
    leak_rate: float = 0.0
    """Positive events a second that every pixel fires in steady light, because its reference leaks (real: 0.1 to 1)."""
    shot_noise_rate: float = 0.0
    """Events a second that a dark pixel fires at random. A bright pixel fires a quarter of them (real: up to 10)."""
