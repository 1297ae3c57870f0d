"""Surfaces that several scenes share, and furniture made of boxes. Fronts face -y."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from aenerf_ns.simulator import textures as tx
from benchmarks.scenes.assets import Library
from benchmarks.scenes.meshes import Material, Model, colored_copy, paint
from benchmarks.scenes.shapes import box, disc, rectangle, revolved

_BOOK_COLORS = ("8c3b32", "35608c", "4a7a4f", "b98a3a", "6f4a7a", "a8a090", "396b73", "a35f3a")


def oak() -> Material:
    return paint("oak", tx.wood, ["a3754a", "b98a5c", "cda675"])


def walnut() -> Material:
    return paint("walnut", tx.wood, ["6b452c", "83583a", "9a6e4c"])


def white_paint() -> Material:
    return paint("white paint", tx.mottled, ["cfcac0", "d8d4cb", "e0ddd6"], 0.03)


def steel() -> Material:
    return paint("steel", tx.mottled, ["7d8288", "8f949a", "a5aab0"], 0.06)


def podium(radius: float, height: float, top: Material, side: Material, tile: float = 0.8) -> Model:
    """Make a round platform whose top is at z = 0."""
    return disc(radius, 0, top, tile) + revolved([(0, -height), (radius, -height), (radius, 0)], side, tile)


def books(width: float, depth: float, height: float, seed: int, fill: float = 1.0) -> Model:
    """Make a row of books that stands on z = 0, its spines at y = 0, from x = 0 to at most ``fill`` of the width."""
    rng = np.random.default_rng(seed)
    spine = paint("book spine", tx.book_spine, size=128)
    cover = paint("book cover", tx.mottled, ["9a968c", "b0aca2"], size=64)
    pages = paint("pages", tx.mottled, ["cbbf9f", "d8cfb4"], 0.1, size=64)
    row: list[Model] = []
    x = 0.0
    while True:
        thick, tall = rng.uniform(0.018, 0.05), height * rng.uniform(0.68, 0.92)
        deep, set_back = depth * rng.uniform(0.7, 0.9), rng.uniform(0, 0.02)
        if x + thick > width * fill:
            return sum(row, Model())
        color = tx.linear_color(_BOOK_COLORS[rng.integers(len(_BOOK_COLORS))]) / tx.linear_color("b0aca2")
        low, high = np.array([x, set_back, 0]), np.array([x + thick, set_back + deep, tall])
        row.append(box(low, high, colored_copy(cover, color), without="yzZ"))
        row.append(rectangle((x, set_back, 0), (thick, 0, 0), (0, 0, tall), colored_copy(spine, color)))
        row.append(rectangle((x, set_back, tall), (thick, 0, 0), (0, deep, 0), pages, 0.2))
        x += thick + 0.0015


def bookcase(
    width: float, depth: float, levels: Sequence[float], wood: Material, seed: int, fill: float = 1.0, columns: int = 1
) -> Model:
    """Make a bookcase with books. ``levels`` are the heights of its boards above z = 0; the last board is its top."""
    thick, top = 0.025, levels[-1]
    sides = np.linspace(-width / 2, width / 2 - thick, columns + 1)
    parts = [box((x, -depth / 2, 0), (x + thick, depth / 2, top), wood) for x in sides]
    parts.append(
        box((-width / 2 + thick, depth / 2 - 0.012, 0.001), (width / 2 - thick, depth / 2 - 0.001, top - 0.001), wood)
    )
    for k, level in enumerate(levels):
        for column, (low, high) in enumerate(zip(sides[:-1] + thick, sides[1:], strict=True)):
            parts.append(box((low, -depth / 2 + 0.004, level - thick), (high, depth / 2 - 0.012, level), wood))
            if k + 1 < len(levels):
                room = levels[k + 1] - thick - level
                row = books(high - low - 0.004, depth - 0.03, room, seed + 16 * k + column, fill)
                parts.append(row.moved((low + 0.002, -depth / 2 + 0.01, level)))
    return sum(parts, Model())


def framed_picture(width: float, height: float, canvas: Material, frame: Material, border: float = 0.05) -> Model:
    """Make a picture whose back lies in the plane y = 0, its middle at the origin."""
    x, z, b = width / 2, height / 2, border
    return (
        box((-x - b, -0.04, -z - b), (-x, 0, z + b), frame, 0.3)
        + box((x, -0.04, -z - b), (x + b, 0, z + b), frame, 0.3)
        + box((-x, -0.04, z), (x, 0, z + b), frame, 0.3)
        + box((-x, -0.04, -z - b), (x, 0, -z), frame, 0.3)
        + rectangle((-x, -0.015, -z), (width, 0, 0), (0, 0, height), canvas)
    )


def wall(
    width: float,
    height: float,
    material: Material,
    tile: float,
    openings: Sequence[tuple[float, float, float, float]] = (),
    reveal: Material | None = None,
) -> Model:
    """Make a wall in the plane y = 0 from x = 0, z = 0, with openings (x, x, z, z) side by side, 0.15 m deep.

    With ``reveal`` the openings get inner sides of that material.
    """
    parts = []

    def piece(x0: float, x1: float, z0: float, z1: float) -> None:
        if x1 - x0 > 1e-9 and z1 - z0 > 1e-9:
            part = rectangle((x0, 0, z0), (x1 - x0, 0, 0), (0, 0, z1 - z0), material, tile)
            # The texture runs on over the whole wall.
            parts.append(part.with_texture_shifted((x0 / tile, z0 / tile)))

    end = 0.0
    for x0, x1, z0, z1 in sorted(openings):
        piece(end, x0, 0, height)
        piece(x0, x1, 0, z0)
        piece(x0, x1, z1, height)
        end = x1
        if reveal is not None:
            parts.append(box((x0, 0, z0), (x1, 0.15, z1), reveal, 0.5, without="yY").inside_out())
    piece(end, width, 0, height)
    return sum(parts, Model())


def window(width: float, height: float, material: Material, columns: int = 2, rows: int = 2) -> Model:
    """Make the bars of a window around y = 0, from x = 0, z = 0."""
    bar = 0.05
    uprights = [
        box((x, -bar / 2, 0), (x + bar, bar / 2, height), material) for x in np.linspace(0, width - bar, columns + 1)
    ]
    rails = [
        box((bar, -0.4 * bar, z), (width - bar, 0.4 * bar, z + bar), material, without="xX")
        for z in np.linspace(0, height - bar, rows + 1)
    ]
    return sum(uprights + rails, Model())


Placing = tuple[str, float, float, float]
"""Name of a model, the x and y where it is put down, and its turn in degrees."""


def furnish(scene: Model, library: Library, placings: Sequence[Placing], below: float = np.inf) -> Model:
    """Put models down on the highest surfaces lower than ``below``, so not on a ceiling or an umbrella."""
    for name, x, y, turn in placings:
        scene = scene.with_dropped(library.model(name), x, y, turn, below)
    return scene


Cladding = tuple[Material, float]
"""Material of a surface, and the side of its texture's tiles in meters."""
Wall = tuple[Any, ...]
"""Arguments of `wall` from the material on."""


