"""The light that meshes receive, against closed forms."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from helpers.small_meshes import BLACK, NIGHT, OVERHEAD, joined, mesh_of, plate, ray_directions

from aenerf_ns.errors import DataError
from aenerf_ns.simulator.rendering.environment import load_environment, sky, split
from aenerf_ns.simulator.rendering.lighting import AreaLight, light_mesh, light_points
from aenerf_ns.simulator.rendering.mesh import normals_and_areas
from aenerf_ns.simulator.rendering.mesh_repair import repair

pytestmark = pytest.mark.usefixtures("small_work")


def test_linear_sky() -> None:
    scene = light_mesh(repair(plate(1.0), 0.2)[0], sky(BLACK, (1, 2, 0.5)), [], BLACK)
    # The mean of (1 + cos) / 2 over cosine-weighted directions is 5 / 6 above, 1 / 6 below.
    np.testing.assert_allclose(scene.light[0].mean(0), 5 / 6 * np.array([1, 2, 0.5]), rtol=2e-3)
    np.testing.assert_allclose(scene.light[1].mean(0), 1 / 6 * np.array([1, 2, 0.5]), rtol=1e-2)


def test_direct_light() -> None:
    """A small lamp above a plate, against radiance x area x cos x cos / (pi d^2). It shines to one side only."""
    lamp = AreaLight((0.5, 0, 2.0), (0.01, 0, 0), (0, -0.01, 0), (100.0, 200.0, 300.0))
    scene = light_mesh(repair(plate(2.0), 0.1)[0], NIGHT, [lamp], BLACK)
    radiance = scene.render(OVERHEAD, (6.0, 6.0, 4.0, 4.0), 8, 8, 1)[0]
    x, y = ray_directions((6.0, 6.0, 4.0, 4.0), 8, 8)[..., :2].transpose(2, 0, 1) * 3.0
    square = (x - 0.5) ** 2 + y**2 + 4.0
    np.testing.assert_allclose(radiance[..., 0], 0.5 * 100.0 * 0.0004 * 4.0 / (np.pi * square**2), rtol=5e-3)
    np.testing.assert_allclose(radiance[..., 2], 3 * radiance[..., 0], rtol=1e-5)
    away = AreaLight((0.5, 0, 2.0), (0.01, 0, 0), (0, 0.01, 0), (100.0,) * 3)
    assert light_mesh(plate(2.0), NIGHT, [away], BLACK).light.max() == 0


def test_shadow() -> None:
    """A roof throws a shadow whose edge is projected from a small lamp: at 1 +- 0.4 * 2 / 1.5 on the ground."""
    ground, roof = plate(2.0), mesh_of(trimesh.creation.box((0.8, 4, 0.02)).apply_translation((1.0, 0, 0.5)))
    lamp = AreaLight((1.0, 0, 2.0), (0.01, 0, 0), (0, -0.01, 0), (1.0,) * 3)
    sight = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.4], [0, 0, 0, 1]])
    clear_sky, shaded = (
        light_mesh(repair(mesh, 0.05)[0], NIGHT, [lamp], BLACK).render(sight, (10.0, 10.0, 20.0, 1.0), 80, 2, 1)[0]
        for mesh in (ground, joined(ground, roof))
    )
    x = (np.arange(80) + 0.5 - 20.0) / 10.0 * 0.4
    inside = (x > -0.7) & (x < 1.9)
    shadow = abs(x - 1.0) < 0.53 - 0.08
    clear = inside & (abs(x - 1.0) > 0.53 + 0.08)
    assert shadow.sum() > 10
    assert clear.sum() > 10
    # Only bounces off the roof's underside reach the shadow.
    assert (shaded[0, shadow] < 0.35 * clear_sky[0, shadow]).all()
    assert (shaded[0, clear] > 0.98 * clear_sky[0, clear]).all()


def test_ambient_light_and_emission() -> None:
    """In a closed box, ambient light a becomes a / (1 - albedo). A glow stays where it is."""
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    box.invert()
    mesh = mesh_of(box, (0.5, 0.5, 0.5))
    glow = np.where(normals_and_areas(mesh)[0][:, 2] > 0.9, 3.0, 0.0)  # the floor
    mesh, _ = repair(dataclasses.replace(mesh, emission=glow), 0.5)
    scene = light_mesh(mesh, NIGHT, [], BLACK, ambient=0.1)
    light = scene.light[0][scene.surface.light_point]
    expected = 0.1 * (1 - 0.5**13) / 0.5 + mesh.emission
    np.testing.assert_allclose(light, np.broadcast_to(expected[:, None, None], light.shape), rtol=1e-4)


def test_small_sun() -> None:
    """Half a degree of sun in a dim sky: its irradiance is radiance x solid angle x cosine, on every point alike."""
    rows, columns = 256, 512
    picture = np.full((rows, columns, 3), 0.1, np.float32)
    row, column = 64, 256  # at an elevation of 45 degrees, towards +x
    picture[row, column] = 5e4
    edges = np.cos(np.pi * np.array([row, row + 1]) / rows)
    direct = 5e4 * 2 * np.pi / columns * (edges[0] - edges[1]) * np.cos(np.pi * (row + 0.5) / rows) / np.pi
    ground, blind = plate(1.0), mesh_of(trimesh.creation.box((0.02, 2, 0.5)).apply_translation((0.5, 0, 0.3)))
    scene = light_mesh(repair(joined(ground, blind), 0.05)[0], picture, [], BLACK)
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
    even, bright = split(picture)
    weight = -np.diff(np.cos(np.pi * np.arange(65) / 64))[:, None, None]
    coarse = -np.diff(np.cos(np.pi * np.arange(33) / 32))[:, None, None]
    total = (weight * bright).sum((0, 1)) / 128 + (coarse * even).sum((0, 1)) / 64
    np.testing.assert_allclose(total, (weight * picture).sum((0, 1)) / 128, rtol=1e-5)
    assert bright.max() > 0


def test_turn_environment_file(tmp_path: Path) -> None:
    picture = np.zeros((16, 32, 3), np.float32)
    picture[:, 16] = (1.0, 2.0, 3.0)  # blue, green, red: just right of +x
    assert cv2.imwrite(str(tmp_path / "a.hdr"), picture)
    turned = load_environment(tmp_path / "a.hdr", turn_degrees=90, gain=2.0)
    np.testing.assert_allclose(turned[5, 8], (6.0, 4.0, 2.0), rtol=0.02)  # a quarter to the left: +y
    assert turned.sum() == pytest.approx(turned[:, 8].sum())
    assert cv2.imwrite(str(tmp_path / "b.hdr"), picture[:, :20])
    with pytest.raises(DataError, match="twice as wide as high"):
        load_environment(tmp_path / "b.hdr")


def test_energy_in_closed_box() -> None:
    """Furnace: what the walls receive is the lamp's power over their area and what they absorb."""
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    box.invert()
    albedo = np.array([0.2, 0.5, 0.8])
    mesh, _ = repair(mesh_of(box, albedo), 0.25)
    lamp = AreaLight((0, 0, 0.3), (0.2, 0, 0), (0, -0.2, 0), (10.0,) * 3)
    scene = light_mesh(mesh, NIGHT, [lamp], BLACK)
    area = normals_and_areas(mesh)[1]
    at_faces = scene.light[0][scene.surface.light_point].mean(axis=1)
    mean = (area[:, None] * at_faces).sum(0) / area.sum()
    expected = 10.0 * 0.16 / 24.0 / (1 - albedo)
    # Twelve bounces leave 0.8^13 of the brightest channel out.
    np.testing.assert_allclose(mean, expected * (1 - albedo**13), rtol=0.02)
    assert scene.light[1].max() == 0


