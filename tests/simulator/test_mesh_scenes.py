"""Meshes as scenes: pictures and light against closed forms and against the analytic ray caster, files, and paths."""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import h5py
import numba
import numpy as np
import pytest
import trimesh
from PIL import Image

from aenerf_ns.cli.simulate import Simulate
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import LUMINANCE
from aenerf_ns.simulator import paths
from aenerf_ns.simulator.frames import frame_parameters
from aenerf_ns.simulator.open_scene import open_scene
from aenerf_ns.simulator.rendering import mesh_lighting, mesh_repair
from aenerf_ns.simulator.rendering.embree import RayCaster
from aenerf_ns.simulator.rendering.environment import Environment, load_environment, sky
from aenerf_ns.simulator.rendering.light_baking import AreaLight, bake
from aenerf_ns.simulator.rendering.mesh_lighting import light_points
from aenerf_ns.simulator.rendering.mesh_loading import Mesh, load_mesh, scaled
from aenerf_ns.simulator.rendering.mesh_repair import normals_and_areas, prepared, subdivided
from aenerf_ns.simulator.rendering.mesh_scene import MeshScene
from aenerf_ns.simulator.rendering.mip_maps import mip_maps
from aenerf_ns.simulator.rendering.polygons import ear_clipping
from aenerf_ns.simulator.rendering.raycast import BOX, RECTANGLE, Primitive
from aenerf_ns.simulator.textures import linear

OVERHEAD = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 3], [0, 0, 0, 1]])
"""A camera 3 m above the origin that looks down, its x axis along the world's."""
BLACK = np.zeros(3)
NIGHT = sky(BLACK, BLACK)


@pytest.fixture(scope="module", autouse=True)
def small_work() -> Iterator[None]:
    """One thread, for pictures too small to share, and light that is computed at few points."""
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mesh_repair, "_POINTS", 2000)
        yield
    numba.set_num_threads(threads)


def baked_mesh(mesh: Mesh, background: np.ndarray) -> MeshScene:
    return mesh_lighting.baked_mesh(mesh, RayCaster(mesh.vertices, mesh.faces), background)


def light_mesh(mesh: Mesh, *rest: object, **options: bool) -> MeshScene:
    return mesh_lighting.light_mesh(mesh, RayCaster(mesh.vertices, mesh.faces), *rest, **options)


def mesh_of(shape: trimesh.Trimesh, colour: object = (0.5, 0.5, 0.5)) -> Mesh:
    colours = np.tile(np.asarray(colour, np.float64), (len(shape.vertices), 1))
    uv, texture = np.zeros((len(shape.vertices), 2)), np.full(len(shape.faces), -1)
    return scaled(Mesh(np.array(shape.vertices), np.array(shape.faces), uv, colours, texture, ()), 1.0)


def plate(half: float, picture: np.ndarray | None = None, tiles: float = 1.0) -> Mesh:
    """A square in the plane z = 0 with its front up, and a picture on it."""
    corners = half * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    uv = tiles * np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    textures = () if picture is None else (np.asarray(picture, np.float32),)
    colour = np.full((4, 3), 0.5 if picture is None else 1.0)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return scaled(Mesh(corners, faces, uv, colour, np.full(2, len(textures) - 1), textures), 1.0)


def joined(*meshes: Mesh) -> Mesh:
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, first, strict=False)]),
        np.concatenate([mesh.uv for mesh in meshes]),
        np.concatenate([mesh.colour for mesh in meshes]),
        np.concatenate([mesh.texture for mesh in meshes]),
        (),
    )


