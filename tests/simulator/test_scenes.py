"""The ray caster against closed forms, the paths, the spacing of frames, and the promises the built-in scenes make."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator

import numba
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from aenerf_ns.simulator import paths
from aenerf_ns.simulator import textures as tx
from aenerf_ns.simulator.frames import frame_displacement, frame_parameters
from aenerf_ns.simulator.open_scene import built_in_scene
from aenerf_ns.simulator.rendering.light_baking import AreaLight, bake
from aenerf_ns.simulator.rendering.raycast import BOX, CYLINDER, RECTANGLE, SPHERE, Primitive, PrimitiveScene
from aenerf_ns.simulator.rendering.renderer import sample_offsets
from aenerf_ns.simulator.scene import SimulationScene

WHITE = {"white": np.full((8, 8, 3), 0.5, np.float32)}
OVERHEAD = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 3], [0, 0, 0, 1]])
"""A camera 3 m above the origin that looks down, its x axis along the world's."""


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """These pictures are too small to share: on a busy machine, waiting for a second thread takes longer."""
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(threads)


@pytest.fixture(scope="module")
def room() -> SimulationScene:
    return built_in_scene("room")


@pytest.fixture(scope="module")
def toy() -> SimulationScene:
    return built_in_scene("object")


def lit_evenly(primitives: list[Primitive], textures: dict[str, tx.Texture] = WHITE) -> PrimitiveScene:
    return bake(primitives, textures, [], spacing=0.5, ambient=1.0, background=(0.2, 0.3, 0.4))


def ray_directions(intrinsics: tuple[float, ...], width: int, height: int) -> np.ndarray:
    fx, fy, cx, cy = intrinsics
    y, x = np.mgrid[:height, :width]
    return np.stack([(x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, np.ones((height, width))], axis=-1)


# --- textures


@pytest.mark.parametrize("exponent", [0.8, 1.5])
def test_spectral_noise_has_its_spectrum(exponent: float) -> None:
    noise = tx.spectral_noise(128, np.random.default_rng(0), exponent)
    assert abs(noise.mean()) < 1e-12
    assert abs(noise.std() - 1) < 1e-12
    frequency = np.fft.fftfreq(128) * 128
    radius = np.hypot(frequency[:, None], frequency[None, :])
    power = np.abs(np.fft.fft2(noise)) ** 2
    rings = np.array([2, 4, 8, 16, 32])
    ring_power = [power[(radius >= r) & (radius < 2 * r)].mean() for r in rings]
    slope = np.polyfit(np.log(rings), np.log(ring_power), 1)[0]
    assert abs(slope + 2 * exponent) < 0.25


def test_mip_pyramid_keeps_the_mean() -> None:
    texture = np.random.default_rng(0).random((16, 16, 3)).astype(np.float32)
    levels = tx.mip_pyramid(texture)
    assert [len(level) for level in levels] == [16, 8, 4, 2, 1]
    np.testing.assert_allclose(levels[-1][0, 0], texture.mean((0, 1)), rtol=1e-5)
    np.testing.assert_allclose(levels[1][2, 3], texture[4:6, 6:8].mean((0, 1)), rtol=1e-5)


def test_linear_colour_is_srgb() -> None:
    np.testing.assert_allclose(tx.linear_colour("00bcff"), [0, 0.502886, 1], atol=1e-6)


# --- ray caster


@pytest.mark.parametrize(
    ("kind", "half"),
    [(RECTANGLE, (0.8, 0.6, 0.0)), (BOX, (0.5, 0.4, 0.3)), (SPHERE, (0.7, 0.7, 0.7)), (CYLINDER, (0.6, 0.6, 0.4))],
)
def test_depth_and_silhouette_match_the_solid(kind: int, half: tuple[float, ...]) -> None:
    """Every hit lies on the surface of the turned solid; a march along the ray finds a solid where it is hit only."""
    rng = np.random.default_rng(kind)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0] if kind != RECTANGLE else np.eye(3)
    rotation *= np.sign(np.linalg.det(rotation))
    centre = np.array([0.1, -0.2, 0.3])
    scene = lit_evenly([Primitive(kind, centre, half, "white", rotation=rotation)])
    width, height, intrinsics = 24, 20, (20.0, 22.0, 12.3, 9.1)
    _, depth, alpha = scene.render(OVERHEAD, intrinsics, width, height, 1)
    directions = ray_directions(intrinsics, width, height) @ OVERHEAD[:3, :3].T

    def inside(points: np.ndarray, slack: float) -> np.ndarray:
        p = (points - centre) @ rotation
        if kind == SPHERE:
            return np.linalg.norm(p, axis=-1) <= half[0] + slack
        if kind == CYLINDER:
            return (np.hypot(p[..., 0], p[..., 1]) <= half[0] + slack) & (abs(p[..., 2]) <= half[2] + slack)
        return (abs(p) <= np.array(half) + slack).all(-1)

    hit = np.isfinite(depth)
    np.testing.assert_array_equal(alpha, hit.astype(np.float32))
    assert 20 < hit.sum() < width * height - 20
    points = OVERHEAD[:3, 3] + directions * np.where(hit, depth, 0)[..., None].astype(np.float64)
    slack = 1e-5
    assert inside(points, slack)[hit].all()
    # Nothing before the hit, and nothing at all along a miss, is well inside.
    steps = np.linspace(0, 1, 400)[:, None, None] * np.where(hit, depth - 1e-4, 5.0)
    marched = OVERHEAD[:3, 3] + directions * steps[..., None]
    assert not inside(marched, -1e-3 if kind != RECTANGLE else 1e-5).any()


