"""The benchmark scenes: their content, their light, and the camera's path."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.scenes import object_scenes, place_scenes
from benchmarks.scenes.assets import Library
from benchmarks.scenes.cleaning import without_coincident_faces
from benchmarks.scenes.meshes import Model

_HALF_EXTENT, _RADIUS, _DISTANCE = 1.2, 1.35, 4.0
"""Half of an object's longest side, radius of the ball that holds it, and the camera's distance, in meters."""
_GRAY = (0.5, 0.5, 0.5)


@dataclass(frozen=True)
class BenchmarkScene:
    """A scene to build.

    Attributes:
        compose: makes the mesh from a library.
        environment: name of the environment that lights the scene.
        turn_degrees: turn of the environment.
        lamps: further lights, as in a scene file.
        walk: positions and targets of a walk. None if the camera goes around the scene.
        duration: seconds that the path takes at constant speed.
        show_environment: whether the environment is the background. Otherwise the background is gray.
    """

    compose: Callable[[Library], Model]
    environment: str
    turn_degrees: float = 0.0
    lamps: tuple[dict[str, list[float]], ...] = ()
    walk: tuple[list[list[float]], list[list[float]]] | None = None
    duration: float = 4.0
    show_environment: bool = False

    def model(self, library: Library) -> Model:
        """Make the finished mesh: an object gets its size and place, and no faces lie in one another."""
        model = self.compose(library)
        if self.walk is None:
            model = model.fitted(_HALF_EXTENT, _RADIUS)
        return without_coincident_faces(model, 5e-4)

    def description(self, mesh: str, environment: str, credits: Sequence[dict[str, str]]) -> dict[str, object]:
        """Return the content of the scene file, given the file names of its mesh and its environment."""
        path: dict[str, object] = {"kind": "around", "center": [0, 0, 0], "radius": _DISTANCE, "turns": 4}
        if self.walk is not None:
            path = {"kind": "walk", "positions": self.walk[0], "targets": self.walk[1]}
        path["duration"] = self.duration
        light: dict[str, object] = {"environment": environment, "turn_degrees": self.turn_degrees, "gain": 1.0}
        if self.lamps:
            light["lamps"] = list(self.lamps)
        return {
            "mesh": mesh,
            "light": light,
            "background": "environment" if self.show_environment else list(_GRAY),
            "path": path,
            "credits": list(credits),
        }


def loop(
    half_length: float, half_width: float, height: float, reach: float, look_height: float
) -> tuple[list[list[float]], list[list[float]]]:
    """Return positions and targets of an oval walk around the origin. The camera bobs and looks across the middle.

    Args:
        half_length, half_width: half axes of the oval along x and y, in meters.
        height, look_height: mean heights of the camera and of the targets, in meters.
        reach: distance of the targets beyond the middle, as a fraction of the oval's half axes.
    """
    turn = 2 * np.pi * np.arange(16) / 16
    across = turn + np.pi + 0.45 * np.sin(2 * turn + 0.4)
    bob, nod = height + 0.14 * np.sin(3 * turn + 0.7), look_height + 0.3 * np.sin(3 * turn - 0.6)
    eyes = np.column_stack([half_length * np.cos(turn), half_width * np.sin(turn), bob])
    targets = np.column_stack([reach * half_length * np.cos(across), reach * half_width * np.sin(across), nod])
    return eyes.round(3).tolist(), targets.round(3).tolist()


SCENES: dict[str, BenchmarkScene] = {
    "piano": BenchmarkScene(object_scenes.piano, "apartment"),
    "bookshelf": BenchmarkScene(object_scenes.bookshelf, "lobby"),
    "plants": BenchmarkScene(object_scenes.plants, "venice"),
    "playground": BenchmarkScene(object_scenes.playground, "park"),
    "breakfast": BenchmarkScene(object_scenes.breakfast, "apartment", turn_degrees=120),
    "lounge": BenchmarkScene(object_scenes.lounge, "lobby", turn_degrees=60),
    "forklift": BenchmarkScene(object_scenes.forklift, "warehouse"),
    "games": BenchmarkScene(object_scenes.games, "lab"),
    "living_room": BenchmarkScene(
        place_scenes.living_room, "park", lamps=place_scenes.LIVING_ROOM_LAMPS,
        walk=loop(1.2, 0.9, 1.4, 0.9, 0.95), show_environment=True,
    ),
    "terrace": BenchmarkScene(
        place_scenes.terrace, "park", turn_degrees=200,
        walk=loop(2.7, 2.0, 1.55, 0.8, 0.85), duration=6.0, show_environment=True,
    ),
    "gallery": BenchmarkScene(
        place_scenes.gallery, "lobby", lamps=place_scenes.GALLERY_LAMPS,
        walk=loop(6.1, 1.55, 1.6, 0.75, 1.35), duration=8.0,
    ),
    "workshop": BenchmarkScene(
        place_scenes.workshop, "venice", lamps=place_scenes.WORKSHOP_LAMPS,
        walk=loop(2.0, 1.55, 1.6, 0.9, 1.0), duration=5.0, show_environment=True,
    ),
}  # fmt: skip
