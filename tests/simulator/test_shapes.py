"""The shapes of the built-in scenes against closed forms."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
import trimesh
from helpers.small_meshes import BLACK, OVERHEAD

from aenerf_ns.simulator import shapes
from aenerf_ns.simulator.rendering.lighting import baked_mesh
from aenerf_ns.simulator.rendering.mesh import normals_and_areas
from aenerf_ns.simulator.rendering.mesh_repair import without_degenerate_faces

pytestmark = pytest.mark.usefixtures("small_work")

WHITE = {"white": np.full((8, 8, 3), 0.5, np.float32)}
ORIGIN = (0, 0, 0)
SOLIDS = {
    "panel": shapes.panel(ORIGIN, (1.6, 1.2), (1, 0, 0), (0, 1, 0), "white", 0.3),
    "box": shapes.box((-0.5, -0.4, -0.3), (0.5, 0.4, 0.3), "white", 0.3),
    "sphere": shapes.sphere(ORIGIN, 0.7, "white", 0.3),
    "cylinder": shapes.pillar((0, 0, -0.4), 0.6, 0.8, "white", 0.3),
}


@pytest.mark.parametrize(
    ("kind", "size", "distance"),
    [
        ("panel", (1.6, 1.2, 0), lambda x, y, z: 1 + abs(z)),
        ("box", (1, 0.8, 0.6), lambda x, y, z: np.max([abs(x) / 0.5, abs(y) / 0.4, abs(z) / 0.3], 0)),
        ("sphere", (1.4, 1.4, 1.4), lambda x, y, z: np.hypot(np.hypot(x, y), z) / 0.7),
        ("cylinder", (1.2, 1.2, 0.8), lambda x, y, z: np.maximum(np.hypot(x, y) / 0.6, abs(z) / 0.4)),
    ],
)
def test_corners_lie_on_the_turned_solid(kind: str, size: tuple[float, ...], distance: Callable) -> None:
    rotation = np.linalg.qr(np.random.default_rng(len(kind)).normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    center = np.array([0.1, -0.2, 0.3])
    mesh = shapes.mesh_of([dataclasses.replace(SOLIDS[kind], center=center, rotation=rotation)], WHITE, 0.1)
    corners = (mesh.vertices - center) @ rotation
    # In units of the surface's own.
    np.testing.assert_allclose(distance(*corners.T), 1, atol=1e-6)
    np.testing.assert_allclose(np.ptp(corners, axis=0), size, atol=0.01)


@pytest.mark.parametrize(
    ("kind", "volume", "area"),
    [
        ("box", 0.48, 2 * (0.8 + 0.6 + 0.48)),
        ("sphere", 4 / 3 * math.pi * 0.343, 4 * math.pi * 0.49),
        ("cylinder", math.pi * 0.36 * 0.8, 2 * math.pi * 0.6 * 1.4),
    ],
)
def test_solids_are_closed(kind: str, volume: float, area: float) -> None:
    mesh = without_degenerate_faces(shapes.mesh_of([SOLIDS[kind]], WHITE, 0.07))
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume == pytest.approx(volume, rel=3e-3)
    assert normals_and_areas(mesh)[1].sum() == pytest.approx(area, rel=3e-3)
    edges = mesh.vertices[mesh.faces] - mesh.vertices[np.roll(mesh.faces, 1, axis=1)]
    assert np.linalg.norm(edges, axis=-1).max() <= math.sqrt(2) * 0.07 + 1e-6


def test_texture_coordinates() -> None:
    """A linear ramp along u, seen head-on: the value at each pixel's center, half texels and all."""
    ramp = np.repeat(np.repeat(np.linspace(0.1, 0.8, 64)[None, :, None], 64, axis=0), 3, axis=2).astype(np.float32)
    plate = shapes.panel(ORIGIN, (2, 2), (1, 0, 0), (0, 1, 0), "ramp", 2.0, texture_offset=(0.5, 0.5), tint=(1, 0.5, 0))
    scene = baked_mesh(shapes.mesh_of([plate], {"ramp": ramp}, 0.3), BLACK)
    radiance, depth = scene.render(OVERHEAD, (30.0, 30.0, 8.0, 6.0), 16, 12, 1)
    np.testing.assert_allclose(depth, 3.0, rtol=1e-6)
    x = (np.arange(16) + 0.5 - 8.0) / 30.0 * 3.0
    texel = (x / 2 + 0.5) * 64 - 0.5
    expected = np.broadcast_to(0.1 + 0.7 * texel / 63, (12, 16))
    np.testing.assert_allclose(radiance[..., 0], expected, atol=2e-5)
    np.testing.assert_allclose(radiance, expected[..., None] * [1, 0.5, 0], atol=2e-5)


@pytest.mark.parametrize(("kind", "radius"), [("cylinder", 0.6), ("sphere", 0.7)])
def test_texture_has_no_seam(kind: str, radius: float) -> None:
    """The texture goes round a whole number of times, so vertices in one place have one place in the tile."""
    positions, _, uv = SOLIDS[kind].surface(0.1)
    flat_caps = abs(positions[:, 2]) > 0.4 - 1e-9 if kind == "cylinder" else np.hypot(*positions.T[:2]) < 1e-9
    wall = np.flatnonzero(~flat_caps)
    order = wall[np.lexsort(positions[wall].T)]
    same = (positions[order][1:] == positions[order][:-1]).all(axis=1)
    assert same.sum() > 5
    turns = np.abs(np.diff(uv[order], axis=0)[same])
    np.testing.assert_allclose(turns, np.tile([round(2 * math.pi * radius / 0.3), 0.0], (len(turns), 1)), atol=1e-9)
