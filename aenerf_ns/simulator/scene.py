"""A scene of the simulator: what is seen, and the camera's path."""

from __future__ import annotations

from dataclasses import dataclass

from aenerf_ns.simulator.arrays import Array
from aenerf_ns.simulator.blender import BlenderRenderer
from aenerf_ns.simulator.paths import CameraPath
from aenerf_ns.simulator.rendering.renderer import Renderer


@dataclass(frozen=True)
class SimulationScene:
    """A scene and the cameras in it. Poses are camera-to-world, OpenCV axes, z up, meters.

    Attributes:
        renderer, path: what is seen, and the camera's path with the held-out views around it.
        focal_ratio: focal length divided by image width. Pixels are square, and the principal point is the middle.
        aabb: (2, 3) corners of the box around the scene, or None if the scene surrounds the camera.
        duration: seconds that the path takes at constant speed.
        notes: assumptions that the user should know, a line each.
    """

    renderer: Renderer | BlenderRenderer
    path: CameraPath
    focal_ratio: float
    aabb: Array | None
    duration: float = 4.0
    notes: tuple[str, ...] = ()

    def intrinsics(self, width: int, height: int) -> tuple[float, float, float, float]:
        """Return (fx, fy, cx, cy) in pixels, pixel centers at +0.5."""
        focal = self.focal_ratio * width
        return focal, focal, width / 2, height / 2
