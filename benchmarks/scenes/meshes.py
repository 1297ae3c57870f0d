"""Textured triangle meshes: how they are held, put together and colored.

Lengths are in meters and the z axis points up. Corners run counter-clockwise, seen from the front of a face.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from trimesh.triangles import area as areas

from aenerf_ns.camera.image_encoding import decode, encode
from aenerf_ns.simulator.arrays import Array, Texture
from aenerf_ns.simulator.textures import ALBEDO_RANGE


@dataclass(frozen=True, eq=False)
class Material:
    """A Lambertian surface: a name that no other has, and its sRGB albedo (H, W, 3), the first row at the top."""

    name: str
    picture: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles of one material: points (F, 3, 3) and texture coordinates (F, 3, 2), v upwards."""

    points: Array
    uv: Array
    material: Material

    def select(self, keep: NDArray[np.bool_]) -> Part:
        """Return the triangles that a mask (F,) keeps."""
        return replace(self, points=self.points[keep], uv=self.uv[keep])


@dataclass(frozen=True, eq=False)
class Model:
    """Parts that move together. Every method returns a new model."""

    parts: tuple[Part, ...] = ()

    def __add__(self, other: Model) -> Model:
        return Model(self.parts + other.parts)

    @property
    def triangles(self) -> Array:
        """Corners (F, 3, 3) of the triangles of all parts."""
        return np.concatenate([part.points for part in self.parts])

    @property
    def bounds(self) -> Array:
        """Lowest and highest corner (2, 3) of the bounding box."""
        points = self.triangles.reshape(-1, 3)
        return np.array([points.min(axis=0), points.max(axis=0)])

    def moved(self, position: ArrayLike = (0, 0, 0), turn_degrees: float = 0, scale: float = 1) -> Model:
        """Scale and turn about the origin (counter-clockwise seen from above), then shift."""
        c, s = np.cos(np.radians(turn_degrees)), np.sin(np.radians(turn_degrees))
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        shift = np.asarray(position, np.float64)
        return Model(tuple(replace(part, points=scale * part.points @ turn.T + shift) for part in self.parts))

    def standing(self) -> Model:
        """Shift the lowest point to z = 0 and the middle of the bounds to x = y = 0."""
        low, high = self.bounds
        return self.moved((-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]))

    def fitted(self, half_extent: float, radius: float) -> Model:
        """Center the bounds at the origin and scale the model to the largest size within two limits, in meters.

        ``half_extent`` limits half of the longest side of the bounds, ``radius`` a ball that holds the model.
        """
        low, high = self.bounds
        center = (low + high) / 2
        reach = np.linalg.norm(self.triangles.reshape(-1, 3) - center, axis=1).max()
        scale = min(2 * half_extent / (high - low).max(), radius / reach)
        return self.moved(-scale * center, scale=scale)

    def with_texture_shifted(self, shift: tuple[float, float]) -> Model:
        """Shift all texture coordinates by (u, v)."""
        return Model(tuple(replace(part, uv=part.uv + np.array(shift)) for part in self.parts))

    def inside_out(self) -> Model:
        """Swap the front and the back of all faces."""
        return Model(tuple(replace(part, points=part.points[:, ::-1], uv=part.uv[:, ::-1]) for part in self.parts))

    def height_under(self, x: float, y: float, below: float = np.inf) -> float:
        """Return z of the highest surface at (x, y) that lies lower than ``below``.

        Raises:
            ValueError: if there is no such surface.
        """
        a, b, c = np.moveaxis(self.triangles, 1, 0)
        area = cross_2d(b - a, c - a)
        point = np.array([x, y, 0.0])
        with np.errstate(divide="ignore", invalid="ignore"):
            v, w = cross_2d(point - a, c - a) / area, cross_2d(b - a, point - a) / area
            heights = (a + v[:, None] * (b - a) + w[:, None] * (c - a))[:, 2]
            hit = (np.abs(area) > 1e-12) & (np.minimum(v, w) >= 0) & (v + w <= 1) & (heights < below)
        if not hit.any():
            raise ValueError(f"nothing lies under ({x}, {y}) below {below}")
        return float(heights[hit].max())

    def with_dropped(self, model: Model, x: float, y: float, turn_degrees: float = 0, below: float = np.inf) -> Model:
        """Put another model down at (x, y), on the highest surface lower than ``below``."""
        return self + model.standing().moved((x, y, self.height_under(x, y, below)), turn_degrees)


def paint(
    name: str, generator: Callable[..., Texture], *arguments: object, size: int = 256, **options: object
) -> Material:
    """Make a material of a generated texture (see aenerf_ns.simulator.textures). The name seeds the pattern."""
    texture = generator(size, np.random.default_rng(zlib.crc32(name.encode())), *arguments, **options)
    return Material(name, srgb_picture(texture)[::-1])


def colored_copy(material: Material, color: ArrayLike) -> Material:
    """Multiply a material's linear albedo by an RGB factor."""
    factor = np.asarray(color, np.float64)
    name = f"{material.name} * {factor.round(4).tolist()}"
    return Material(name, srgb_picture(np.clip(decode(material.picture / 255, "srgb") * factor, *ALBEDO_RANGE)))


def srgb_picture(value: ArrayLike) -> NDArray[np.uint8]:
    """Encode linear values in [0, 1], any shape, as sRGB (IEC 61966-2-1)."""
    encoded = encode(torch.from_numpy(np.asarray(value, np.float64)), "srgb")
    return np.rint(255 * encoded.numpy()).astype(np.uint8)


def cross_2d(a: Array, b: Array) -> Array:
    """Return the z component of the cross product of vectors (..., 2 or 3)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def unit_normals(triangles: Array) -> Array:
    """Return the unit normals (F, 3) of triangles (F, 3, 3)."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def longest_sides(triangles: Array) -> Array:
    """Return the length (F,) of the longest side of each triangle (F, 3, 3)."""
    return np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)


def not_degenerate(triangles: Array) -> NDArray[np.bool_]:
    """Mark triangles (F, 3, 3) whose height is more than a millionth of their longest side."""
    return areas(triangles) > 5e-7 * longest_sides(triangles) ** 2
