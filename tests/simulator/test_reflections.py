"""Reflections of glossy surfaces, against closed forms and against single facets."""

import dataclasses
import math

import numpy as np
import pytest
import trimesh
from helpers.small_meshes import BLACK, NIGHT, OVERHEAD, joined, mesh_of, plate, ray_directions

from aenerf_ns.simulator import paths
from aenerf_ns.simulator.rendering.environment import sky
from aenerf_ns.simulator.rendering.lighting import AreaLight, baked_mesh, light_mesh
from aenerf_ns.simulator.rendering.mesh import Mesh
from aenerf_ns.simulator.rendering.mesh_repair import repair
from aenerf_ns.simulator.rendering.renderer import Renderer

pytestmark = pytest.mark.usefixtures("small_work")

LENS, SIZE = (60.0, 60.0, 40.0, 30.0), (80, 60)


def coated(mesh: Mesh, specular: float, roughness: float, albedo: float = 0.5) -> Mesh:
    gloss = np.tile([specular, roughness], (len(mesh.faces), 1))
    return dataclasses.replace(mesh, gloss=gloss, color=np.full_like(mesh.color, albedo))


def red(scene: Renderer, pose: np.ndarray = OVERHEAD) -> np.ndarray:
    return scene.render(pose, LENS, *SIZE, 1)[0][..., 0]


def test_without_specular_is_diffuse() -> None:
    lamp = AreaLight((0.5, 0, 2.0), (0.3, 0, 0), (0, -0.3, 0), (5.0, 5.0, 5.0))
    mesh, _ = repair(plate(1.0), 0.3)
    other = mesh_of(trimesh.creation.icosphere(2, 0.2).apply_translation((0, 0, 0.5)))
    diffuse, rough, beside_gloss = (
        light_mesh(joined(mesh, ball), sky(BLACK, (1, 1, 1)), [lamp], BLACK)
        for mesh, ball in ((mesh, other), (coated(mesh, 0.0, 0.3), other), (mesh, coated(other, 0.3, 0.1)))
    )
    assert diffuse.reflections is None
    pictures = [scene.render(OVERHEAD, LENS, *SIZE, 4) for scene in (diffuse, rough, beside_gloss)]
    for part, same in zip(pictures[0], pictures[1], strict=True):
        assert part.tobytes() == same.tobytes()
    off_the_ball = pictures[0][1] > 2.99
    assert off_the_ball.mean() > 0.5
    assert pictures[0][0][off_the_ball].tobytes() == pictures[2][0][off_the_ball].tobytes()
    assert not np.array_equal(pictures[0][0], pictures[2][0])


@pytest.mark.parametrize("roughness", [0.0, 0.5])
def test_reflectance_under_even_sky(roughness: float) -> None:
    ball, _ = repair(mesh_of(trimesh.creation.icosphere(4)), 1.0)
    even = sky((2, 2, 2), (2, 2, 2))
    white, black = (light_mesh(coated(ball, 0.04, roughness, albedo), even, [], BLACK) for albedo in (1.0, 0.0))
    pose = paths.look_at((4, 0, 0), (0, 0, 0))
    hit = np.isfinite(white.render(pose, LENS, *SIZE, 1)[1])
    np.testing.assert_allclose(red(white, pose)[hit], 2.0, rtol=1e-4)
    # Without a ground, the coat's reflection is left. Cosines at the points where the pixels' rays meet the sphere:
    direction = ray_directions(LENS, *SIZE)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    along = 4 * direction[..., 2]
    cosine = np.sqrt(np.maximum(1 - (16 - along**2), 0))
    inside = cosine > 0.2
    expected = 2.0 * (0.04 + 0.96 * (1 - cosine) ** 5)
    np.testing.assert_allclose(red(black, pose)[inside], expected[inside], rtol=0.05)
    assert red(black, pose)[30, 40] == pytest.approx(2.0 * 0.04, rel=1e-2)


