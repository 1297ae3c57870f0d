"""Open a scene by its name: a built-in scene, a mesh or a scene.json."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from aenerf_ns.simulator import paths
from aenerf_ns.simulator.options import BUILT_IN
from aenerf_ns.simulator.scene import SimulationScene


def built_in_scene(name: str, seed: int = 0) -> SimulationScene:
    """Make and light a built-in scene. It takes a few seconds.

    Raises:
        ValueError: the name is not among `BUILT_IN`.
    """
    if name == "room":
        from aenerf_ns.simulator.room import room_scene

        return SimulationScene(
            name,
            room_scene(seed),
            paths.room_path,
            focal_ratio=0.62,
            aabb=None,
            background=None,
            validation_views=paths.room_validation_views,
            test_views=paths.room_test_views,
        )
    if name in ("object", "shiny_object"):
        from aenerf_ns.simulator.locomotive import locomotive_scene

        scene = locomotive_scene(seed, shiny=name == "shiny_object")
        return SimulationScene(
            name,
            scene,
            paths.object_path,
            focal_ratio=1.2,
            aabb=np.array([[-1.2] * 3, [1.2] * 3]),
            background=scene.background,
            validation_views=paths.object_validation_views,
            test_views=paths.object_test_views,
        )
    raise ValueError(f"scene must be one of {', '.join(BUILT_IN)}, got {name!r}")


def open_scene(name: str, seed: int = 0) -> SimulationScene:
    """Open a built-in scene by its name, or a mesh or scene.json by its file name.

    Raises:
        DataError: there is no such scene, or the file cannot be used.
    """
    if name in BUILT_IN:
        return built_in_scene(name, seed)
    from aenerf_ns.simulator.scene_file import load_scene

    return load_scene(Path(name), seed)
