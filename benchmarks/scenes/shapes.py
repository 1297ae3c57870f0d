"""Simple shapes as textured meshes. A texture repeats every ``tile`` meters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.scenes.meshes import Material, Model, Part, not_degenerate


def rectangle(origin: ArrayLike, u: ArrayLike, v: ArrayLike, material: Material, tile: float | None = None) -> Model:
    """Make a parallelogram whose front faces u x v. Without ``tile`` the texture fills it once."""
    origin, u, v = (np.asarray(value, np.float64) for value in (origin, u, v))
    repeats = (1.0, 1.0) if tile is None else (np.linalg.norm(u) / tile, np.linalg.norm(v) / tile)
    corner = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])[[[0, 1, 2], [0, 2, 3]]]
    points = origin + corner[..., :1] * u + corner[..., 1:] * v
    return Model((Part(points, corner * np.array(repeats), material),))


def box(low: ArrayLike, high: ArrayLike, material: Material, tile: float | None = 0.5, without: str = "") -> Model:
    """Make a box between two corners, ``without`` the sides of some letters: "x" at low x, "X" at high x, and so on."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    x, y, z = np.diag(high - low)
    sides = {
        "x": (low + y, -y, z),
        "X": (high - y - z, y, z),
        "y": (low, x, z),
        "Y": (high - z, -x, z),
        "z": (low + y, x, -y),
        "Z": (high - x - y, x, y),
    }
    return sum((rectangle(*side, material, tile) for name, side in sides.items() if name not in without), Model())


def revolved(profile: Sequence[tuple[float, float]], material: Material, tile: float = 0.5, sides: int = 48) -> Model:
    """Make the surface that a line of (radius, z) points sweeps around the z axis.

    An upward line faces outwards. The line is straight between its points.
    """
    line = np.array(profile, np.float64)
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    around = max(1.0, np.rint(2 * np.pi * line[:, 0].max() / tile))
    radius, z = line[:, :1], line[:, 1:]
    points = np.stack(np.broadcast_arrays(radius * np.cos(angle), radius * np.sin(angle), z), axis=2)
    uv = np.stack(np.broadcast_arrays(around * angle / (2 * np.pi), length[:, None] / tile), axis=2)
    grid = np.concatenate([points, uv], axis=2)
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
    corners = np.stack([a, b, c, a, c, d], axis=2).reshape(-1, 3, 5)
    corners = corners[not_degenerate(corners[..., :3])]
    return Model((Part(corners[..., :3], corners[..., 3:], material),))


def disc(radius: float, z: float, material: Material, tile: float = 0.5, sides: int = 48) -> Model:
    """Make a disc around the z axis that faces up."""
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    rim = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(sides + 1, z)])
    points = np.stack([np.broadcast_to((0, 0, z), (sides, 3)), rim[:-1], rim[1:]], axis=1)
    return Model((Part(points, points[..., :2] / tile, material),))
