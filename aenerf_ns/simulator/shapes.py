"""Make the textured shapes that the built-in scenes consist of."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aenerf_ns.simulator.arrays import Array, Texture
from aenerf_ns.simulator.rendering.mesh import DIFFUSE, Gloss, Mesh, scaled

_MAX_SAGITTA = 5e-4
"""Largest distance of a triangle from the round surface that it approximates, in meters."""
_MIN_SIDES = 12
"""The faces of a prism with fewer than 10 sides would meet at creases."""

_NO_GLOSS: Mapping[str, Gloss] = {}

Surface = tuple[Array, NDArray[np.int64], Array]
"""Vertices (V, 3) in meters, faces (F, 3) counterclockwise from outside, and texture coordinates (V, 2) in tiles."""


@dataclass(frozen=True)
class Shape:
    """A textured surface.

    Attributes:
        surface: makes the surface, in local coordinates, of cells of two triangles, given their longest side in meters.
        center, rotation: (3,) in meters and (3, 3), world-from-local.
        texture: name of the texture.
        texture_offset: (u, v) in tiles.
        tint: (3,) factor of the texture's albedo.
        emission: radiance with which the surface glows at an albedo of 1. It lights nothing: an `AreaLight` does.
        spacing: longest side of the cells in meters, where that is less than the scene's: the size of its shadows.
    """

    surface: Callable[[float], Surface]
    center: ArrayLike
    rotation: Array
    texture: str
    texture_offset: tuple[float, float] = (0.0, 0.0)
    tint: ArrayLike = (1.0, 1.0, 1.0)
    emission: float = 0.0
    spacing: float = math.inf


def mesh_of(
    shapes: Sequence[Shape], textures: Mapping[str, Texture], spacing: float, gloss: Mapping[str, Gloss] = _NO_GLOSS
) -> Mesh:
    """Join shapes to one mesh of cells with sides of at most ``spacing`` meters.

    ``gloss`` has coats by the names of the textures that they cover. Other shapes are diffuse.

    Raises:
        KeyError: the texture of a shape is missing.
    """
    index = {name: i for i, name in enumerate(textures)}
    parts: list[Surface] = []
    for shape in shapes:
        local, corners, tiles = shape.surface(min(spacing, shape.spacing))
        # Not a matrix product, which may round equal rows differently: the two sides of a seam must not part.
        world = (local[:, None, :] * shape.rotation).sum(axis=-1) + np.asarray(shape.center)
        parts.append((world, corners, tiles + shape.texture_offset))
    sizes = [len(corners) for _, corners, _ in parts]
    tints = np.array([shape.tint for shape in shapes], np.float64)
    mesh = Mesh(
        *_join(parts),
        np.repeat(tints, [len(world) for world, _, _ in parts], axis=0),
        np.repeat([index[shape.texture] for shape in shapes], sizes),
        np.repeat([shape.emission for shape in shapes], sizes).astype(np.float64),
        np.repeat([gloss.get(shape.texture, DIFFUSE) for shape in shapes], sizes, axis=0),
        tuple(textures.values()),
    )
    return scaled(mesh, 1.0)


def axes(right: ArrayLike, up: ArrayLike) -> Array:
    """Return the world-from-local rotation (3, 3) with these local x and y axes, which must be orthonormal."""
    x, y = np.asarray(right, float), np.asarray(up, float)
    return np.stack([x, y, np.cross(x, y)], axis=1)


ALONG_X = axes((0, 1, 0), (0, 0, 1))
ALONG_Y = axes((0, 0, 1), (1, 0, 0))
"""Rotations that lay a cylinder along a world axis."""


def box(low: ArrayLike, high: ArrayLike, texture: str, scale: float, **rest: Any) -> Shape:
    """Make a box between two corners (3,). For the other arguments see `rotated_box`."""
    low_corner, high_corner = np.asarray(low, float), np.asarray(high, float)
    return rotated_box((low_corner + high_corner) / 2, high_corner - low_corner, 0.0, texture, scale, **rest)


def rotated_box(center: ArrayLike, size: ArrayLike, degrees: float, texture: str, scale: float, **rest: Any) -> Shape:
    """Make a box turned about the vertical.

    Args:
        center, size: (3,) in meters.
        degrees: angle of the turn, counterclockwise seen from above.
        texture: name of the texture. Its origin lies in the middle of each side.
        scale: side of one tile of the texture, in meters.
        rest: more attributes of the `Shape`.
    """
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    return Shape(partial(_box, np.asarray(size, float), scale), center, turn, texture, **rest)


def sphere(center: ArrayLike, radius: float, texture: str, scale: float, **rest: Any) -> Shape:
    """Make a sphere, its texture's poles at the sides. For the other arguments see `rotated_box`."""
    return Shape(partial(_sphere, radius, scale), center, axes((0, 0.6, 0.8), (1, 0, 0)), texture, **rest)


def pillar(foot: ArrayLike, radius: float, height: float, texture: str, scale: float, **rest: Any) -> Shape:
    """Make an upright cylinder that stands on ``foot``. For the other arguments see `rotated_box`."""
    return rod(np.add(foot, (0.0, 0.0, height / 2)), radius, height, np.eye(3), texture, scale, **rest)