def ray_directions(intrinsics: tuple[float, ...], width: int, height: int) -> np.ndarray:
    fx, fy, cx, cy = intrinsics
    y, x = np.mgrid[:height, :width]
    return np.stack([(x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, np.ones((height, width))], axis=-1)


# --- pictures


def test_depth_and_alpha_of_a_tilted_plate() -> None:
    """Depth is that of the plane, alpha that of the square, for a camera that sees it at a slant."""
    scene = baked_mesh(plate(1.0), np.array([0.2, 0.3, 0.4]))
    pose = paths.look_at((1.5, -2.0, 1.2), (0.1, 0.2, 0.0), roll=0.3)
    intrinsics, width, height = (40.0, 44.0, 24.2, 17.7), 48, 36
    radiance, depth, alpha = scene.render(pose, intrinsics, width, height, 1)
    directions = ray_directions(intrinsics, width, height) @ pose[:3, :3].T
    expected = -pose[2, 3] / directions[..., 2]
    points = pose[:3, 3] + expected[..., None] * directions
    inside = (expected > 0) & (abs(points[..., 0]) < 1) & (abs(points[..., 1]) < 1)
    assert 200 < inside.sum() < width * height - 200
    np.testing.assert_array_equal(alpha, inside.astype(np.float32))
    np.testing.assert_allclose(depth[inside], expected[inside], rtol=3e-7)
    assert np.isinf(depth[~inside]).all()
    np.testing.assert_allclose(radiance[inside], 0.5, rtol=1e-6)
    np.testing.assert_allclose(
        radiance[~inside], np.broadcast_to([0.2, 0.3, 0.4], (int((~inside).sum()), 3)), rtol=1e-6
    )


def test_texture_coordinates_and_wrapping() -> None:
    """A picture with two different ramps, repeated: bilinear between the centres of its texels, and round its edges."""
    rng = np.random.default_rng(0)
    picture = rng.uniform(0.1, 0.9, (6, 10, 3)).astype(np.float32)
    scene = baked_mesh(plate(1.0, picture, tiles=1.5), BLACK)
    intrinsics, width, height = (60.0, 60.0, 16.0, 12.0), 32, 24
    radiance = scene.render(OVERHEAD, intrinsics, width, height, 1)[0]
    x, y = ray_directions(intrinsics, width, height)[..., :2].transpose(2, 0, 1) * [[[3.0]], [[-3.0]]]
    column, row = (0.5 + 0.5 * x) * 1.5 * 10 - 0.5, (0.5 + 0.5 * y) * 1.5 * 6 - 0.5
    i, j = np.floor(column).astype(int), np.floor(row).astype(int)
    fx, fy = (column - i)[..., None], (row - j)[..., None]

    def texel(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        return picture[rows % 6, columns % 10]

    low = (1 - fx) * texel(j, i) + fx * texel(j, i + 1)
    high = (1 - fx) * texel(j + 1, i) + fx * texel(j + 1, i + 1)
    np.testing.assert_allclose(radiance, (1 - fy) * low + fy * high, atol=2e-5)


@pytest.mark.parametrize("shape", [(64, 64), (33, 50), (7, 1)])
def test_minified_textures_keep_their_mean(shape: tuple[int, int]) -> None:
    picture = np.random.default_rng(0).uniform(0.1, 0.9, (*shape, 3)).astype(np.float32)
    maps = mip_maps([picture], bits16=False)
    for start, rows, columns in maps.level:
        mean = maps.texels[start : start + rows * columns].mean(axis=0)
        np.testing.assert_allclose(mean, picture.mean((0, 1)), rtol=1e-5)
    scene = baked_mesh(plate(50.0, picture, tiles=2000.0), BLACK)
    radiance = scene.render(OVERHEAD, (10.0, 10.0, 4.0, 4.0), 8, 8, 1)[0]
    np.testing.assert_allclose(radiance, np.broadcast_to(picture.mean((0, 1)), (8, 8, 3)), rtol=1e-4)


def test_surroundings_are_seen_in_their_directions() -> None:
    """A ramp in height, and one around: the middle column is +x, and +y is a quarter to its left."""
    rows, columns = 90, 180
    down, across = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    picture = np.stack([down, 0.5 - 0.4 * np.cos(2 * np.pi * across), 0.5 - 0.4 * np.sin(2 * np.pi * across)], axis=-1)
    scene = light_mesh(plate(0.01), Environment(picture.astype(np.float32)), [], BLACK, show_environment=True)
    for azimuth in (0.0, 0.5 * np.pi, -2.0):
        pose = paths.look_at((5, 5, 5), (5 + np.cos(azimuth), 5 + np.sin(azimuth), 5.5))
        radiance, _, alpha = scene.render(pose, (20.0, 20.0, 4.0, 3.0), 8, 6, 1)
        assert not alpha.any()
        direction = ray_directions((20.0, 20.0, 4.0, 3.0), 8, 6) @ pose[:3, :3].T
        angle = np.arctan2(direction[..., 1], direction[..., 0])
        height = direction[..., 2] / np.linalg.norm(direction, axis=-1)
        np.testing.assert_allclose(radiance[..., 0], np.arccos(height) / np.pi, atol=1e-4)
        np.testing.assert_allclose(radiance[..., 1], 0.5 + 0.4 * np.cos(angle), atol=5e-4)
        np.testing.assert_allclose(radiance[..., 2], 0.5 - 0.4 * np.sin(angle), atol=5e-4)


def test_pictures_do_not_depend_on_the_run_or_the_threads() -> None:
    mesh, _ = prepared(mesh_of(trimesh.creation.icosphere(3)), 0.2)
    lamp = AreaLight((0.5, 0, 2.0), (0.3, 0, 0), (0, -0.3, 0), (1.0, 2.0, 3.0))
    pose = paths.look_at((3, 1, 1), (0, 0, 0))
    pictures = []
    for threads in (1, numba.config.NUMBA_NUM_THREADS):
        numba.set_num_threads(threads)
        scene = light_mesh(mesh, sky((0.1,) * 3, (1.0,) * 3), [lamp], BLACK)
        pictures.append(b"".join(part.tobytes() for part in scene.render(pose, (50, 50, 20, 15), 40, 30, 4)))
    numba.set_num_threads(1)
    assert pictures[0] == pictures[1]


# --- light


def test_an_even_sky_lights_a_convex_body_evenly() -> None:
    mesh, _ = prepared(mesh_of(trimesh.creation.icosphere(2)), 1.0)
    scene = light_mesh(mesh, sky((1, 2, 3), (1, 2, 3)), [], BLACK)
    np.testing.assert_allclose(scene.light[0], np.tile([1, 2, 3], (len(scene.light[0]), 1)), rtol=1e-4)
    assert scene.light[1].max() == 0


def test_a_linear_sky_has_its_cosine_weighted_mean() -> None:
    scene = light_mesh(prepared(plate(1.0), 0.2)[0], sky(BLACK, (1, 2, 0.5)), [], BLACK)
    # The mean of (1 + cos) / 2 over cosine-weighted directions is 5 / 6 above, 1 / 6 below.
    np.testing.assert_allclose(scene.light[0].mean(0), 5 / 6 * np.array([1, 2, 0.5]), rtol=2e-3)
    np.testing.assert_allclose(scene.light[1].mean(0), 1 / 6 * np.array([1, 2, 0.5]), rtol=1e-2)


def test_direct_light_is_the_form_factor() -> None:
    """A small lamp above a plate, against radiance x area x cos x cos / (pi d^2). It shines to one side only."""
    lamp = AreaLight((0.5, 0, 2.0), (0.01, 0, 0), (0, -0.01, 0), (100.0, 200.0, 300.0))
    scene = light_mesh(prepared(plate(2.0), 0.1)[0], NIGHT, [lamp], BLACK)
    radiance = scene.render(OVERHEAD, (6.0, 6.0, 4.0, 4.0), 8, 8, 1)[0]
    x, y = ray_directions((6.0, 6.0, 4.0, 4.0), 8, 8)[..., :2].transpose(2, 0, 1) * 3.0
    square = (x - 0.5) ** 2 + y**2 + 4.0
    np.testing.assert_allclose(radiance[..., 0], 0.5 * 100.0 * 0.0004 * 4.0 / (np.pi * square**2), rtol=5e-3)
    np.testing.assert_allclose(radiance[..., 2], 3 * radiance[..., 0], rtol=1e-5)
    away = AreaLight((0.5, 0, 2.0), (0.01, 0, 0), (0, 0.01, 0), (100.0,) * 3)
    assert light_mesh(plate(2.0), NIGHT, [away], BLACK).light.max() == 0


def test_a_small_sun_is_no_noise() -> None:
    """Half a degree of sun in a dim sky: its irradiance is radiance x solid angle x cosine, on every point alike."""
    rows, columns = 256, 512
    picture = np.full((rows, columns, 3), 0.1, np.float32)
    row, column = 64, 256  # at an elevation of 45 degrees, towards +x
    picture[row, column] = 5e4
    edges = np.cos(np.pi * np.array([row, row + 1]) / rows)
    direct = 5e4 * 2 * np.pi / columns * (edges[0] - edges[1]) * np.cos(np.pi * (row + 0.5) / rows) / np.pi
    ground, blind = plate(1.0), mesh_of(trimesh.creation.box((0.02, 2, 0.5)).apply_translation((0.5, 0, 0.3)))
    scene = light_mesh(prepared(joined(ground, blind), 0.05)[0], Environment(picture), [], BLACK)
    radiance = scene.render(OVERHEAD, (30.0, 30.0, 30.0, 1.0), 40, 2, 1)[0][0, :, 1]
    x = (np.arange(40) + 0.5 - 30) / 30 * 3.0
    # The blind, from 0.05 to 0.55 m above the ground, throws a shadow as long.
    clear, shade = (x > -0.9) & (x < -0.15), (x > 0.06) & (x < 0.34)
    assert clear.sum() >= 6
    assert shade.sum() >= 2
    np.testing.assert_allclose(radiance[clear], 0.5 * (direct + 0.1), rtol=0.02)
    assert (radiance[shade] < 0.1 * 0.5 * direct).all()


def test_environment_parts_add_up() -> None:
    rng = np.random.default_rng(0)
    picture = rng.uniform(0, 1, (64, 128, 3)).astype(np.float32) ** 8 * 20
    even, bright = Environment(picture).split()
    weight = -np.diff(np.cos(np.pi * np.arange(65) / 64))[:, None, None]
    coarse = -np.diff(np.cos(np.pi * np.arange(33) / 32))[:, None, None]
    total = (weight * bright).sum((0, 1)) / 128 + (coarse * even).sum((0, 1)) / 64
    np.testing.assert_allclose(total, (weight * picture).sum((0, 1)) / 128, rtol=1e-5)
    assert bright.max() > 0


def test_a_closed_box_balances_its_energy() -> None:
    """Furnace: what the walls receive is the lamp's power over their area and what they absorb."""
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    box.invert()
    albedo = np.array([0.2, 0.5, 0.8])
    mesh, _ = prepared(mesh_of(box, albedo), 0.25)
    lamp = AreaLight((0, 0, 0.3), (0.2, 0, 0), (0, -0.2, 0), (10.0,) * 3)
    scene = light_mesh(mesh, NIGHT, [lamp], BLACK)
    area = normals_and_areas(mesh)[1]
    at_faces = scene.light[0][scene.arrays.light_point].mean(axis=1)
    mean = (area[:, None] * at_faces).sum(0) / area.sum()
    expected = 10.0 * 0.16 / 24.0 / (1 - albedo)
    # Twelve bounces leave 0.8^13 of the brightest channel out.
    np.testing.assert_allclose(mean, expected * (1 - albedo**13), rtol=0.02)
    assert scene.light[1].max() == 0


def test_the_same_radiance_as_analytic_primitives() -> None:
    """A box on a floor under a lamp and a sky, lit and rendered both ways."""
    grey = {"grey": np.full((8, 8, 3), 0.4, np.float32)}
    lamp = AreaLight((0.8, -0.6, 1.8), (0.25, 0, 0), (0, -0.25, 0), (12.0, 10.0, 8.0))
    skies = ((0.05, 0.05, 0.05), (0.3, 0.4, 0.5))
    primitives = [
        Primitive(RECTANGLE, (0, 0, 0), (1.5, 1.5, 0), "grey"),
        Primitive(BOX, (0.1, 0.1, 0.25), (0.3, 0.25, 0.25), "grey"),
    ]
    analytic = bake(primitives, grey, [lamp], spacing=0.03, ambient=0.0, sky=skies)
    box = trimesh.creation.box((0.6, 0.5, 0.5)).apply_translation((0.1, 0.1, 0.25))
    ground = plate(1.5)
    mesh, coincident = prepared(
        joined(Mesh(**{**vars(ground), "colour": 0.8 * ground.colour}), mesh_of(box, [0.4] * 3)), 0.04
    )
    assert coincident == 2  # the foot of the box lies in the floor
    scene = light_mesh(mesh, sky(*skies), [lamp], BLACK)
    for eye in ((1.4, -1.8, 1.2), (-1.5, -0.8, 1.6)):
        pose = paths.look_at(eye, (0.1, 0, 0.2))
        ours, depth, alpha = scene.render(pose, (60, 60, 32, 24), 64, 48, 4)
        theirs, their_depth, their_alpha = analytic.render(pose, (60, 60, 32, 24), 64, 48, 4)
        whole = (alpha == 1) & (their_alpha == 1)
        np.testing.assert_allclose(alpha, their_alpha, atol=0.26)
        assert (alpha == their_alpha).mean() > 0.995
        assert np.percentile(abs(depth[whole] / their_depth[whole] - 1), 99) < 1e-3
        error = abs(ours[whole] - theirs[whole]) / theirs[whole]
        assert np.median(error) < 0.01
        assert np.percentile(error, 95) < 0.08  # the edges of the shadows and of the box
        np.testing.assert_allclose(ours[whole].mean(0), theirs[whole].mean(0), rtol=0.01)


def test_both_sides_are_lit_by_what_they_face() -> None:
    lamps = [
        AreaLight((0, 0, 2.0), (0.1, 0, 0), (0, -0.1, 0), (50.0, 0, 0)),
        AreaLight((0, 0, -2.0), (0.1, 0, 0), (0, 0.1, 0), (0, 50.0, 0)),
    ]
    scene = light_mesh(prepared(plate(0.5), 0.2)[0], NIGHT, lamps, BLACK)
    below = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -3], [0, 0, 0, 1]])
    for pose, lit, dark in ((OVERHEAD, 0, 1), (below, 1, 0)):
        radiance = scene.render(pose, (20.0, 20.0, 2.0, 2.0), 4, 4, 1)[0]
        assert (radiance[..., lit] > 0.02).all()
        assert radiance[..., dark].max() == 0


