"""The built-in object: a toy steam locomotive on a piece of track, within 1.2 m of the origin."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from aenerf_ns.simulator import textures as tx
from aenerf_ns.simulator.arrays import Texture
from aenerf_ns.simulator.rendering.environment import sky
from aenerf_ns.simulator.rendering.lighting import AreaLight, light_mesh
from aenerf_ns.simulator.rendering.mesh import Gloss
from aenerf_ns.simulator.rendering.mesh_repair import repair
from aenerf_ns.simulator.rendering.renderer import Renderer
from aenerf_ns.simulator.shapes import ALONG_X, ALONG_Y, Shape, box, mesh_of, pillar, rod, rotated_box, sphere

TEXTURE_SIZE = 256
BACKGROUND = np.array([0.5, 0.5, 0.5])
RAIL = 0.3
"""Distance of the rails from the middle, in meters."""

_VARNISH, _METAL = Gloss(0.06, 0.15), Gloss(0.6, 0.2)
_COATS = {
    **dict.fromkeys(("green", "red", "blue", "cream", "stripes", "spokes", "checker"), _VARNISH),
    **dict.fromkeys(("brass", "steel"), _METAL),
}
"""Coats of the shiny locomotive, by the textures that they cover. Gravel, wood and coal are diffuse."""


def locomotive_scene(seed: int, *, shiny: bool) -> Renderer:
    """Build and light the locomotive, in front of gray. The seed moves the patterns of the textures.

    If ``shiny``, its paint is varnished and its metal polished. Highlights clip at a radiance of 1.
    """
    rng = np.random.default_rng(seed)
    shapes = [*_track(), *_wheels(), *_frame(), *_boiler(), *_cab(), *_tender()]
    lamp = AreaLight((2.0, -2.4, 3.6), (-0.42, 0.5, 0.75), (0.85, 0.7, 0.0), (8.4, 7.9, 7.1))
    above = sky((0.3, 0.28, 0.26), (0.62, 0.66, 0.74))
    mesh, _ = repair(mesh_of(shapes, _textures(rng), spacing=0.03, gloss=_COATS if shiny else {}), math.inf)
    return replace(light_mesh(mesh, above, [lamp], BACKGROUND, ambient=0.08, seed=seed), limit=1.0)


def _textures(rng: np.random.Generator) -> dict[str, Texture]:
    n = TEXTURE_SIZE
    return {
        "gravel": tx.mottled(n, rng, ["8a7f70", "b0a592", "cfc6b4"], 0.2),
        "wood": tx.wood(n, rng, ["7d5636", "a3754a", "c39a66"]),
        "steel": tx.mottled(n, rng, ["6c7178", "8d939a", "b4b9be"], 0.1),
        "brass": tx.mottled(n, rng, ["b8862f", "dcae4f", "f0d080"], 0.1),
        "green": tx.mottled(n, rng, ["2f6b45", "43885a", "6aa878"], 0.1),
        "red": tx.mottled(n, rng, ["a83228", "c24a38", "d97a5c"], 0.1),
        "blue": tx.fabric(n, rng, ["2f4f8f", "4a70b5", "86a8d8"]),
        "cream": tx.mottled(n, rng, ["d9c8a0", "eadfc0", "f4eedc"], 0.1),
        "coal": tx.mottled(n, rng, ["3a3a3f", "55555c", "80808a"], 0.2),
        "stripes": tx.striped_wallpaper(n, rng, ["d9a43f", "3f3f46", "e8c26a", "a8463f"]),
        "checker": tx.checker(n, rng, ["55555c", "c9c3b4"]),
        "spokes": _spokes(n, rng),
    }


def _spokes(size: int, rng: np.random.Generator) -> Texture:
    """Paint the face of a wheel that fills the tile: rim and spokes on a dark ground."""
    axis = (np.arange(size) + 0.5) / size - 0.5
    radius, angle = np.hypot(axis[None, :], axis[:, None]), np.arctan2(axis[:, None], axis[None, :])
    light = np.clip((np.abs(np.sin(4 * angle)) * radius - 0.10) * -40 + 0.5, 0, 1)
    light = np.maximum(light, np.clip((radius - 0.36) * 60 + 0.5, 0, 1))
    dark, bright = tx.linear_color("4a2a28"), tx.linear_color("c8503c")
    return tx.albedo(dark + light[..., None] * (bright - dark), 0.08 * tx.spectral_noise(size, rng))


def _track() -> Iterator[Shape]:
    yield box((-1.15, -0.55, -0.62), (1.15, 0.55, -0.58), "gravel", 0.5)
    for k in range(9):
        x = -1.04 + 0.26 * k
        yield box((x - 0.06, -0.46, -0.579), (x + 0.06, 0.46, -0.52), "wood", 0.3)
    for y in (-RAIL, RAIL):
        yield box((-1.14, y - 0.03, -0.519), (1.14, y + 0.03, -0.47), "steel", 0.3)


def _wheels() -> Iterator[Shape]:
    for x, radius in ((-0.88, 0.13), (-0.56, 0.13), (-0.16, 0.2), (0.28, 0.2), (0.68, 0.13)):
        z = -0.47 + radius
        yield rod((x, 0, z), 0.025, 0.6, ALONG_Y, "steel", 0.2)
        for side in (-1, 1):
            yield rod((x, side * RAIL, z), radius, 0.07, ALONG_Y, "spokes", 2 * radius, texture_offset=(0.5, 0.5))
            yield rod((x, side * (RAIL + 0.045), z), 0.045, 0.03, ALONG_Y, "brass", 0.2)
    for side in (-1, 1):
        y = side * (RAIL + 0.075)
        yield box((-0.22, y - 0.012, -0.2), (0.62, y + 0.012, -0.155), "steel", 0.2)
        yield rod((0.72, side * 0.36, -0.17), 0.085, 0.26, ALONG_X, "red", 0.3)
        yield rod((0.72, side * 0.36, -0.17), 0.05, 0.3, ALONG_X, "brass", 0.2)


def _frame() -> Iterator[Shape]:
    yield box((-0.36, -0.3, -0.12), (0.98, 0.3, -0.05), "red", 0.4)
    yield box((0.98, -0.4, -0.24), (1.04, 0.4, -0.03), "stripes", 0.3)
    for side in (-1, 1):
        yield rod((1.075, side * 0.27, -0.13), 0.035, 0.07, ALONG_X, "steel", 0.2)
        yield rod((1.12, side * 0.27, -0.13), 0.075, 0.025, ALONG_X, "brass", 0.2)
        yield sphere((1.0, side * 0.3, 0.06), 0.07, "cream", 0.3)
    for k in range(3):
        yield rotated_box((1.04 - 0.02 * k, 0, -0.3 - 0.06 * k), (0.05, 0.5 + 0.1 * k, 0.05), 0, "red", 0.3)


def _boiler() -> Iterator[Shape]:
    yield rod((0.35, 0, 0.2), 0.26, 1.1, ALONG_X, "green", 0.55)
    yield rod((0.92, 0, 0.2), 0.235, 0.06, ALONG_X, "steel", 0.3)
    yield rod((0.955, 0, 0.2), 0.12, 0.03, ALONG_X, "brass", 0.25)
    yield pillar((0.74, 0, 0.42), 0.085, 0.3, "steel", 0.3)
    yield pillar((0.74, 0, 0.72), 0.13, 0.09, "red", 0.3)
    yield pillar((0.74, 0, 0.811), 0.10, 0.02, "brass", 0.2)
    yield pillar((0.38, 0, 0.44), 0.11, 0.1, "green", 0.3)
    yield sphere((0.38, 0, 0.54), 0.112, "brass", 0.3)
    yield pillar((0.05, 0, 0.44), 0.06, 0.1, "brass", 0.2)
    yield sphere((0.05, 0, 0.56), 0.055, "red", 0.2)
    yield box((0.86, -0.07, 0.46), (0.98, 0.07, 0.6), "red", 0.2)
    yield rod((0.985, 0, 0.53), 0.055, 0.03, ALONG_X, "cream", 0.2)
    for x in (-0.1, 0.2, 0.56, 0.84):
        yield rod((x, 0, 0.2), 0.268, 0.035, ALONG_X, "brass", 0.2)
    for side in (-1, 1):
        yield rod((0.4, side * 0.29, 0.3), 0.014, 0.98, ALONG_X, "steel", 0.2)
        yield box((-0.2, side * 0.33 - 0.1, -0.049), (0.9, side * 0.33 + 0.1, -0.02), "checker", 0.24)


def _cab() -> Iterator[Shape]:
    yield box((-0.66, -0.38, -0.12), (-0.2, 0.38, -0.04), "red", 0.4)
    for side in (-1, 1):
        wall, (near, far) = side * 0.36, sorted((side * 0.375, side * 0.375 + side * 0.01))
        yield box((-0.62, wall - 0.015, -0.04), (-0.201, wall + 0.015, 0.36), "green", 0.4)
        yield box((-0.53, near, 0.04), (-0.29, far, 0.26), "cream", 0.3)
        for x in (-0.6, -0.22):
            yield box((x - 0.019, wall - 0.014, 0.361), (x + 0.019, wall + 0.014, 0.66), "green", 0.4)
    yield box((-0.2, -0.36, -0.04), (-0.17, 0.36, 0.44), "green", 0.4)
    yield box((-0.72, -0.46, 0.661), (-0.1, 0.46, 0.70), "red", 0.4)
    yield box((-0.66, -0.34, 0.701), (-0.16, 0.34, 0.74), "stripes", 0.3)
    yield rod((-0.23, 0, 0.3), 0.12, 0.05, ALONG_X, "brass", 0.25)
    yield sphere((-0.45, 0.14, 0.36), 0.1, "cream", 0.25)
    yield pillar((-0.45, 0.14, -0.04), 0.11, 0.32, "blue", 0.3)
    yield pillar((-0.45, 0.14, 0.43), 0.075, 0.06, "blue", 0.3)


def _tender() -> Iterator[Shape]:
    yield box((-1.1, -0.36, -0.14), (-0.68, 0.36, -0.05), "red", 0.4)
    yield box((-1.1, -0.34, -0.049), (-0.72, 0.34, 0.06), "wood", 0.4)
    yield box((-1.1, -0.36, 0.061), (-1.06, 0.36, 0.3), "green", 0.4)
    yield box((-0.76, -0.36, 0.061), (-0.72, 0.36, 0.3), "green", 0.4)
    yield box((-1.059, -0.36, 0.061), (-0.761, -0.32, 0.3), "green", 0.4)
    yield box((-1.059, 0.32, 0.061), (-0.761, 0.36, 0.3), "green", 0.4)
    for k in range(10):
        x, y = -0.98 + 0.14 * (k % 2) + 0.02 * (k % 3), -0.25 + 0.125 * (k // 2)
        degrees, size = 37.0 * k, 0.13 + 0.012 * (k % 4)
        yield rotated_box((x, y, 0.22 + 0.013 * (k % 5)), (size, size, 0.16), degrees, "coal", 0.25)