def rod(
    center: ArrayLike, radius: float, length: float, along: Array, texture: str, scale: float, **rest: Any
) -> Shape:
    """Make a lying cylinder; ``along`` is ALONG_X or ALONG_Y. For the other arguments see `rotated_box`."""
    return Shape(partial(_cylinder, radius, length, scale), center, along, texture, **rest)


def panel(
    center: ArrayLike,
    size: tuple[float, float],
    right: ArrayLike,
    up: ArrayLike,
    texture: str,
    scale: float,
    **rest: Any,
) -> Shape:
    """Make a rectangle (width, height) with these local axes. For the other arguments see `rotated_box`."""
    return Shape(partial(_rectangle, size, scale), center, axes(right, up), texture, **rest)


def _rectangle(size: tuple[float, float], scale: float, spacing: float) -> Surface:
    across, up = (np.linspace(-side / 2, side / 2, _cells(side, spacing) + 1) for side in size)
    grid = np.stack(np.meshgrid(across, up), axis=-1)
    flat = grid.reshape(-1, 2)
    return np.insert(flat, 2, 0.0, axis=1), _triangles(grid), flat / scale


def _box(size: Array, scale: float, spacing: float) -> Surface:
    sides = []
    for axis, (u, v) in enumerate(((1, 2), (0, 2), (0, 1))):
        for sign in (-1, 1):
            flat, faces, _ = _rectangle((size[u], size[v]), scale, spacing)
            positions = np.empty_like(flat)
            positions[:, axis], positions[:, u], positions[:, v] = sign * size[axis] / 2, flat[:, 0], flat[:, 1]
            # Textures have their grain along u, which follows the longer side.
            uv = positions[:, [v, u] if size[v] > size[u] else [u, v]] / scale
            # Together with the outward normal, u and v are right-handed for x and z, and left-handed for y.
            is_right_handed = (sign > 0) != (axis == 1)
            sides.append((positions, faces if is_right_handed else faces[:, ::-1], uv))
    return _join(sides)


def _sphere(radius: float, scale: float, spacing: float) -> Surface:
    turn, circle = _circle(radius, spacing)
    latitude = np.linspace(-0.5 * np.pi, 0.5 * np.pi, len(turn) // 2 + 1)
    ring = np.cos(latitude)
    ring[[0, -1]] = 0.0
    grid = np.insert(ring[:, None, None] * circle, 2, radius * np.sin(latitude)[:, None], axis=-1)
    uv = np.stack(np.broadcast_arrays(turn, latitude[:, None] * radius / scale), axis=-1)
    # A triangle at a pole has there the mean of its other two corners' u.
    uv[0, :, 0] += 0.5 / (len(turn) - 1)
    uv[-1, :, 0] -= 0.5 / (len(turn) - 1)
    uv[..., 0] *= _tiles_around(radius, scale)
    return grid.reshape(-1, 3), _triangles(grid), uv.reshape(-1, 2)


def _cylinder(radius: float, length: float, scale: float, spacing: float) -> Surface:
    turn, circle = _circle(radius, spacing)
    height = np.linspace(-length / 2, length / 2, _cells(length, spacing) + 1)
    wall = np.insert(np.repeat(circle[None], len(height), axis=0), 2, height[:, None], axis=-1)
    uv = np.stack(np.meshgrid(turn * _tiles_around(radius, scale), height / scale), axis=-1)
    parts = [(wall.reshape(-1, 3), _triangles(wall), uv.reshape(-1, 2))]
    for end in (-1, 1):
        rings = np.linspace(1, 0, _cells(radius, spacing) + 1)[:, None, None] * circle
        cap = np.insert(rings.reshape(-1, 2), 2, end * length / 2, axis=1)
        parts.append((cap, _triangles(rings)[:, ::end], cap[:, :2] / scale))
    return _join(parts)


def _join(parts: Sequence[Surface]) -> Surface:
    first = np.cumsum([0, *(len(positions) for positions, _, _ in parts)])
    positions, faces, uv = zip(*parts, strict=True)
    moved = [part + start for part, start in zip(faces, first, strict=False)]
    return np.concatenate(positions), np.concatenate(moved), np.concatenate(uv)


def _triangles(grid: Array) -> NDArray[np.int64]:
    """Return two triangles for each cell of a grid (rows, columns, ...), counterclockwise where rows go up."""
    vertex = np.arange(grid.shape[0] * grid.shape[1]).reshape(grid.shape[:2])
    a, b, c, d = (part.reshape(-1) for part in (vertex[:-1, :-1], vertex[:-1, 1:], vertex[1:, 1:], vertex[1:, :-1]))
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def _cells(length: float, spacing: float) -> int:
    return max(1, math.ceil(length / spacing))


def _circle(radius: float, spacing: float) -> tuple[Array, Array]:
    """Return turns (N + 1,) from -0.5 to 0.5 and points (N + 1, 2) of a circle, N even; the last point is the first."""
    sides = max(_MIN_SIDES, math.pi / math.acos(1 - _MAX_SAGITTA / radius), _cells(2 * math.pi * radius, spacing))
    turn = np.linspace(-0.5, 0.5, 2 * math.ceil(sides / 2) + 1)
    circle = radius * np.stack([np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)], axis=1)
    circle[-1] = circle[0]
    return turn, circle


def _tiles_around(radius: float, scale: float) -> float:
    """Return the number of tiles around a circle, which is whole so that no seam shows."""
    return float(max(1, np.rint(2 * np.pi * radius / scale)))
