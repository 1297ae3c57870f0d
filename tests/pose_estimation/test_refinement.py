"""Poses that follow tracks: the arithmetic, on tracks whose errors are known."""

from typing import Literal

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from aenerf_ns.camera.alignment import pose_errors
from aenerf_ns.camera.noise import perturb
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.errors import DataError
from aenerf_ns.pose_estimation.bundle_adjustment import TrackAdjustment, Tracks, move_poses
from aenerf_ns.pose_estimation.from_poses import poses_between_images, require_near_mount
from aenerf_ns.pose_estimation.refinement import PoseRefinement, SharedError
from aenerf_ns.simulator.paths import look_at

FOCAL, COUNT, POINTS = 100.0, 40, 400
SECONDS = np.linspace(0, 1.2, COUNT)


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    """(40, 3, 4) poses on an arc around the points."""
    eyes = [(2.5 * np.sin(turn), -2.5 * np.cos(turn), 0.3 * np.sin(5 * turn)) for turn in SECONDS]
    return np.stack([look_at(eye, (0.0, 0.0, 0.0))[:3] for eye in eyes])


def tracks_of(truth: np.ndarray, pixels: float, given: np.ndarray, count: int = COUNT) -> Tracks:
    """Tracks of 400 points whose features are off by some pixels, each seen in 8 to 20 of the first images in a row.

    The points lie where the given poses put their first and last feature.
    """
    generator = np.random.default_rng(0)
    positions = generator.uniform(-1, 1, (POINTS, 3))
    first = generator.integers(0, count - 8, POINTS)
    length = np.minimum(generator.integers(8, 21, POINTS), count - first)
    points = np.repeat(np.arange(POINTS), length)
    images = np.concatenate([np.arange(a, a + n) for a, n in zip(first, length, strict=True)])
    local = np.einsum("mji,mj->mi", truth[images, :, :3], positions[points] - truth[images, :, 3])
    rays = local[:, :2] / local[:, 2:] + generator.normal(size=(len(images), 2)) * pixels / FOCAL
    starts = np.cumsum(length) - length
    ends = starts + length - 1
    directions, origins = [], []
    for rows in (starts, ends):
        through = np.concatenate([rays[rows], np.ones((POINTS, 1))], 1)
        directions.append(np.einsum("mij,mj->mi", given[images[rows], :, :3], through))
        origins.append(given[images[rows], :, 3])
    # The middle of the shortest line between the two rays.
    system = np.stack([directions[0], -directions[1]], -1)
    offsets = origins[1] - origins[0]
    depths = np.stack([np.linalg.lstsq(a, b, rcond=None)[0] for a, b in zip(system, offsets, strict=True)])
    met = [origins[k] + directions[k] * depths[:, k, None] for k in (0, 1)]
    return Tracks(images, points, rays, (met[0] + met[1]) / 2, FOCAL)


def refine(truth: np.ndarray, given: np.ndarray, pixels: float, count: int = COUNT) -> PoseRefinement:
    refinement = PoseRefinement(SECONDS, given, depth=2.5, seed=0)
    for _ in range(3):
        refinement.follow(tracks_of(truth, pixels, refinement.poses, count))
    return refinement