def test_smooth_surfaces_share_their_light_and_creases_do_not() -> None:
    sphere, box = mesh_of(trimesh.creation.icosphere(3)), mesh_of(trimesh.creation.box())
    assert len(light_points(sphere).position) == len(sphere.vertices)
    points = light_points(box)
    assert len(points.position) == 24
    np.testing.assert_allclose(np.abs(points.normal).max(axis=1), 1, atol=1e-12)
    # Inside each side: off the planes of the others.
    assert (np.sort(np.abs(points.position), axis=1)[:, :2] < 0.49).all()


# --- repairs


def test_subdivision_leaves_no_gaps() -> None:
    body = trimesh.creation.box((2.0, 1.0, 0.3))
    small, source = subdivided(mesh_of(body), 0.17)
    corners = small.vertices[small.faces]
    assert np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1).max() <= 0.17
    assert trimesh.Trimesh(small.vertices, small.faces, process=True).is_watertight
    np.testing.assert_allclose(normals_and_areas(small)[1].sum(), body.area, rtol=1e-5)
    old, new = normals_and_areas(mesh_of(body))[0][source], normals_and_areas(small)[0]
    np.testing.assert_allclose((old * new).sum(1), 1, atol=1e-5)


def test_coincident_faces_show_the_first_from_everywhere() -> None:
    red, green = (mesh_of(trimesh.creation.box((1, 1, 0.2)), colour) for colour in ((0.8, 0, 0), (0, 0.8, 0)))
    smaller = mesh_of(trimesh.creation.box((0.6, 0.6, 0.2)), (0, 0, 0.8))
    for second, count in ((green, 12), (smaller, 4)):
        both, coincident = prepared(joined(red, second))
        assert coincident == count
        scene = baked_mesh(both, BLACK)
        rng = np.random.default_rng(0)
        for _ in range(20):
            pose = paths.look_at((*rng.uniform(-2, 2, 2), rng.uniform(1, 3)), (0, 0, 0))
            radiance, _, alpha = scene.render(pose, (80, 80, 20, 15), 40, 30, 1)
            np.testing.assert_allclose(radiance[alpha > 0], np.tile([0.8, 0, 0], (int(alpha.sum()), 1)), rtol=1e-6)


