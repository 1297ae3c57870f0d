"""Pictures of meshes against closed forms."""

import dataclasses
import sys

import numpy as np
import pytest
import torch
import trimesh
from helpers.small_meshes import BLACK, OVERHEAD, mesh_of, plate, ray_directions
from scipy.stats import norm

from aenerf_ns.errors import DataError
from aenerf_ns.simulator import paths
from aenerf_ns.simulator.rendering.embree import RayCaster
from aenerf_ns.simulator.rendering.environment import sky
from aenerf_ns.simulator.rendering.lighting import AreaLight, baked_mesh, light_mesh
from aenerf_ns.simulator.rendering.mesh_repair import repair
from aenerf_ns.simulator.rendering.mip_maps import mip_maps
from aenerf_ns.simulator.rendering.renderer import sample_offsets

pytestmark = pytest.mark.usefixtures("small_work")


def test_tilted_plate() -> None:
    """Depth is that of the plane, and of nothing beside the square, for a camera that sees it at a slant."""
    scene = baked_mesh(plate(1.0), np.array([0.2, 0.3, 0.4]))
    pose = paths.look_at((1.5, -2.0, 1.2), (0.1, 0.2, 0.0), roll=0.3)
    intrinsics, width, height = (40.0, 44.0, 24.2, 17.7), 48, 36
    radiance, depth = scene.render(pose, intrinsics, width, height, 1)
    directions = ray_directions(intrinsics, width, height) @ pose[:3, :3].T
    expected = -pose[2, 3] / directions[..., 2]
    points = pose[:3, 3] + expected[..., None] * directions
    inside = (expected > 0) & (abs(points[..., 0]) < 1) & (abs(points[..., 1]) < 1)
    assert 200 < inside.sum() < width * height - 200
    np.testing.assert_array_equal(np.isfinite(depth), inside)
    np.testing.assert_allclose(depth[inside], expected[inside], rtol=3e-7)
    np.testing.assert_allclose(radiance[inside], 0.5, rtol=1e-6)
    np.testing.assert_allclose(radiance[~inside] / [0.2, 0.3, 0.4], 1, rtol=1e-6)


def test_texture_coordinates_and_wrapping() -> None:
    """A picture with two different ramps, repeated: bilinear between the centers of its texels, and round its edges."""
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


def test_surroundings() -> None:
    """A ramp in height, and one around: the middle column is +x, and +y is a quarter to its left."""
    rows, columns = 90, 180
    down, across = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    picture = np.stack([down, 0.5 - 0.4 * np.cos(2 * np.pi * across), 0.5 - 0.4 * np.sin(2 * np.pi * across)], axis=-1)
    scene = light_mesh(plate(0.01), picture.astype(np.float32), [], None)
    for azimuth in (0.0, 0.5 * np.pi, -2.0):
        pose = paths.look_at((5, 5, 5), (5 + np.cos(azimuth), 5 + np.sin(azimuth), 5.5))
        radiance, depth = scene.render(pose, (20.0, 20.0, 4.0, 3.0), 8, 6, 1)
        assert np.isinf(depth).all()
        direction = ray_directions((20.0, 20.0, 4.0, 3.0), 8, 6) @ pose[:3, :3].T
        angle = np.arctan2(direction[..., 1], direction[..., 0])
        height = direction[..., 2] / np.linalg.norm(direction, axis=-1)
        np.testing.assert_allclose(radiance[..., 0], np.arccos(height) / np.pi, atol=1e-4)
        np.testing.assert_allclose(radiance[..., 1], 0.5 + 0.4 * np.cos(angle), atol=5e-4)
        np.testing.assert_allclose(radiance[..., 2], 0.5 - 0.4 * np.sin(angle), atol=5e-4)


@pytest.mark.parametrize("samples", [4, 16])
def test_sample_offsets_are_the_point_spread(samples: int) -> None:
    offsets = sample_offsets(samples)
    np.testing.assert_allclose(offsets.mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(offsets.T @ offsets / samples, 0.25 * np.eye(2), atol=1e-12)
    np.testing.assert_array_equal(sample_offsets(1), [[0, 0]])


def test_edge_is_blurred_by_the_point_spread() -> None:
    square = plate(2.0)
    scene = baked_mesh(dataclasses.replace(square, vertices=square.vertices + np.array([2.0, 0, 0])), BLACK)
    # The edge x = 0 crosses the pixels at cx; moving cx moves it through the pixel.
    shifts = np.linspace(-1.5, 1.5, 21)
    gray = np.array([scene.render(OVERHEAD, (50.0, 50.0, 2.5 - d, 2.5), 5, 5, 300)[0][2, 2, 0] for d in shifts])
    np.testing.assert_allclose(gray, 0.5 * norm.cdf(shifts, scale=0.5), atol=0.01)


def test_threads_do_not_change_pictures(threads: None) -> None:
    mesh, _ = repair(mesh_of(trimesh.creation.icosphere(3)), 0.2)
    lamp = AreaLight((0.5, 0, 2.0), (0.3, 0, 0), (0, -0.3, 0), (1.0, 2.0, 3.0))
    pose = paths.look_at((3, 1, 1), (0, 0, 0))
    pictures = []
    for num_threads in (1, 3):
        torch.set_num_threads(num_threads)
        scene = light_mesh(mesh, sky((0.1,) * 3, (1.0,) * 3), [lamp], BLACK)
        pictures.append(b"".join(part.tobytes() for part in scene.render(pose, (50, 50, 20, 15), 40, 30, 4)))
    assert pictures[0] == pictures[1]


def test_refuse_missing_open3d(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(DataError, match=r"Open3D: cannot be loaded \(.*\); install the missing libraries"):
        RayCaster(np.eye(3), np.array([[0, 1, 2]]))
