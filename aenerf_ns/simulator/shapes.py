"""Shorthand for the primitives scenes are furnished with."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aenerf_ns.simulator.rendering.raycast import BOX, CYLINDER, RECTANGLE, SPHERE, Primitive

Array = NDArray[np.float64]


def axes(right: ArrayLike, up: ArrayLike) -> Array:
    """World-from-local rotation (3, 3) with these local x and y axes, unit and orthogonal."""
    x, y = np.asarray(right, float), np.asarray(up, float)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def turned(degrees: float) -> Array:
    """World-from-local rotation (3, 3) about the vertical."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


ALONG_X = axes((0, 1, 0), (0, 0, 1))
ALONG_Y = axes((0, 0, 1), (1, 0, 0))
"""Rotations that lay a cylinder along a world axis."""


def box(low: ArrayLike, high: ArrayLike, texture: str, scale: float, **rest: Any) -> Primitive:
    """A box between two corners."""
    low_corner, high_corner = np.asarray(low, float), np.asarray(high, float)
    return Primitive(BOX, (low_corner + high_corner) / 2, (high_corner - low_corner) / 2, texture, scale, **rest)


def turned_box(
    centre: ArrayLike, size: ArrayLike, degrees: float, texture: str, scale: float, **rest: Any
) -> Primitive:
    """A box turned about the vertical."""
    return Primitive(BOX, centre, np.asarray(size) / 2, texture, scale, rotation=turned(degrees), **rest)


def sphere(centre: ArrayLike, radius: float, texture: str, scale: float, **rest: Any) -> Primitive:
    """A sphere. Its tilted axis keeps the poles of the texture at the sides, away from views from above."""
    return Primitive(SPHERE, centre, (radius,) * 3, texture, scale, rotation=axes((0, 0.6, 0.8), (1, 0, 0)), **rest)


def pillar(foot: ArrayLike, radius: float, height: float, texture: str, scale: float, **rest: Any) -> Primitive:
    """An upright cylinder that stands on ``foot``."""
    centre = np.add(foot, (0.0, 0.0, height / 2))
    return Primitive(CYLINDER, centre, (radius, radius, height / 2), texture, scale, **rest)


def rod(
    centre: ArrayLike, radius: float, length: float, along: Array, texture: str, scale: float, **rest: Any
) -> Primitive:
    """A lying cylinder; ``along`` is ALONG_X or ALONG_Y."""
    return Primitive(CYLINDER, centre, (radius, radius, length / 2), texture, scale, rotation=along, **rest)


def panel(
    centre: ArrayLike,
    size: tuple[float, float],
    right: ArrayLike,
    up: ArrayLike,
    texture: str,
    scale: float,
    **rest: Any,
) -> Primitive:
    """A rectangle (width, height), visible from the side from which ``right`` and ``up`` look so."""
    half = (size[0] / 2, size[1] / 2, 0.0)
    return Primitive(RECTANGLE, centre, half, texture, scale, rotation=axes(right, up), **rest)