def test_rectangle_is_seen_from_its_front_only() -> None:
    scene = lit_evenly([Primitive(RECTANGLE, (0, 0, 0), (1, 1, 0), "white")])
    below = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -3], [0, 0, 0, 1]])
    assert scene.render(OVERHEAD, (10, 10, 2, 2), 4, 4, 1)[2].all()
    radiance, depth, alpha = scene.render(below, (10, 10, 2, 2), 4, 4, 1)
    assert not alpha.any()
    assert np.isinf(depth).all()
    np.testing.assert_allclose(radiance, np.broadcast_to([0.2, 0.3, 0.4], (4, 4, 3)), rtol=1e-6)


def test_texture_coordinates() -> None:
    """A linear ramp along u, seen head-on: the value at each pixel's centre, half texels and all."""
    ramp = np.repeat(np.repeat(np.linspace(0.1, 0.8, 64)[None, :, None], 64, axis=0), 3, axis=2).astype(np.float32)
    plate = Primitive(RECTANGLE, (0, 0, 0), (1, 1, 0), "ramp", texture_scale=2.0, texture_offset=(0.5, 0.5))
    scene = lit_evenly([plate], {"ramp": ramp})
    radiance, depth, _ = scene.render(OVERHEAD, (30.0, 30.0, 8.0, 6.0), 16, 12, 1)
    np.testing.assert_allclose(depth, 3.0, rtol=1e-6)
    x = (np.arange(16) + 0.5 - 8.0) / 30.0 * 3.0
    texel = (x / 2 + 0.5) * 64 - 0.5
    expected = np.broadcast_to(0.1 + 0.7 * texel / 63, (12, 16))
    np.testing.assert_allclose(radiance[..., 0], expected, rtol=2e-5)


def test_far_textures_fade_to_their_mean() -> None:
    noise = np.random.default_rng(0).uniform(0.1, 0.9, (64, 64, 3)).astype(np.float32)
    scene = lit_evenly([Primitive(RECTANGLE, (0, 0, 0), (50, 50, 0), "noise", texture_scale=0.05)], {"noise": noise})
    radiance, _, _ = scene.render(OVERHEAD, (10.0, 10.0, 4.0, 4.0), 8, 8, 1)
    np.testing.assert_allclose(radiance, np.broadcast_to(noise.mean((0, 1)), (8, 8, 3)), rtol=1e-4)


def test_direct_light_is_the_form_factor() -> None:
    """A small area light above a plate, against radiance x area x cos x cos / (pi d^2)."""
    plate = Primitive(RECTANGLE, (0, 0, 0), (2, 2, 0), "white")
    light = AreaLight((0.5, 0, 2.0), (0.01, 0, 0), (0, -0.01, 0), (100.0, 200.0, 300.0))
    scene = bake([plate], WHITE, [light], spacing=0.1, ambient=0.0)
    radiance, _, _ = scene.render(OVERHEAD, (6.0, 6.0, 4.0, 4.0), 8, 8, 1)
    x, y = ray_directions((6.0, 6.0, 4.0, 4.0), 8, 8)[..., :2].transpose(2, 0, 1) * 3.0
    square = (x - 0.5) ** 2 + y**2 + 4.0
    expected = 0.5 * 100.0 * 0.0004 * 4.0 / (np.pi * square**2)
    np.testing.assert_allclose(radiance[..., 0], expected, rtol=5e-3)
    np.testing.assert_allclose(radiance[..., 2], 3 * radiance[..., 0], rtol=1e-5)


