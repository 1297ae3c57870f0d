"""The promises of the built-in scenes."""

import numpy as np
import pytest
from helpers.small_meshes import ray_directions

from aenerf_ns.simulator.open_scene import open_scene
from aenerf_ns.simulator.rendering import lighting
from aenerf_ns.simulator.scene import SimulationScene


@pytest.fixture(scope="module")
def room() -> SimulationScene:
    return open_scene("room")


@pytest.fixture(scope="module")
def toy() -> SimulationScene:
    return open_scene("object")


def test_room_is_closed_and_well_exposed(room: SimulationScene) -> None:
    width, height = 64, 48
    pictures = []
    for pose in [
        *(room.path(k / 12) for k in range(12)),
        *room.path.validation_views(12),
        *room.path.test_views(40, 3),
    ]:
        radiance, depth = room.renderer.render(pose, room.intrinsics(width, height), width, height, 4)
        assert depth.min() > 0.2  # nowhere inside the furniture or right in front of it
        pictures.append(radiance)
    radiance = np.stack(pictures)
    low, median, high = np.percentile(radiance, [1, 50, 99])
    assert low > 0.008
    assert 0.1 < median < 0.4
    assert high < 0.95
    assert radiance.max() < 1.05


def test_no_ray_leaves_the_room(room: SimulationScene) -> None:
    rng = np.random.default_rng(0)
    eyes = np.repeat([room.path(s)[:3, 3] for s in rng.uniform(size=2000)], 50, axis=0)
    rays = np.concatenate([eyes, rng.normal(size=eyes.shape)], axis=1).astype(np.float32)
    assert np.isfinite(room.renderer.caster.cast(rays).distance).all()
    # Into the edges, where two sides meet, and around the corners, 10 micrometers beside the point itself.
    edges = rng.uniform((-2, -2, 0), (2, 2, 2.5), eyes.shape)
    free = rng.integers(0, 4, len(edges))
    for axis, (low, high) in enumerate(((-2, 2), (-2, 2), (0, 2.5))):
        edges[free != axis, axis] = rng.choice((low, high), int((free != axis).sum()))
    edges[free == 3] += rng.normal(scale=1e-5, size=(int((free == 3).sum()), 3))
    rays[:, 3:] = edges - eyes
    assert np.isfinite(room.renderer.caster.cast(rays).distance).all()


def test_room_is_textured_everywhere(room: SimulationScene) -> None:
    """Along the loop hardly a pixel sees less than a few thresholds' worth of change: no bare walls."""
    width, height = 64, 48
    frames = [
        room.renderer.render(room.path(s), room.intrinsics(width, height), width, height, 4)[0].mean(-1)
        for s in np.linspace(0, 1, 200)
    ]
    change = np.abs(np.diff(np.log(np.stack(frames) + 1e-3), axis=0)).sum(0)
    assert change.min() > 10 * 0.25


def test_object_stays_in_its_box(toy: SimulationScene) -> None:
    width, height = 60, 45
    intrinsics = toy.intrinsics(width, height)
    for pose in [*(toy.path(k / 7) for k in range(8)), *toy.path.validation_views(6), *toy.path.test_views(6, 1)]:
        radiance, depth = toy.renderer.render(pose, intrinsics, width, height, 1)
        hit = np.isfinite(depth)
        assert 0.1 < hit.mean() < 0.6
        points = (ray_directions(intrinsics, width, height)[hit] * depth[hit][:, None]) @ pose[:3, :3].T + pose[:3, 3]
        assert (points > toy.aabb[0]).all()
        assert (points < toy.aabb[1]).all()
        np.testing.assert_allclose(radiance[~hit], np.broadcast_to(toy.renderer.background, (int((~hit).sum()), 3)))
        assert radiance.max() < 1.05


def test_held_out_views(room: SimulationScene, toy: SimulationScene) -> None:
    for scene in (room, toy):
        validation, test = scene.path.validation_views(30), scene.path.test_views(30, 5)
        assert validation.shape == test.shape == (30, 4, 4)
        np.testing.assert_array_equal(test, scene.path.test_views(30, 5))
        assert not np.array_equal(test, scene.path.test_views(30, 6))
        on_path = np.stack([scene.path(s) for s in np.linspace(0, 1, 4000)])[:, :3]
        for pose in [*validation, *test]:
            assert np.abs(on_path - pose[:3]).max((1, 2)).min() > 1e-3


def test_shiny_object_is_object_with_coats(toy: SimulationScene, monkeypatch: pytest.MonkeyPatch) -> None:
    # Light takes seconds, and the coats do not change it.
    monkeypatch.setattr(lighting, "compute_light", lambda *args: toy.renderer.light.copy())
    shiny = open_scene("shiny_object")
    np.testing.assert_equal(shiny.renderer.surface, toy.renderer.surface)
    np.testing.assert_array_equal(toy.path(0.3), shiny.path(0.3))
    size = 80, 60
    intrinsics = toy.intrinsics(*size)
    changed = []
    for s in (0.05, 0.3, 0.6):
        (one, depth), (other, same_depth) = (
            scene.renderer.render(scene.path(s), intrinsics, *size, 1) for scene in (toy, shiny)
        )
        np.testing.assert_array_equal(depth, same_depth)
        assert other.max() < 1 + 1e-5
        changed.append((one != other).any(axis=-1)[np.isfinite(depth)])
    assert 0.5 < np.concatenate(changed).mean() < 0.95  # the track's bed and the coal are diffuse
