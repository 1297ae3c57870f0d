"""A scene that the simulator looks at: what is seen, the camera's path and the held-out views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.simulator.rendering.renderer import Renderer

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