def test_shadow() -> None:
    plate = Primitive(RECTANGLE, (0, 0, 0), (2, 2, 0), "white")
    roof = Primitive(BOX, (1.0, 0, 0.5), (0.4, 2, 0.01), "white")
    light = AreaLight((1.0, 0, 2.0), (0.01, 0, 0), (0, -0.01, 0), (1.0,) * 3)
    lit, shaded = (bake(parts, WHITE, [light], spacing=0.05, ambient=0.0) for parts in ([plate], [plate, roof]))
    # The penumbra's edge, projected from the light: 1 +- 0.4 * 2 / 1.5.
    sight = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.4], [0, 0, 0, 1]])
    values = [scene.render(sight, (10.0, 10.0, 20.0, 1.0), 80, 2, 1)[0][0, :, 0] for scene in (lit, shaded)]
    x = (np.arange(80) + 0.5 - 20.0) / 10.0 * 0.4
    seen = (x > -0.7) & (x < 1.9)
    shadow = abs(x - 1.0) < 0.53 - 0.08
    clear = seen & (abs(x - 1.0) > 0.53 + 0.08)
    assert shadow.sum() > 10
    assert clear.sum() > 10
    # One bounce off the roof's underside is all that reaches the shadow.
    assert (values[1][shadow] < 0.35 * values[0][shadow]).all()
    assert (values[1][clear] > 0.98 * values[0][clear]).all()


def test_sky_light() -> None:
    """An unoccluded plate that faces up receives the cosine-weighted mean of a sky that is linear in height."""
    scene = bake(
        [Primitive(RECTANGLE, (0, 0, 0), (1, 1, 0), "white")],
        WHITE,
        [],
        spacing=0.5,
        ambient=0.0,
        sky=((0.0, 0.0, 0.0), (1.0, 2.0, 0.5)),
    )
    radiance, _, _ = scene.render(OVERHEAD, (30.0, 30.0, 4.0, 4.0), 8, 8, 1)
    mean = 0.5 * (0.5 + 0.5 * 2 / 3)  # albedo x the mean of (1 + cos) / 2 over cosine-weighted directions
    np.testing.assert_allclose(radiance.mean((0, 1)), mean * np.array([1.0, 2.0, 0.5]), rtol=0.01)


@pytest.mark.parametrize("samples", [4, 16])
def test_sample_offsets_are_the_point_spread(samples: int) -> None:
    offsets = sample_offsets(samples)
    np.testing.assert_allclose(offsets.mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(offsets.T @ offsets / samples, 0.25 * np.eye(2), atol=1e-12)
    np.testing.assert_array_equal(sample_offsets(1), [[0, 0]])
    for bad in (0, 2):
        with pytest.raises(ValueError, match=f"got {bad}"):
            sample_offsets(bad)


def test_edge_is_blurred_by_the_point_spread() -> None:
    scene = lit_evenly([Primitive(RECTANGLE, (1.0, 0, 0), (1.0, 2.0, 0), "white")])
    # The edge x = 0 crosses the pixels at cx; moving cx moves it through the pixel.
    shifts = np.linspace(-1.5, 1.5, 21)
    alpha = np.array([scene.render(OVERHEAD, (50.0, 50.0, 2.5 - d, 2.5), 5, 5, 300)[2][2, 2] for d in shifts])
    np.testing.assert_allclose(alpha, norm.cdf(shifts, scale=0.5), atol=0.02)


def test_bad_textures() -> None:
    plate = Primitive(RECTANGLE, (0, 0, 0), (1, 1, 0), "a")
    for textures in ({"a": np.ones((6, 6, 3), np.float32)}, {"a": WHITE["white"], "b": np.ones((4, 4, 3), np.float32)}):
        with pytest.raises(ValueError, match="power of two"):
            lit_evenly([plate], textures)
    with pytest.raises(KeyError):
        lit_evenly([plate])


# --- paths


def test_look_at() -> None:
    pose = paths.look_at((1, 2, 3), (1, 5, 3))
    np.testing.assert_allclose(pose[:3, :3], np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), atol=1e-12)
    rolled = paths.look_at((1, 2, 3), (1, 5, 3), roll=0.3)
    # A roll to the right lowers the right side of the camera.
    np.testing.assert_allclose(rolled[:3, 0], [np.cos(0.3), 0, -np.sin(0.3)], atol=1e-12)