def test_degenerate_faces_are_dropped() -> None:
    square = plate(1.0)
    faces = np.concatenate([square.faces, [[0, 0, 1], [0, 2, 2]]])
    mesh, _ = prepared(Mesh(**{**vars(square), "faces": faces, "texture": np.full(4, -1)}), 10.0)
    assert len(mesh.faces) == 2
    with pytest.raises(ValueError, match="no face has an area"):
        prepared(Mesh(**{**vars(square), "faces": faces[2:], "texture": np.full(2, -1)}), 10.0)


def test_concave_polygons() -> None:
    arrow = np.array([[0, 0], [2, 1], [0, 2], [0.7, 1.0]], np.float64) @ np.array([[1, 0, 0.2], [0, 1, -0.4]])
    for shift in range(4):
        corners = np.roll(arrow, shift, axis=0)[:: 1 if shift % 2 else -1]
        triangles = np.array([corners[list(t)] for t in ear_clipping(corners)])
        cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        newell = np.cross(corners, np.roll(corners, -1, axis=0)).sum(0)
        assert (cross @ newell > 0).all()
        np.testing.assert_allclose(cross.sum(0), newell, atol=1e-12)


@pytest.mark.parametrize(
    "outline",
    [
        # A hole that a bridge joins to the outline.
        [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)],
        # Corners on the line between others, before and after a notch.
        [(0, 0), (1, 0), (2, 0), (4, 0), (4, 4), (2, 1), (0, 4), (0, 2)],
        # A corner given twice.
        [(0, 0), (4, 0), (4, 0), (4, 4), (2, 1), (0, 4)],
    ],
)
def test_holes_and_needless_corners_of_polygons(outline: list[tuple[float, float]]) -> None:
    corners = np.column_stack([outline, 1e-6 * np.random.default_rng(0).normal(size=len(outline))])
    a, b, c = np.moveaxis(corners[ear_clipping(corners)], 1, 0)
    cross = np.cross(b - a, c - a)
    assert (cross[:, 2] >= 0).all()
    np.testing.assert_allclose(
        cross.sum(0), np.cross(corners, np.roll(corners, -1, axis=0)).sum(0), rtol=1e-9, atol=1e-5
    )


