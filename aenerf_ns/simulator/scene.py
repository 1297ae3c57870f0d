"""Scenes of the simulator: the lit mesh and the camera's path, and how they are opened by their names."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aenerf_ns.simulator.arrays import Array
from aenerf_ns.simulator.options import BUILT_IN
from aenerf_ns.simulator.paths import CameraPath, ObjectPath, RoomPath
from aenerf_ns.simulator.rendering.renderer import Renderer


@dataclass(frozen=True)
class SimulationScene:
    """A scene and the cameras in it. Poses are camera-to-world, OpenCV axes, z up, meters.

    Attributes:
        name: name of a built-in scene or of a file.
        renderer: renders the scene.
        path: the camera's path, and the held-out views beside it.
        focal_ratio: focal length divided by image width. Pixels are square, and the principal point is the middle.
        aabb: (2, 3) corners of the box around the scene, or None if the scene surrounds the camera.
        background: (3,) linear RGB behind the scene, or None if every ray hits something or sees an environment.
        duration: seconds that the path takes at constant speed.
        notes: assumptions that the user should know, a line each.
    """

    name: str
    renderer: Renderer
    path: CameraPath
    focal_ratio: float
    aabb: Array | None
    background: Array | None
    duration: float = 4.0
    notes: tuple[str, ...] = ()

    def intrinsics(self, width: int, height: int) -> tuple[float, float, float, float]:
        """Return (fx, fy, cx, cy) in pixels, pixel centers at +0.5."""
        focal = self.focal_ratio * width
        return focal, focal, width / 2, height / 2


def open_scene(name: str, seed: int = 0) -> SimulationScene:
    """Open a built-in scene by its name, or a mesh or scene.json by its file name. Its light takes seconds.

    Raises:
        DataError: there is no such scene, or the file cannot be used.
    """
    if name not in BUILT_IN:
        from aenerf_ns.simulator.scene_file import load_scene

        return load_scene(Path(name), seed)
    if name == "room":
        from aenerf_ns.simulator.room import room_scene

        return SimulationScene(name, room_scene(seed), RoomPath(), focal_ratio=0.62, aabb=None, background=None)
    from aenerf_ns.simulator.locomotive import BACKGROUND, locomotive_scene

    renderer, box = locomotive_scene(seed, shiny=name == "shiny_object"), np.array([[-1.2] * 3, [1.2] * 3])
    return SimulationScene(name, renderer, ObjectPath(), focal_ratio=1.2, aabb=box, background=np.array(BACKGROUND))
