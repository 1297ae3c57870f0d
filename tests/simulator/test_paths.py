"""Camera paths, their speed, and the space that they need."""

import numpy as np
import pytest
from helpers.small_meshes import WALK, plate
from scipy.integrate import quad

from aenerf_ns.simulator import paths


def test_look_at() -> None:
    pose = paths.look_at((1, 2, 3), (1, 5, 3))
    np.testing.assert_allclose(pose[:3, :3], np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), atol=1e-12)
    rolled = paths.look_at((1, 2, 3), (1, 5, 3), roll=0.3)
    # A roll to the right lowers the right side of the camera.
    np.testing.assert_allclose(rolled[:3, 0], [np.cos(0.3), 0, -np.sin(0.3)], atol=1e-12)


@pytest.mark.parametrize("path", [paths.RoomPath(), paths.ObjectPath()], ids=["room", "object"])
def test_paths_are_smooth(path: paths.CameraPath) -> None:
    poses = np.stack([path(s) for s in np.linspace(0, 1, 8001)])
    np.testing.assert_allclose(poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1) - np.eye(3), 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1, atol=1e-12)
    # Continuous second derivatives: those of neighbors differ by a small part of their size.
    second = np.diff(poses[:, :3], n=2, axis=0) * 8000**2
    assert np.abs(np.diff(second, axis=0)).max() < 0.02 * np.abs(second).max()


def test_room_path_turns_about_every_axis() -> None:
    path = paths.RoomPath()
    np.testing.assert_allclose(path(0.0), path(1.0), atol=1e-12)
    step = 1e-5
    rates = []
    for s in np.linspace(0, 1, 200):
        relative = path(s)[:3, :3].T @ path(s + step)[:3, :3]
        rates.append(np.array([relative[2, 1], relative[0, 2], relative[1, 0]]) / step)
    assert (np.abs(rates).max(0) > 0.5).all()


def test_object_path_is_a_spiral() -> None:
    poses = np.stack([paths.ObjectPath(turns=3.0)(s) for s in np.linspace(0, 1, 3001)])
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


def test_walk_is_closed_and_smooth() -> None:
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


def test_a_track_passes_its_poses_and_has_views_beside_it() -> None:
    walk = paths.WalkPath(WALK["positions"], WALK["targets"])
    poses = np.stack([walk(s) for s in np.linspace(0, 0.6, 7)])
    track = paths.TrackPath(poses, 0.4)
    for s, pose in zip(np.linspace(0, 1, 7), poses, strict=True):
        np.testing.assert_allclose(track(s), pose, atol=1e-9)
    on_it = np.stack([track(s)[:3, 3] for s in np.linspace(0, 1, 200)])
    views = np.concatenate([track.validation_views(4), track.test_views(4, 0)])
    far = np.linalg.norm(views[:, None, :3, 3] - on_it, axis=-1).min(1)
    assert 0.01 < np.median(far) < far.max() < 1


def test_free_space() -> None:
    space = paths.FreeSpace(plate(1.0).caster, 0.1 / 0.13)
    assert space.is_free((0, 0, 0.11))
    assert not space.is_free((0, 0, -0.09))
    assert space.is_reached((0, 0, 0.5), (0.5, 0, 0.5))
    assert not space.is_reached((0, 0, 0.5), (0.5, 0, -0.5))