@pytest.mark.parametrize("path", [paths.room_path, paths.object_path], ids=["room", "object"])
def test_paths_are_smooth(path: object) -> None:
    poses = np.stack([path(s) for s in np.linspace(0, 1, 8001)])  # type: ignore[operator]
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (8001, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1, atol=1e-12)
    # Continuous second derivatives: those of neighbours differ by a small part of their size.
    second = np.diff(poses[:, :3], n=2, axis=0) * 8000**2
    assert np.abs(np.diff(second, axis=0)).max() < 0.02 * np.abs(second).max()


def test_room_path_is_a_loop_that_turns_about_every_axis() -> None:
    np.testing.assert_allclose(paths.room_path(0.0), paths.room_path(1.0), atol=1e-12)
    step = 1e-5
    rates = []
    for s in np.linspace(0, 1, 200):
        relative = paths.room_path(s)[:3, :3].T @ paths.room_path(s + step)[:3, :3]
        rates.append(np.array([relative[2, 1], relative[0, 2], relative[1, 0]]) / step)
    assert (np.abs(rates).max(0) > 0.5).all()


def test_object_path_is_a_hemisphere_spiral() -> None:
    poses = np.stack([paths.object_path(s, turns=3.0) for s in np.linspace(0, 1, 3001)])
    positions = poses[:, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 4.0, rtol=1e-12)
    np.testing.assert_allclose(positions[[0, -1], 2], [0, 4.0], atol=1e-12)
    azimuth = np.unwrap(np.arctan2(positions[:-1, 1], positions[:-1, 0]))
    np.testing.assert_allclose(azimuth[-1] - azimuth[0], 6 * np.pi * 2999 / 3000, rtol=1e-9)
    np.testing.assert_allclose(poses[:, :3, 2], -positions / 4.0, atol=1e-12)


def test_hard_speed() -> None:
    easy, hard = paths.SpeedProfile("easy", 4.0), paths.SpeedProfile("hard", 4.0)
    times = np.array([0.0, 0.1, 0.4, 1.0, hard.duration])
    for time, parameter in zip(times, hard.parameter(times), strict=True):
        integral = quad(lambda t: 8 ** np.sin(2 * np.pi * t) / 4.0, 0, time, epsabs=1e-13, limit=200)[0]
        assert abs(integral - parameter) < 1e-12
    assert abs(hard.parameter(hard.duration) - 1) < 1e-13
    assert abs(hard.parameter(1.0) * 4.0 - paths.HARD_MEAN_SPEED) < 1e-13
    parameters = np.linspace(0, 1, 5000)
    np.testing.assert_allclose(hard.parameter(hard.time(parameters)), parameters, atol=1e-13)
    assert (np.diff(hard.time(parameters)) > 0).all()
    assert easy.duration == 4.0
    assert easy.time(0.25) == 1.0
    assert easy.parameter(1.0) == 0.25
    long = paths.SpeedProfile("hard", 100 * paths.HARD_MEAN_SPEED)
    assert abs(long.duration - 100) < 1e-9
    for name, duration in (("medium", 1.0), ("easy", 0.0)):
        with pytest.raises(ValueError, match="got"):
            paths.SpeedProfile(name, duration)


# --- spacing of frames


def test_frame_displacement_of_a_turn_and_of_a_shift() -> None:
    intrinsics, depth = (50.0, 50.0, 16.0, 12.0), np.full((24, 32), 2.0)
    shifted = np.eye(4)
    shifted[0, 3] = 0.1
    assert abs(frame_displacement(depth, np.eye(4), shifted, intrinsics) - 50 * 0.1 / 2) < 1e-12
    rolled = np.eye(4)
    rolled[:2, :2] = [[np.cos(0.01), -np.sin(0.01)], [np.sin(0.01), np.cos(0.01)]]
    directions = ray_directions(intrinsics, 32, 24)[..., :2] * 50
    expected = np.percentile(np.linalg.norm(directions, axis=-1) * 2 * np.sin(0.005), 99)
    assert abs(frame_displacement(depth, np.eye(4), rolled, intrinsics) - expected) < 1e-12
    behind = np.eye(4)
    behind[2, 3] = 3.0
    assert frame_displacement(depth, np.eye(4), behind, intrinsics) == np.inf
    nothing = np.full((24, 32), np.inf)
    assert frame_displacement(nothing, np.eye(4), shifted, intrinsics) == 0
    assert frame_displacement(nothing, np.eye(4), shifted @ rolled, intrinsics, sees_infinity=True) == pytest.approx(
        expected, abs=1e-12
    )