def errors(poses: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    found = pose_errors(torch.from_numpy(poses), torch.from_numpy(truth))
    return found["rotation_error_degrees"], found["translation_error"]


def noisy(truth: np.ndarray, degrees: float, translation: float) -> np.ndarray:
    path = Trajectory((SECONDS * 1e9).astype(np.int64), torch.from_numpy(truth))
    return perturb(path, degrees, translation, 0.2, seed=1).camera_to_worlds.numpy()


def test_gradient_and_hessian_are_those_of_the_cost(truth: np.ndarray) -> None:
    given = noisy(truth, 0.3, 0.01)
    tracks = tracks_of(truth, 0.0, given)
    generator = np.random.default_rng(1)
    direction = generator.normal(size=(COUNT, 6))

    def adjusted(step: float) -> tuple[TrackAdjustment, np.ndarray]:
        adjustment, poses = TrackAdjustment(tracks, 0), move_poses(given, step * direction)
        adjustment.adjust_points(poses, 30)
        return adjustment, poses

    def cost(step: float) -> float:
        adjustment, poses = adjusted(step)
        positions = adjustment.positions[tracks.points]
        local = np.einsum("mji,mj->mi", poses[tracks.images, :, :3], positions - poses[tracks.images, :, 3])
        squares = np.square(FOCAL * (local[:, :2] / local[:, 2:] - tracks.rays)).sum(1)
        return 0.5 * np.log1p(squares).sum()

    slope = (cost(1e-5) - cost(-1e-5)) / 2e-5
    adjustment, poses = adjusted(0.0)
    assert adjustment.linearize(poses)[1].sum(0) @ direction.ravel() == pytest.approx(slope, rel=1e-3)
    # At the true poses the errors are zero, and Gauss and Newton's Hessian is exact.
    exact = TrackAdjustment(tracks_of(truth, 0.0, truth), 0)
    exact.adjust_points(truth, 5)
    hessian, _ = exact.linearize(truth)
    moved = move_poses(truth, 1e-5 * direction)
    exact.adjust_points(moved, 5)
    expected = 1e-5 * hessian @ direction.ravel()
    np.testing.assert_allclose(exact.linearize(moved)[1].sum(0), expected, atol=2e-8 * np.abs(hessian).max())


@pytest.mark.parametrize(("degrees", "left"), [(0.5, 0.75), (2.5, 0.2)])
def test_wrong_poses_follow_the_tracks(truth: np.ndarray, degrees: float, left: float) -> None:
    given = noisy(truth, degrees, 0.03 * degrees)
    refinement = refine(truth, given, pixels=0.3)
    before, after = errors(given, truth), errors(refinement.poses, truth)
    assert after[0] < left * before[0]
    assert after[1] < (left + 0.2) * before[1]
    assert refinement.is_weak().mean() < 0.3


def test_a_late_clock_and_a_wrong_mount_are_found_and_named(truth: np.ndarray) -> None:
    # The camera looks around while it moves: around an object, a late clock is a world that is turned.
    truth = np.stack(
        [
            look_at(eye, (np.sin(4 * t), np.cos(3 * t), 0.5 * np.sin(5 * t)))[:3]
            for eye, t in zip(truth[:, :, 3], SECONDS, strict=True)
        ]
    )
    path = Trajectory((SECONDS * 1e9).astype(np.int64), torch.from_numpy(truth))
    late = path.interpolate(np.rint((SECONDS - 0.02).clip(0) * 1e9).astype(np.int64)).numpy()
    given = move_poses(late, np.tile([0, 0, 0, -0.02, -0.03, 0], (COUNT, 1)))
    refinement = refine(truth, given, pixels=0.3)
    assert errors(refinement.poses, truth)[0] < 0.2 * errors(given, truth)[0]
    found = refinement.shared_error()
    assert found.clock_offset == pytest.approx(0.02, rel=0.1)
    assert found.mount[3:] == pytest.approx([0.02, 0.03, 0.0], abs=0.012)
    assert found.share > 0.9
    assert "ms ahead of that of the events and the camera were turned by" in found.summary()
    # Poses that do not move have no clock.
    still = PoseRefinement(SECONDS, np.repeat(truth[:1], COUNT, 0), depth=2.5, seed=0)
    still.follow(tracks_of(truth, 0.3, truth))
    assert np.isfinite(still.poses).all()
    others = refine(truth, noisy(truth, 1.5, 0.04), pixels=0.3).shared_error()
    assert others.share < 0.5


def test_exact_poses_stay(truth: np.ndarray) -> None:
    refinement = refine(truth, truth, pixels=0.6)
    degrees, distance = errors(refinement.poses, truth)
    assert degrees < 0.02
    assert distance < 0.002
    assert refinement.is_weak().all()


def test_poses_without_tracks_stay_as_given(truth: np.ndarray) -> None:
    given = noisy(truth, 2.5, 0.08)
    refinement = refine(truth, given, pixels=0.3, count=26)
    assert not refinement.is_weak()[:20].any()
    assert refinement.is_weak()[36:].all()
    assert errors(refinement.poses[:26], truth[:26])[0] < 0.3 * errors(given[:26], truth[:26])[0]
    # As given, but for what the last images with tracks tell of the next ones.
    assert np.abs(refinement.twists[36:]).max() < 0.3 * np.abs(refinement.twists).max()


def refined_images(
    truth: np.ndarray,
    chosen: np.ndarray,
    shake: float,
    kind: Literal["smooth", "gauss-markov"],
    correlation_time: float,
) -> tuple[Trajectory, Trajectory, np.ndarray, PoseRefinement]:
    """True and given poses every 4 ms, and the times and the refinement of images whose poses it has mended."""
    images = (SECONDS * 1e9).astype(np.int64)
    times = np.arange(-20_000_000, 1_220_000_000, 4_000_000)
    path = Trajectory(images, torch.from_numpy(truth))
    # The camera stands still ahead of the first image and after the last. It shakes faster than images show.
    steady = Trajectory(times, path.interpolate(times.clip(0, images[-1])))
    true = perturb(steady, shake, 0.0, 0.01, seed=2)
    given = perturb(true, 1.5, 0.04, correlation_time, seed=1, kind=kind)
    images = images[chosen]
    refinement = PoseRefinement(SECONDS[chosen], given.interpolate(images).numpy(), depth=2.5, seed=0)
    back = given.interpolate(images)[:, :, :3].mT
    moves = (back @ (true.interpolate(images) - given.interpolate(images))[:, :, 3:])[..., 0]
    turns = Rotation.from_matrix(back @ true.interpolate(images)[:, :, :3]).as_rotvec()
    refinement.twists = np.concatenate([moves, turns], 1)
    return true, given, images, refinement


@pytest.mark.parametrize(
    ("shake", "kind", "correlation_time", "left"),
    # A spline would be better in the second case, too, by little.
    [(0.5, "smooth", 0.3, 0.03), (0.0, "smooth", 0.3, 0.03), (0.0, "gauss-markov", 0.08, 0.01)],
)
def test_poses_between_images_keep_the_given_motion_unless_it_jumps(
    truth: np.ndarray, shake: float, kind: Literal["smooth", "gauss-markov"], correlation_time: float, left: float
) -> None:
    true, given, images, refinement = refined_images(truth, np.arange(COUNT), shake, kind, correlation_time)
    found, is_interpolated = poses_between_images(given, images, refinement, 2.5)
    assert is_interpolated == (kind == "gauss-markov")
    assert torch.equal(found.times, given.times)
    inside = (given.times >= 0) & (given.times <= images[-1])
    degrees, distance = errors(found.camera_to_worlds[inside].numpy(), true.camera_to_worlds[inside].numpy())
    assert degrees < left
    assert distance < 0.05 * left


def test_poses_far_from_images_keep_the_given_motion(truth: np.ndarray) -> None:
    chosen = np.r_[0:12, 26:COUNT]
    true, given, images, refinement = refined_images(truth, chosen, 0.0, "gauss-markov", 0.08)
    found, is_interpolated = poses_between_images(given, images, refinement, 2.5)
    assert is_interpolated
    far = (given.times < 0) | ((given.times > images[11]) & (given.times < images[12])) | (given.times > images[-1])
    twists = np.stack([np.interp(given.times, images, column) for column in refinement.twists.T], -1)
    moved = move_poses(given.camera_to_worlds.numpy(), twists)
    np.testing.assert_allclose(found.camera_to_worlds[far], moved[far], atol=1e-12)
    assert errors(found.camera_to_worlds[~far].numpy(), true.camera_to_worlds[~far].numpy())[0] < 0.03


def test_poses_that_tracks_contradict_are_refused() -> None:
    turned = np.array([0.0, 0.0, 0.5, 0.1, 0.0, 0.0])
    require_near_mount(SharedError(0.01, turned, 1.0), 2.5, "scene")
    message = r"scene: .* moved by 2 of their units .* the scene is 2.5 away; .*--poses events"
    with pytest.raises(DataError, match=message):
        require_near_mount(SharedError(0.01, 4 * turned, 1.0), 2.5, "scene")
