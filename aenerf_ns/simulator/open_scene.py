"""Open a scene by its name: a built-in scene, a mesh, a .blend or a scene.json."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from aenerf_ns.simulator.locomotive import BACKGROUND, locomotive_scene
from aenerf_ns.simulator.options import BUILT_IN
from aenerf_ns.simulator.paths import ObjectPath, RoomPath
from aenerf_ns.simulator.room import room_scene
from aenerf_ns.simulator.scene import SimulationScene
from aenerf_ns.simulator.scene_file import load_scene


def open_scene(name: str, seed: int = 0) -> SimulationScene:
    """Open a built-in scene by its name, or a mesh, .blend or scene.json by its file name. Its light takes seconds.

    Raises:
        DataError: there is no such scene, or the file cannot be used.
    """
    if name not in BUILT_IN:
        return load_scene(Path(name), seed)
    if name == "room":
        return SimulationScene(name, room_scene(seed), RoomPath(), focal_ratio=0.62, aabb=None, background=None)
    renderer, box = locomotive_scene(seed, shiny=name == "shiny_object"), np.array([[-1.2] * 3, [1.2] * 3])
    return SimulationScene(name, renderer, ObjectPath(), focal_ratio=1.2, aabb=box, background=BACKGROUND)