def test_frame_parameters_bound_the_motion(toy: SimulationScene) -> None:
    width, height = 40, 30
    intrinsics = toy.intrinsics(width, height)

    def path(s: float) -> np.ndarray:
        return paths.object_path(s, turns=3.0)

    scene = dataclasses.replace(toy, path=path)
    parameters = frame_parameters(scene, intrinsics, width, height, 1.0)
    assert parameters[0] == 0
    assert parameters[-1] == 1
    assert (np.diff(parameters) > 0).all()
    moved = []
    for a, b in itertools.pairwise(parameters):
        depth = toy.renderer.render(path(a), intrinsics, width, height, 1)[1]
        moved.append(frame_displacement(depth, path(a), path(b), intrinsics))
    # The bound holds for the coarse depth map of the search; the full one's percentile differs a little.
    assert max(moved) < 1.1
    assert np.mean(moved[1:-1]) > 0.9
    with pytest.raises(ValueError, match="must be positive, got 0"):
        frame_parameters(scene, intrinsics, width, height, 0.0)


# --- built-in scenes


def test_room_is_closed_and_well_exposed(room: SimulationScene) -> None:
    width, height = 64, 48
    pictures = []
    for pose in [*(room.path(k / 12) for k in range(12)), *room.validation_views(12), *room.test_views(40, 3)]:
        radiance, depth, alpha = room.renderer.render(pose, room.intrinsics(width, height), width, height, 4)
        assert alpha.min() == 1
        assert depth.min() > 0.2  # nowhere inside the furniture or right in front of it
        pictures.append(radiance)
    radiance = np.stack(pictures)
    low, median, high = np.percentile(radiance, [1, 50, 99])
    assert low > 0.008
    assert 0.1 < median < 0.4
    assert high < 0.95
    assert radiance.max() < 1.05


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
    assert toy.aabb is not None
    assert toy.background is not None
    width, height = 60, 45
    intrinsics = toy.intrinsics(width, height)
    for pose in [*(toy.path(k / 7) for k in range(8)), *toy.validation_views(6), *toy.test_views(6, 1)]:
        radiance, depth, _ = toy.renderer.render(pose, intrinsics, width, height, 1)
        hit = np.isfinite(depth)
        assert 0.1 < hit.mean() < 0.6
        points = (ray_directions(intrinsics, width, height)[hit] * depth[hit][:, None]) @ pose[:3, :3].T + pose[:3, 3]
        assert (points > toy.aabb[0]).all()
        assert (points < toy.aabb[1]).all()
        np.testing.assert_allclose(radiance[~hit], np.broadcast_to(toy.background, (int((~hit).sum()), 3)))
        assert radiance.max() < 1.05


def test_held_out_views_are_off_the_path_and_seeded(room: SimulationScene, toy: SimulationScene) -> None:
    for scene in (room, toy):
        validation, test = scene.validation_views(30), scene.test_views(30, 5)
        assert validation.shape == test.shape == (30, 4, 4)
        np.testing.assert_array_equal(test, scene.test_views(30, 5))
        assert not np.array_equal(test, scene.test_views(30, 6))
        on_path = np.stack([scene.path(s) for s in np.linspace(0, 1, 4000)])[:, :3]
        for pose in [*validation, *test]:
            assert np.abs(on_path - pose[:3]).max((1, 2)).min() > 1e-3


def test_pictures_do_not_depend_on_the_run_or_the_threads(toy: SimulationScene) -> None:
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    again = built_in_scene("object")
    pictures = [
        scene.renderer.render(scene.path(0.3), scene.intrinsics(40, 30), 40, 30, 4)[0] for scene in (toy, again)
    ]
    numba.set_num_threads(1)
    assert pictures[0].tobytes() == pictures[1].tobytes()
    np.testing.assert_array_equal(toy.renderer.arrays.light, again.renderer.arrays.light)


def test_unknown_scene() -> None:
    with pytest.raises(ValueError, match="got 'pool'"):
        built_in_scene("pool")
