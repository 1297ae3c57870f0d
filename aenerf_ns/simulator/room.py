"""The built-in room: 4 x 4 x 2.5 m, furnished, textured everywhere, and closed, so that every ray hits something."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from aenerf_ns.simulator import textures as tx
from aenerf_ns.simulator.arrays import Texture
from aenerf_ns.simulator.rendering.environment import sky
from aenerf_ns.simulator.rendering.lighting import AreaLight, light_mesh
from aenerf_ns.simulator.rendering.mesh_repair import repair
from aenerf_ns.simulator.rendering.renderer import Renderer
from aenerf_ns.simulator.shapes import ALONG_X, Shape, axes, box, mesh_of, panel, pillar, rod, rotated_box, sphere

TEXTURE_SIZE = 256
HALF_SIZE = 2.0
HEIGHT = 2.5

BOOK_COLORS = ("b5523b", "d9a441", "4f7a5b", "3f6d8e", "8c4a6b", "e0d3b0", "6b7f3a", "c9772e", "5a5fa0", "a8463f")


def room_scene(seed: int) -> Renderer:
    """Furnish and light the room. The seed moves the patterns of the textures, and which book stands where."""
    rng = np.random.default_rng(seed)
    shapes = [*_shell(), *_window(), *_pictures(), *_table(), *_bookshelf(rng), *_sofa(), *_cabinet(), *_corners()]
    lights = [
        AreaLight((0, 0, HEIGHT - 0.09), (0.45, 0, 0), (0, -0.45, 0), (8.8, 8.4, 7.8)),
        # This lamp is in front of curtains and sill, which would be too bright right beside it.
        AreaLight((0.2, -1.75, 1.5), (-0.6, 0, 0), (0, 0, 0.4), (4.5, 5.0, 5.7)),
        AreaLight((1.72, 0.95, 0.99), (0.1, 0, 0), (0, -0.1, 0), (1.2, 0.9, 0.6)),
    ]
    darkness = sky((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    mesh, _ = repair(mesh_of(shapes, _textures(rng), spacing=0.08), math.inf)
    return light_mesh(mesh, darkness, lights, background=None, ambient=0.09, seed=seed)


def _textures(rng: np.random.Generator) -> dict[str, Texture]:
    n = TEXTURE_SIZE
    return {
        "floor": tx.planks(n, rng, ["a87c50", "b98d5c", "c9a06c"]),
        "ceiling": tx.planks(n, rng, ["d4cdbf", "dfd9cc", "e8e2d7"], rows=6, columns=1),
        "brick": tx.bricks(n, rng, ["b5705a", "c07e66", "cb917a"], "c9b39d"),
        "stripes": tx.striped_wallpaper(n, rng, ["8fb0ae", "d6c9a8", "a9c0b8", "ddd3b8"]),
        "leaves": tx.leafy_wallpaper(n, rng, "cfc6a2", ["8fa56c", "7a9a78", "c2a05c", "aeb878"]),
        "plaster": tx.mottled(n, rng, ["d0aa82", "dcba92", "e4caa4"]),
        "rug": tx.rug(n, rng, ["8f4a4c", "a8605a", "5f7890", "ccb892"]),
        "wood": tx.wood(n, rng, ["94653f", "a9774a", "be8e59"]),
        "pale wood": tx.wood(n, rng, ["bd9864", "ceab78", "d9bb8a"]),
        "fabric": tx.fabric(n, rng, ["4d8098", "6199b0", "82b2c2"]),
        "warm fabric": tx.fabric(n, rng, ["c07a44", "d09450", "dfb070"]),
        "marble": tx.mottled(n, rng, ["98989c", "cfccc6", "b0aead", "ddd9d2"]),
        "jade": tx.mottled(n, rng, ["4a8a70", "6aa585", "93bd92", "58957c"]),
        "checker": tx.checker(n, rng, ["c4705a", "dcc9a8"]),
        "book": tx.book_spine(n, rng),
        "landscape": tx.landscape(n, rng, ["f3dcae", "e8b98a", "7fb0cf"], ["8fa6b8", "6f9a7f", "4f7f4f", "8f8a3f"]),
        "seascape": tx.landscape(n, rng, ["f7efd8", "a9d3e3", "5f9fd0"], ["5f8fb5", "3f7f9f", "d9c08a"]),
        "abstract": tx.abstract(n, rng, "e6dcc3", ["c0452f", "2f5f8f", "e0a83a", "3f3f46", "5f8f6f"]),
        "garden": tx.landscape(n, rng, ["e9f3fb", "cfe6f7", "9cc9ee"], ["a9c9a0", "8fb86a", "6f9f4f"]),
    }


# The direction "right" of a viewer who faces each wall.
NORTH, EAST, SOUTH, WEST = (1, 0, 0), (0, -1, 0), (-1, 0, 0), (0, 1, 0)


def _shell() -> Iterator[Shape]:
    h, z = HALF_SIZE, HEIGHT
    east, north, south = (1, 0, 0), (0, 1, 0), (0, -1, 0)
    yield panel((0, 0, 0), (2 * h, 2 * h), east, north, "floor", 1.2)
    yield panel((0, 0, z), (2 * h, 2 * h), east, south, "ceiling", 1.0)
    yield box((-0.5, -0.5, z - 0.08), (0.5, 0.5, z - 0.001), "pale wood", 1.0)
    yield panel((0, 0, z - 0.085), (0.9, 0.9), east, south, "marble", 0.9, emission=0.5)
    yield box((-1.15, -0.8, 0.001), (1.15, 0.8, 0.012), "warm fabric", 0.5)
    yield panel((0, 0, 0.0135), (2.2, 1.5), east, north, "rug", 2.2, texture_offset=(0.5, 0.5))
    for right, (x, y), texture, scale in (
        (NORTH, (0, h), "leaves", 1.0),
        (EAST, (h, 0), "brick", 1.1),
        (SOUTH, (0, -h), "plaster", 1.3),
        (WEST, (-h, 0), "stripes", 0.9),
    ):
        yield panel((x, y, z / 2), (2 * h, z), right, (0, 0, 1), texture, scale)
    # Skirting boards.
    t = 0.02
    yield box((-h, h - t, 0), (h, h, 0.1), "pale wood", 1.0)
    yield box((-h, -h, 0), (h, -h + t, 0.1), "pale wood", 1.0)
    yield box((h - t, -h + t, 0), (h, h - t, 0.1), "pale wood", 1.0)
    yield box((-h, -h + t, 0), (-h + t, h - t, 0.1), "pale wood", 1.0)


def _framed(
    right: ArrayLike, middle: ArrayLike, size: tuple[float, float], picture: str, frame: str, **rest: float
) -> Iterator[Shape]:
    """Frame a picture on a wall. ``middle`` lies on the wall; ``rest`` goes to the `panel` of the picture."""
    rotation = axes(right, (0, 0, 1))
    width, height = size
    canvas = np.asarray(middle) + 0.02 * rotation[:, 2]
    yield panel(canvas, size, right, (0, 0, 1), picture, max(size), texture_offset=(0.5, 0.5), **rest)
    rim = 0.045
    for across, up, half_u, half_v in (
        (0, height / 2, width / 2 + rim, rim),
        (0, -height / 2, width / 2 + rim, rim),
        (width / 2, 0, rim, height / 2 - rim),
        (-width / 2, 0, rim, height / 2 - rim),
    ):
        near = np.asarray(middle) + rotation @ (across - half_u, up - half_v, 0.001)
        far = np.asarray(middle) + rotation @ (across + half_u, up + half_v, 0.04)
        yield box(np.minimum(near, far), np.maximum(near, far), frame, 0.6)


def _window() -> Iterator[Shape]:
    yield from _framed(SOUTH, (0.2, -HALF_SIZE, 1.5), (1.3, 1.1), "garden", "pale wood", emission=0.45)
    yield box((0.18, -2.0, 1.0), (0.22, -1.965, 2.0), "pale wood", 0.6)
    yield box((-0.42, -1.999, 1.53), (0.82, -1.97, 1.57), "pale wood", 0.6)
    yield box((-0.6, -2.0, 0.85), (1.0, -1.82, 0.9), "marble", 0.8)
    # Curtains: rows of pillars make their folds.
    for k in range(4):
        for side in (-0.62, 1.02):
            yield pillar((side + (k - 1.5) * 0.085, -1.94, 0.35), 0.045, 1.9, "warm fabric", 0.45)
    yield rod((0.2, -1.94, 2.29), 0.02, 2.2, ALONG_X, "wood", 0.5)


def _pictures() -> Iterator[Shape]:
    yield from _framed(WEST, (-2.0, 0.25, 1.62), (1.15, 0.75), "landscape", "wood")
    yield from _framed(WEST, (-2.0, -1.15, 1.6), (0.55, 0.7), "abstract", "pale wood")
    yield from _framed(EAST, (2.0, 0.0, 1.7), (0.8, 0.8), "abstract", "wood")
    yield from _framed(EAST, (2.0, -1.2, 1.55), (0.7, 0.5), "seascape", "pale wood")
    yield from _framed(NORTH, (1.35, 2.0, 1.65), (0.7, 0.85), "seascape", "wood")


def _table() -> Iterator[Shape]:
    top = 0.72
    yield box((-0.55, -0.4, 0.68), (0.55, 0.4, top), "wood", 0.8, spacing=0.03)
    for x in (-0.48, 0.48):
        for y in (-0.33, 0.33):
            yield pillar((x, y, 0.012), 0.035, 0.668, "wood", 0.4)
    yield sphere((-0.3, 0.12, top + 0.13), 0.13, "jade", 0.4)
    yield sphere((-0.1, -0.22, top + 0.075), 0.075, "checker", 0.24)
    yield pillar((0.12, 0.14, top), 0.085, 0.24, "marble", 0.3)
    yield pillar((0.12, 0.14, top + 0.24), 0.05, 0.07, "marble", 0.3)
    yield sphere((0.12, 0.14, top + 0.37), 0.085, "leaves", 0.35)
    yield pillar((0.38, -0.2, top), 0.045, 0.1, "stripes", 0.15, tint=(1.0, 0.8, 0.7))
    stack = ((0.0, 0.30, 0.21, "3f6d8e", 12), (0.035, 0.27, 0.19, "b5523b", -9), (0.075, 0.24, 0.18, "d9a441", 27))
    for lift, long, wide, color, degrees in stack:
        center, tint = (0.33, 0.1, top + lift + 0.0175), tx.linear_color(color) * 1.1
        yield rotated_box(center, (long, wide, 0.0344), degrees, "book", 0.3, tint=tint)


def _bookshelf(rng: np.random.Generator) -> Iterator[Shape]:
    left, right, front, back, top = -1.55, 0.55, 1.70, 1.999, 1.98
    board = 0.03
    yield box((left, front, 0), (left + board, back, top), "wood", 0.9)
    yield box((right - board, front, 0), (right, back, top), "wood", 0.9)
    yield box((left + board, back - 0.015, 0.0), (right - board, back, top), "wood", 0.7, tint=(0.85, 0.85, 0.85))
    shelves = np.linspace(0.06, top - board, 6)
    for z in shelves:
        yield box((left + board, front + 0.002, z), (right - board, back - 0.015, z + board), "pale wood", 0.9)
    for row, z in enumerate(shelves[:-1]):
        clear = shelves[row + 1] - z - board
        x = left + board + 0.01
        gap_at = rng.uniform(0.3, 0.6) * (right - left) + left
        ornament = ("jade", "marble", "checker")[row % 3]
        while x < right - board - 0.1:
            if x > gap_at:
                radius = 0.4 * clear
                yield sphere((x + 0.15, front + 0.14, z + board + radius), radius, ornament, 0.3)
                x, gap_at = x + 0.31, right
                continue
            width = rng.uniform(0.045, 0.085)
            height, depth = clear * rng.uniform(0.66, 0.93), rng.uniform(0.16, 0.22)
            color = 0.08 + 0.8 * tx.linear_color(BOOK_COLORS[rng.integers(len(BOOK_COLORS))])
            low, high = (x, back - 0.03 - depth, z + board), (x + width, back - 0.03, z + board + height)
            yield box(low, high, "book", 0.36, tint=color * 1.1, texture_offset=(float(rng.random()), 0.5))
            x += width + 0.004


def _sofa() -> Iterator[Shape]:
    yield box((-1.9, -0.85, 0.1), (-1.2, 0.95, 0.36), "fabric", 0.5)
    yield box((-1.97, -0.85, 0.1), (-1.72, 0.95, 0.82), "fabric", 0.5)
    yield box((-1.92, -1.03, 0.1), (-1.18, -0.852, 0.6), "fabric", 0.5)
    yield box((-1.92, 0.952, 0.1), (-1.18, 1.13, 0.6), "fabric", 0.5)
    for low, high in ((-0.84, 0.045), (0.055, 0.94)):
        yield box((-1.715, low, 0.362), (-1.17, high, 0.47), "fabric", 0.4, tint=(1.15, 1.1, 1.05))
    for y, texture, lean in ((-0.55, "warm fabric", 15), (0.62, "checker", -12)):
        yield rotated_box((-1.6, y, 0.65), (0.12, 0.38, 0.34), lean, texture, 0.35)
    for x in (-1.85, -1.25):
        for y in (-0.95, 1.05):
            yield pillar((x, y, 0), 0.025, 0.1, "wood", 0.3)


def _cabinet() -> Iterator[Shape]:
    """Make a sideboard with drawers, and put a lamp and ornaments on it."""
    yield box((1.55, -0.75, 0.08), (1.98, 1.15, 0.70), "pale wood", 0.8)
    yield box((1.52, -0.78, 0.701), (1.98, 1.18, 0.735), "wood", 0.8, spacing=0.04)
    # The gaps between the drawers are dark.
    yield panel((1.5495, 0.2, 0.395), (1.84, 0.57), EAST, (0, 0, 1), "wood", 0.8, tint=(0.55, 0.55, 0.55))
    for k in range(3):
        y = -0.72 + k * 0.62
        for z in (0.11, 0.41):
            yield box((1.535, y, z), (1.549, y + 0.58, z + 0.27), "pale wood", 0.6, tint=(0.85, 0.85, 0.85))
            yield sphere((1.525, y + 0.29, z + 0.135), 0.022, "marble", 0.3)
    for y in (-0.65, 1.05):
        for x in (1.6, 1.9):
            yield pillar((x, y, 0), 0.025, 0.08, "wood", 0.3)
    top = 0.735
    yield pillar((1.72, 0.95, top), 0.07, 0.03, "wood", 0.3)
    yield pillar((1.72, 0.95, top + 0.03), 0.022, 0.25, "marble", 0.2)
    yield pillar((1.72, 0.95, top + 0.26), 0.13, 0.2, "stripes", 0.3, emission=0.4, tint=(1.0, 0.9, 0.75))
    yield sphere((1.75, 0.35, top + 0.11), 0.11, "marble", 0.35)
    yield sphere((1.74, 0.08, top + 0.07), 0.07, "jade", 0.22)
    yield pillar((1.75, -0.4, top), 0.09, 0.2, "leaves", 0.3, tint=(0.85, 0.8, 1.0))
    yield sphere((1.75, -0.4, top + 0.34), 0.17, "leaves", 0.3, tint=(0.5, 0.8, 0.4))


def _corners() -> Iterator[Shape]:
    """Make a plant, a stool and a chest in the corners."""
    yield pillar((1.55, 1.6, 0), 0.2, 0.36, "brick", 0.5)
    yield pillar((1.55, 1.6, 0.36), 0.03, 0.45, "wood", 0.3)
    for dx, dy, z, radius in ((0, 0, 0.98, 0.24), (0.14, -0.12, 0.78, 0.16), (-0.15, 0.08, 0.8, 0.17)):
        yield sphere((1.55 + dx, 1.6 + dy, z), radius, "leaves", 0.35, tint=(0.5, 0.8, 0.4))
    yield rotated_box((-1.45, -1.55, 0.25), (0.76, 0.52, 0.5), 12, "wood", 0.6)
    yield rotated_box((-1.45, -1.55, 0.521), (0.8, 0.56, 0.04), 12, "pale wood", 0.6)
    yield sphere((-1.4, -1.55, 0.7), 0.16, "checker", 0.5)
    yield pillar((1.45, -1.5, 0.4), 0.24, 0.06, "warm fabric", 0.4)
    for degrees in (20, 140, 260):
        x, y = 1.45 + 0.17 * np.cos(np.radians(degrees)), -1.5 + 0.17 * np.sin(np.radians(degrees))
        yield pillar((x, y, 0), 0.025, 0.4, "wood", 0.3)