# --- files


def painted_box() -> trimesh.Trimesh:
    """A box of 1.2 x 0.8 x 0.6 m, each side with vertices of its own and a picture of its own part of a texture."""
    body = trimesh.creation.box((1.2, 0.8, 0.6))
    body.unmerge_vertices()
    normal = np.repeat(body.face_normals, 3, axis=0)
    axis = np.abs(normal).argmax(axis=1)
    rows = np.arange(len(body.vertices))
    uv = (
        np.stack([body.vertices[rows, (axis + 1) % 3], body.vertices[rows, (axis + 2) % 3]], axis=1)
        + 0.1 * axis[:, None]
    )
    picture = np.random.default_rng(0).integers(40, 220, (12, 16, 3)).astype(np.uint8)
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(picture), baseColorFactor=[0.8, 1.0, 0.6, 1.0]
    )
    body.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return body


def seen(path: Path, up: str) -> np.ndarray:
    scene = baked_mesh(scaled(load_mesh(path, up == "y"), 1.0), BLACK)
    pose = paths.look_at((2.0, -1.5, 1.3), (0, 0, 0))
    return scene.render(pose, (60, 60, 32, 24), 64, 48, 1)[0]


def test_the_same_picture_from_glb_and_obj(tmp_path: Path) -> None:
    z_up = painted_box()
    # What a program with y up would write: (x, y, z) of ours is its (x, z, -y).
    y_up = z_up.copy()
    y_up.apply_transform(np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]))
    scene = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(0.4, (1, 2, 3), (0.3, 0, 0))
    moved = y_up.copy().apply_transform(np.linalg.inv(turn))
    scene.add_geometry(moved, transform=turn)
    scene.export(tmp_path / "box.glb")
    z_up.visual.material = z_up.visual.material.to_simple()
    z_up.visual.material.kwargs = {"kd": [0.8, 1.0, 0.6]}
    z_up.export(tmp_path / "box.obj", mtl_name="box.mtl")
    text = (tmp_path / "box.mtl").read_text()
    assert "Kd" in text
    (tmp_path / "box.mtl").write_text(
        "\n".join("Kd 0.8 1.0 0.6" if line.startswith("Kd") else line for line in text.splitlines())
    )
    glb, obj = seen(tmp_path / "box.glb", "y"), seen(tmp_path / "box.obj", "z")
    assert (glb > 0).any(-1).mean() > 0.15
    np.testing.assert_allclose(glb, obj, atol=2e-3)
    # And it is what the texture says, at a point of the top.
    overhead = baked_mesh(scaled(load_mesh(tmp_path / "box.glb", True), 1.0), BLACK).render(
        OVERHEAD, (100.0, 100.0, 0.5, 0.5), 1, 1, 1
    )[0][0, 0]
    rng = np.random.default_rng(0)
    picture = linear(rng.integers(40, 220, (12, 16, 3)).astype(np.uint8) / 255)[::-1]
    # u = 0 + 0.2, v = 0 + 0.2 there
    column, row = 0.2 * 16 - 0.5, 0.2 * 12 - 0.5
    i, j = int(column), int(row)
    fx, fy = column - i, row - j
    value = (1 - fy) * ((1 - fx) * picture[j, i] + fx * picture[j, i + 1]) + fy * (
        (1 - fx) * picture[j + 1, i] + fx * picture[j + 1, i + 1]
    )
    np.testing.assert_allclose(overhead, value * [0.8, 1.0, 0.6], atol=1e-3)


