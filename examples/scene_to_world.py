"""Map points and poses from a run's scene back to the world of the recording: `python scene_to_world.py RUN`."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

Map = Callable[[ArrayLike], NDArray[np.float64]]


def load_world_from_scene(run: Path) -> tuple[Map, Map]:
    """Return functions that map points (N, 3) and OpenGL poses (N, 3, 4), camera-to-world, from scene to world."""
    saved = json.loads((run / "dataparser_transforms.json").read_text())
    matrix, scale = np.array(saved["transform"]), saved["scale"]
    rotation, translation = matrix[:, :3], matrix[:, 3]

    def points(scene: ArrayLike) -> NDArray[np.float64]:
        return (np.asarray(scene) / scale - translation) @ rotation

    def poses(scene: ArrayLike) -> NDArray[np.float64]:
        matrices = np.asarray(scene)
        return np.concatenate([rotation.T @ matrices[:, :, :3], points(matrices[:, :, 3])[:, :, None]], -1)

    return points, poses


if __name__ == "__main__":
    points, _ = load_world_from_scene(Path(sys.argv[1]))
    print("The scene's origin in the world:", points([[0.0, 0.0, 0.0]])[0])
