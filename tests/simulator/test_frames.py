"""The spacing of frames along a path."""

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.small_meshes import ray_directions, scene_file

from aenerf_ns.simulator.frames import frame_displacement, frame_parameters
from aenerf_ns.simulator.open_scene import open_scene

pytestmark = pytest.mark.usefixtures("small_work")


def test_frame_displacement() -> None:
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
    found = frame_displacement(nothing, np.eye(4), shifted @ rolled, intrinsics, sees_infinity=True)
    assert found == pytest.approx(expected, abs=1e-12)


def test_frame_parameters_bound_the_motion(box_file: Path) -> None:
    width, height = 40, 30
    scene = open_scene(scene_file(box_file, path={"kind": "around", "radius": 2.5, "turns": 3.0}))
    intrinsics, path = scene.intrinsics(width, height), scene.path
    parameters = frame_parameters(scene, intrinsics, width, height, 1.0)
    assert parameters[0] == 0
    assert parameters[-1] == 1
    assert (np.diff(parameters) > 0).all()
    moved = []
    for a, b in itertools.pairwise(parameters):
        depth = scene.renderer.render(path(a), intrinsics, width, height, 1)[1]
        moved.append(frame_displacement(depth, path(a), path(b), intrinsics))
    # The bound holds for the coarse depth map of the search; the full one's percentile differs a little.
    assert max(moved) < 1.1
    assert np.mean(moved[1:-1]) > 0.9


def test_frames_follow_environment(box_file: Path) -> None:
    """Around a box, what is far behind it moves most: an environment there must not, a plain color may."""
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
        # The rotation alone warps points that are infinitely far.
        moved = []
        for first, second in itertools.pairwise(poses[:-1]):
            warp = lens @ second[:3, :3].T @ first[:3, :3] @ np.linalg.inv(lens)
            warped = cv2.perspectiveTransform(corner[:, None], warp)[:, 0]
            moved.append(np.percentile(np.linalg.norm(warped - corner, axis=1), 97))
        fastest.append(max(moved))
    assert 0.45 < fastest[0] < 0.5
    assert fastest[1] > 0.6