def test_light_both_sides() -> None:
    lamps = [
        AreaLight((0, 0, 2.0), (0.1, 0, 0), (0, -0.1, 0), (50.0, 0, 0)),
        AreaLight((0, 0, -2.0), (0.1, 0, 0), (0, 0.1, 0), (0, 50.0, 0)),
    ]
    scene = light_mesh(repair(plate(0.5), 0.2)[0], NIGHT, lamps, BLACK)
    below = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -3], [0, 0, 0, 1]])
    for pose, lit, dark in ((OVERHEAD, 0, 1), (below, 1, 0)):
        radiance = scene.render(pose, (20.0, 20.0, 2.0, 2.0), 4, 4, 1)[0]
        assert (radiance[..., lit] > 0.02).all()
        assert radiance[..., dark].max() == 0


def test_share_light_on_smooth_surfaces() -> None:
    sphere, box = mesh_of(trimesh.creation.icosphere(3)), mesh_of(trimesh.creation.box())
    assert len(light_points(sphere).position) == len(sphere.vertices)
    points = light_points(box)
    assert len(points.position) == 24
    np.testing.assert_allclose(np.abs(points.normal).max(axis=1), 1, atol=1e-12)
    # Inside each side: off the planes of the others.
    assert (np.sort(np.abs(points.position), axis=1)[:, :2] < 0.49).all()