def test_colours_of_a_ply_are_srgb(tmp_path: Path) -> None:
    body = trimesh.creation.box()
    for kind in ("vertex_colors", "face_colors"):
        coloured = trimesh.Trimesh(
            body.vertices,
            body.faces,
            process=False,
            **{kind: np.array([[200, 100, 50, 255]] * (8 if kind[0] == "v" else 12), np.uint8)},
        )
        coloured.export(tmp_path / "box.ply")
        mesh = load_mesh(tmp_path / "box.ply", False)
        np.testing.assert_allclose(
            mesh.colour[mesh.faces], np.broadcast_to(linear(np.array([200, 100, 50]) / 255), (12, 3, 3))
        )


def test_an_obj_with_a_concave_polygon_and_two_materials(tmp_path: Path) -> None:
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 0.7 0.1 0.1\nnewmtl green\nKd 0.1 0.6 0.1\n")
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 1 0\nv 0 2 0\nv 0.4 1 0\nusemtl red\nf 1 2 3 4\n"
        "v 2 0 0\nv 3 0 0\nv 3 1 0\nusemtl green\nf -3 -2 -1\n"
    )
    mesh = scaled(load_mesh(tmp_path / "a.obj", False), 2.0)
    # The notch is not filled; the scale is applied; the first material comes first.
    np.testing.assert_allclose(normals_and_areas(mesh)[1].sum(), 4 * (0.6 + 0.5), rtol=1e-6)
    np.testing.assert_allclose(mesh.colour[mesh.faces[0]], [[0.7, 0.1, 0.1]] * 3)
    np.testing.assert_allclose(mesh.colour[mesh.faces[-1]], [[0.1, 0.6, 0.1]] * 3)


@pytest.fixture
def box_file(tmp_path: Path) -> Path:
    painted_box().export(tmp_path / "box.glb")
    return tmp_path / "box.glb"


def scene_file(beside: Path, **values: object) -> str:
    path = beside.with_name("scene.json")
    path.write_text(json.dumps({"mesh": beside.name, "light": "baked", "up": "z", **values}))
    return str(path)