def test_mirror_shows_lamp() -> None:
    lamp = AreaLight((0.8, 0.2, 2.0), (0.5, 0.1, 0), (0.06, -0.3, 0), (10.0, 20.0, 30.0))
    scene = light_mesh(coated(plate(2.0), 0.1, 0.0, 0.0), NIGHT, [lamp], BLACK)
    x, y = (ray_directions(LENS, *SIZE)[..., :2] * [3.0, -3.0]).transpose(2, 0, 1)
    # The eye is 3 m above the mirror, the lamp 2 m above it: the ray goes on by 2 / 3 of its way.
    there = np.stack([x * 5 / 3 - 0.8, y * 5 / 3 - 0.2], axis=-1)
    place = np.abs(np.linalg.solve(np.array([[0.5, 0.06], [0.1, -0.3]]), there[..., None])[..., 0]).max(-1)
    square = (x**2 + y**2) / 9
    fresnel = 0.1 + 0.9 * (1 - 1 / np.sqrt(1 + square)) ** 5
    picture = scene.render(OVERHEAD, LENS, *SIZE, 1)[0]
    inside, outside = place < 0.9, place > 1.1
    assert inside.sum() > 50
    np.testing.assert_allclose(picture[inside], fresnel[inside, None] * [10.0, 20.0, 30.0], rtol=1e-3)
    assert picture[outside].max() < 1e-3
    away = AreaLight((0.8, 0.2, 2.0), (0.5, 0.1, 0), (-0.06, 0.3, 0), (10.0,) * 3)
    assert red(light_mesh(coated(plate(2.0), 0.1, 0.0, 0.0), NIGHT, [away], BLACK)).max() == 0


def test_rough_highlight() -> None:
    """Each facet mirrors: the share of facets, seen from the eye, that show the lamp."""
    lamp = AreaLight((0, 0, 2.0), (0.2, 0, 0), (0, -0.2, 0), (1.0, 1.0, 1.0))
    roughness = 0.4
    picture = red(light_mesh(coated(plate(2.0), 0.1, roughness, 0.0), NIGHT, [lamp], BLACK))
    slopes = np.random.default_rng(0).normal(scale=roughness**2 / math.sqrt(2), size=(200_000, 2))
    facet = np.concatenate([-slopes, np.ones((len(slopes), 1))], axis=1)
    facet /= np.linalg.norm(facet, axis=1, keepdims=True)
    for column in (40, 43, 46, 49):
        ray = np.array([(column + 0.5 - 40) / 60, -0.5 / 60, -1.0])
        mirrored = ray - 2 * (facet @ ray)[:, None] * facet
        place = 3 * ray[:2] + 2 * mirrored[:, :2] / mirrored[:, 2:]
        share = (np.abs(place) < 0.2).all(axis=1) & (mirrored[:, 2] > 0)
        assert picture[30, column] == pytest.approx(0.1 * share.mean(), rel=0.1)
    assert picture[30, 40] < 0.6 * 0.1


def test_mirror_shows_surfaces() -> None:
    box = mesh_of(trimesh.creation.box((0.5, 0.5, 0.5)).apply_translation((0, 2.0, 1.0)), (0.2, 0.4, 0.8))
    lamp = AreaLight((0, 3.0, 1.5), (0.5, 0, 0), (0, 0.2, 0.4), (9.0, 9.0, 9.0))
    mirror = coated(plate(1.5), 1.0, 0.0)
    scene = light_mesh(joined(mirror, box), NIGHT, [lamp], BLACK)
    scene = dataclasses.replace(scene, light=np.ones_like(scene.light))
    pose, lens = paths.look_at((0, -2, 1), (0, 0, 0)), (120.0, 120.0, 40.0, 30.0)
    seen = scene.render(pose, lens, *SIZE, 1)[0]
    # The mirrored eye looks at the box from beneath the mirror.
    expected, depth = baked_mesh(box, BLACK).render(np.diag([1, 1, -1, 1]) @ pose, lens, *SIZE, 1)
    on_box = np.isfinite(depth)
    assert on_box.mean() > 0.02
    np.testing.assert_allclose(seen[on_box], expected[on_box], rtol=1e-3)


def test_highlight_of_small_body() -> None:
    """A mirror ball of a few pixels: its highlight does not come and go as the ball moves through the pixels."""
    lamp = AreaLight((3, 3, 4.0), (1.0, 0, 0), (0, -1.0, 0), (50.0, 50.0, 50.0))
    ball = mesh_of(trimesh.creation.icosphere(4, 0.06))
    scene = light_mesh(coated(repair(ball, 1.0)[0], 0.5, 0.0, 0.0), NIGHT, [lamp], BLACK)
    totals = [
        scene.render(OVERHEAD, (60.0, 60.0, 8.0 + shift, 8.0), 16, 16, 4)[0].sum() for shift in np.linspace(0, 1, 9)
    ]
    assert np.std(totals) < 0.25 * np.mean(totals)
