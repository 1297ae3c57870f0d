"""What the simulator looks at: built-in scenes and meshes, their cameras' paths and their held-out views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.scenes import paths
from aenerf_ns.scenes.renderer import Renderer

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SimulationScene:
    """A scene and how it is looked at. Poses are camera-to-world, OpenCV axes, z up, metres.

    Attributes:
        name: "room", "object", or a file's name.
        renderer: the lit scene.
        path: s in [0, 1] to a pose (4, 4).
        focal_ratio: focal length over image width; the pixels are square and the principal point is the middle.
        aabb: (2, 3) corners of the box that holds the scene; None where it surrounds the camera.
        background: (3,) linear RGB behind the scene; None where every ray hits something, or an environment.
        validation_views: number of views to poses (n, 4, 4) around the path.
        test_views: number of views and seed to random poses (n, 4, 4).
        duration: seconds that the path takes at constant speed.
        notes: what the user should know was assumed, a line each.
    """

    name: str
    renderer: Renderer
    path: Callable[[float], Array]
    focal_ratio: float
    aabb: Array | None
    background: Array | None
    validation_views: Callable[[int], Array]
    test_views: Callable[[int, int], Array]
    duration: float = 4.0
    notes: tuple[str, ...] = ()

    def intrinsics(self, width: int, height: int) -> tuple[float, float, float, float]:
        """(fx, fy, cx, cy) in pixels, pixel centres at +0.5."""
        focal = self.focal_ratio * width
        return focal, focal, width / 2, height / 2


def built_in_scene(name: str, seed: int = 0) -> SimulationScene:
    """Make and light a built-in scene, in a few seconds.

    Raises:
        ValueError: on a name other than "room" and "object".
    """
    if name == "room":
        from aenerf_ns.scenes.room import room_scene

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
    if name == "object":
        from aenerf_ns.scenes.objects import locomotive_scene

        scene = locomotive_scene(seed)
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
    raise ValueError(f'scene must be "room" or "object", got {name!r}')


def open_scene(name: str, seed: int = 0) -> SimulationScene:
    """A built-in scene by its name, or a mesh or scene.json by its file name.

    Raises:
        DataError: there is no such scene, or the file cannot be used.
    """
    if name in ("room", "object"):
        return built_in_scene(name, seed)
    from aenerf_ns.scenes.scene_file import load_scene

    return load_scene(Path(name), seed)