def room(
    low: tuple[float, float],
    high: tuple[float, float],
    height: float,
    walls: Sequence[Wall],
    floor: Cladding,
    ceiling: Cladding,
) -> Model:
    """Make a room. The order of the walls is far (+y), right (+x), near (-y), left (-x)."""
    (x0, y0), (x1, y1) = low, high
    wide, deep = x1 - x0, y1 - y0
    corners = ((x0, y1, 0, 0), (x1, y1, 0, -90), (x1, y0, 0, 180), (x0, y0, 0, 90))
    parts = [
        wall(width, height, *cladding).moved(corner[:3], corner[3])
        for width, cladding, corner in zip((wide, deep, wide, deep), walls, corners, strict=True)
    ]
    parts.append(rectangle((0, 0, 0), (wide, 0, 0), (0, deep, 0), *floor).moved((x0, y0, 0)))
    parts.append(rectangle((0, 0, 0), (wide, 0, 0), (0, -deep, 0), *ceiling).moved((x0, y1, height)))
    return sum(parts, Model())


def skirting(low: tuple[float, float], high: tuple[float, float], material: Material, height: float = 0.1) -> Model:
    """Make boards along the foot of the walls of a room."""
    (x0, y0), (x1, y1) = low, high
    t = 0.02
    return (
        box((x0, y1 - t, 0), (x1, y1, height), material, without="xXYz")
        + box((x0, y0, 0), (x1, y0 + t, height), material, without="xXyz")
        + box((x0, y0 + t, 0), (x0 + t, y1 - t, height), material, without="xyYz")
        + box((x1 - t, y0 + t, 0), (x1, y1 - t, height), material, without="XyYz")
    )


def lamp(x: float, y: float, z: float, half_size: float, radiance: Sequence[float]) -> dict[str, list[float]]:
    """Describe a square lamp that shines downwards, for a scene file."""
    sides = {"half_u": [half_size, 0, 0], "half_v": [0, -half_size, 0]}
    return {"center": [x, y, z], **sides, "radiance": list(radiance)}