WALK = {
    "kind": "walk",
    "positions": [[1.5, 0, 0.3], [0, 1.4, 0.5], [-1.6, 0, 0.2], [0, -1.3, 0.4]],
    "targets": [[0, 0, 0], [0.1, 0, 0], [0, 0, 0.1], [0, 0.1, 0]],
}


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"mesh": "gone.glb"}, "gone.glb: the file does not exist"),
        ({"mesh": "scene.json"}, "unknown kind of mesh '.json'"),
        ({"mesh": 3}, "mesh is 3"),
        ({"up": "x"}, "up is 'x'"),
        ({"scale": -1}, "scale is -1"),
        ({"colour": 1}, "unknown key 'colour'"),
        ({"light": "bright"}, "light is neither"),
        ({"light": {"sky": [[1, 1, 1]]}}, "light.sky is [[1, 1, 1]]"),
        ({"light": {"sky": [[1, 1, 1], [1, 1, -1]]}}, "must not be negative"),
        ({"light": {"environment": "gone.hdr"}}, "gone.hdr: the environment does not exist"),
        ({"light": {"environment": "box.glb"}}, "box.glb: not a Radiance picture"),
        ({"light": {"sky": [[0, 0, 0], [1, 1, 1]], "lamps": [{"centre": [0, 0, 1]}]}}, "light.lamps[0]"),
        ({"background": [1, 1]}, "background is [1, 1]"),
        ({"background": [2, 1, 1]}, "at most 1"),
        ({"background": "environment"}, "background of baked light"),
        ({"path": {"kind": "fly"}}, "path.kind is 'fly'"),
        ({"path": {"kind": "around", "radius": 0.5}}, "runs into the mesh at ("),
        ({"path": {"kind": "around", "radius": 0.8}}, "comes within 0.0"),
        ({"path": {"kind": "around", "speed": 1}}, "unknown key 'speed' in path"),
        ({"path": {"kind": "walk", "positions": [[0, 0, 0]], "targets": [[0, 0, 0]]}}, "at least 4"),
        ({"path": {**WALK, "positions": WALK["targets"]}}, "straight up or down"),
        ({"path": {**WALK, "positions": WALK["positions"][:3] + WALK["positions"][:1]}}, "are the same"),
        ({"path": WALK, "box": [[0, 0, 0], [1, 1, 1]]}, "a box with a walk"),
        ({"box": [[0, 0, 0], [1, 1, 0]]}, "box is"),
    ],
)  # fmt: skip
def test_bad_scene_files_end_in_one_line(box_file: Path, values: dict, told: str) -> None:
    with pytest.raises(DataError) as raised:
        open_scene(scene_file(box_file, **values))
    message = str(raised.value)
    assert told in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("a.json", "{", "not JSON"),
        ("a.json", "[]", 'no "mesh"'),
        ("a.stl", "", "an unknown scene"),
        ("a.glb", "glTF", "not a binary glTF file"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 3\n", "a.ply"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 7\n", "a.obj"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "there is no surface in it"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no face has an area"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n", "not finite"),
        ("a.obj", "mtllib b.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "b.mtl: the materials do not exist"),
        ("a.obj", "mtllib c.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "c.png: the texture does not exist"),
        ("a.obj", "mtllib d.mtl\nusemtl c\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "no material 'c'"),
        ("a.obj", "mtllib e.mtl\nusemtl e\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "e.png: not a picture"),
    ],
)  # fmt: skip
def test_bad_meshes_end_in_one_line(tmp_path: Path, name: str, content: str, told: str) -> None:
    (tmp_path / "c.mtl").write_text("newmtl c\nmap_Kd c.png\n")
    (tmp_path / "d.mtl").write_text("newmtl d\nKd 1 1 1\n")
    (tmp_path / "e.mtl").write_text("newmtl e\nmap_Kd e.png\n")
    (tmp_path / "e.png").write_text("no")
    (tmp_path / name).write_text(content)
    with pytest.raises(DataError) as raised:
        open_scene(str(tmp_path / name))
    assert told in str(raised.value)
    assert "\n" not in str(raised.value)


def test_an_environment_file_is_turned(tmp_path: Path) -> None:
    picture = np.zeros((16, 32, 3), np.float32)
    picture[:, 16] = (1.0, 2.0, 3.0)  # blue, green, red: just right of +x
    assert cv2.imwrite(str(tmp_path / "a.hdr"), picture)
    turned = load_environment(tmp_path / "a.hdr", turn_degrees=90, gain=2.0).radiance
    np.testing.assert_allclose(turned[5, 8], (6.0, 4.0, 2.0), rtol=0.02)  # a quarter to the left: +y
    assert turned.sum() == pytest.approx(turned[:, 8].sum())
    assert cv2.imwrite(str(tmp_path / "b.hdr"), picture[:, :20])
    with pytest.raises(DataError, match="twice as wide as high"):
        load_environment(tmp_path / "b.hdr")


def test_open3d_that_cannot_be_loaded_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(DataError, match=r"Open3D: cannot be loaded \(.*\); install what it misses"):
        RayCaster(np.eye(3), np.array([[0, 1, 2]]))


# --- paths


def test_a_walk_is_closed_and_smooth() -> None:
    path = paths.WalkPath(WALK["positions"], WALK["targets"])
    np.testing.assert_allclose(path(0.0), path(1.0), atol=1e-12)
    poses = np.stack([path(s) for s in np.linspace(0, 1, 4001)])
    eyes = np.array(WALK["positions"])
    distance = np.linalg.norm(poses[:, None, :3, 3] - eyes, axis=-1)
    assert (distance.min(axis=0) < 2e-3).all()
    second = np.diff(np.concatenate([poses, poses[1:3]])[:, :3], n=2, axis=0) * 4000**2
    assert np.abs(np.diff(second, axis=0)).max() < 0.02 * np.abs(second).max()
    speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert speed.max() < 1.5 * speed.min()


@pytest.mark.parametrize("path", [{"kind": "around", "radius": 1.1}, WALK], ids=["around", "walk"])
def test_views_are_off_the_path_seeded_and_free(box_file: Path, path: dict) -> None:
    obstacle = trimesh.creation.icosphere(2, 0.25)
    scene_mesh = trimesh.Scene([painted_box()])
    # Beside the walk, and on the sphere of the views around.
    place = (0.0, 1.85, 0.5) if path is WALK else paths.object_validation_views(10, 1.1)[2][:3, 3]
    scene_mesh.add_geometry(obstacle, transform=trimesh.transformations.translation_matrix(place))
    scene_mesh.export(box_file)
    if path is not WALK:
        path = {**path, "turns": 0.5, "centre": [0, 0, 0]}
    scene = open_scene(scene_file(box_file, path=path))
    validation, test = scene.validation_views(10), scene.test_views(60, 5)
    assert validation.shape == (10, 4, 4)
    np.testing.assert_array_equal(test, scene.test_views(60, 5))
    assert not np.array_equal(test, scene.test_views(60, 6))
    on_path = np.stack([scene.path(s) for s in np.linspace(0, 1, 2000)])[:, :3]
    distance = scene.renderer.caster.distance
    clearance = min(0.15, 0.13 * 1.1)
    for pose in [*validation, *test]:
        assert np.abs(on_path - pose[:3]).max((1, 2)).min() > 1e-3
        assert distance(pose[:3, 3])[0] >= clearance - 1e-4


def test_a_bare_mesh_is_an_object_in_view(tmp_path: Path) -> None:
    body = trimesh.creation.box((40.0, 90.0, 20.0))
    body.apply_translation((1000.0, 0, 0))
    body.export(tmp_path / "box.ply")
    scene = open_scene(str(tmp_path / "box.ply"))
    assert len(scene.notes) == 1
    assert "scaled by 0.02" in scene.notes[0]
    assert scene.aabb is not None
    brightest = 0.0
    for pose in [*(scene.path(k / 9) for k in range(10)), *scene.test_views(10, 0)]:
        radiance, depth, alpha = scene.renderer.render(pose, scene.intrinsics(60, 45), 60, 45, 4)
        assert 0.02 < alpha.mean() < 0.6
        hit = alpha == 1
        brightest = max(brightest, radiance[hit].max())
        points = (
            ray_directions(scene.intrinsics(60, 45), 60, 45)[hit] * depth[hit][:, None] @ pose[:3, :3].T + pose[:3, 3]
        )
        assert (points > scene.aabb[0]).all()
        assert (points < scene.aabb[1]).all()
    assert 0.8 < brightest < 1
    for s in np.linspace(0, 1, 20):
        alpha = scene.renderer.render(scene.path(s), scene.intrinsics(60, 45), 60, 45, 4)[2]
        assert max(alpha[0].max(), alpha[-1].max(), alpha[:, 0].max(), alpha[:, -1].max()) == 0


def test_a_path_through_a_hair_of_space_is_refused() -> None:
    from aenerf_ns.simulator.free_space import FreeSpace

    space = FreeSpace(RayCaster(plate(1.0).vertices, plate(1.0).faces), 0.1)
    assert space.is_free((0, 0, 0.11))
    assert not space.is_free((0, 0, -0.09))
    assert space.is_reached((0, 0, 0.5), (0.5, 0, 0.5))
    assert not space.is_reached((0, 0, 0.5), (0.5, 0, -0.5))


def test_frames_follow_what_moves_behind_a_mesh(box_file: Path) -> None:
    """Around a box, what is far behind it moves most: an environment there must not, a plain colour may."""
    intrinsics = 1.2 * 24, 1.2 * 24, 12.0, 9.0
    lens = np.array([[intrinsics[0], 0, 12.0], [0, intrinsics[1], 9.0], [0, 0, 1]])
    corner = np.mgrid[:24, :18].reshape(2, -1).T + 0.5
    fastest = []
    for background in ("environment", [0.5, 0.5, 0.5]):
        light = {"sky": [[0.1, 0.2, 0.3], [1, 1, 1]]}
        route = {"kind": "around", "radius": 2.5, "turns": 0.2}
        scene = open_scene(scene_file(box_file, light=light, background=background, path=route))
        poses = [scene.path(s) for s in frame_parameters(scene, intrinsics, 24, 18, 0.5)]
        behind = np.isinf(scene.renderer.render(poses[0], intrinsics, 24, 18, 1)[1].T.ravel())
        assert 0.5 < behind.mean() < 0.95
        # What is infinitely far is warped by the rotation alone.
        moved = []
        for first, second in itertools.pairwise(poses[:-1]):
            warp = lens @ second[:3, :3].T @ first[:3, :3] @ np.linalg.inv(lens)
            warped = cv2.perspectiveTransform(corner[:, None], warp)[:, 0]
            moved.append(np.percentile(np.linalg.norm(warped - corner, axis=1), 97))
        fastest.append(max(moved))
    assert 0.45 < fastest[0] < 0.5
    assert fastest[1] > 0.6


# --- end to end


def test_simulated_events_are_thresholds_apart(box_file: Path) -> None:
    """The command, on a mesh: at every event, the log-radiance that the renderer gives has moved by one threshold."""
    name = scene_file(box_file, path={"kind": "around", "radius": 2.5, "turns": 0.2})
    output = box_file.with_name("data")
    Simulate(output, scene=name, width=24, height=18, duration=1.0, max_displacement=1.0, train_images=1,
             validation_views=1, test_views=1).main()  # fmt: skip
    with h5py.File(output / "events.h5") as file:
        x, y, t, p = (file[f"events/{key}"][:] for key in "xytp")
    scene = open_scene(name)
    intrinsics = scene.intrinsics(24, 18)
    frames = frame_parameters(scene, intrinsics, 24, 18, 1.0)
    pictures = np.stack([scene.renderer.render(scene.path(s), intrinsics, 24, 18, 4)[0] for s in frames])
    level = np.log((pictures * LUMINANCE).sum(-1, dtype=np.float64) + 1e-3)
    times = np.rint(frames * 1e9)
    pixels = 0
    for row, column in np.ndindex(18, 24):
        mine = (x == column) & (y == row)
        if mine.any():
            moved = np.interp(t[mine], times, level[:, row, column]) - level[0, row, column]
            # A time stamp is rounded to whole nanoseconds: so far the log-radiance moves meanwhile.
            slope = np.diff(level[:, row, column]) / np.diff(times)
            rounding = 0.5 * np.abs(slope[np.searchsorted(times, t[mine]) - 1])
            assert (np.abs(moved - 0.25 * np.cumsum(p[mine].astype(np.int64))) - rounding).max() < 1e-6
            pixels += 1
    assert pixels > 50
    assert json.loads((output / "transforms.json").read_text())["scene_box"][1][0] == pytest.approx(0.63, abs=1e-3)
