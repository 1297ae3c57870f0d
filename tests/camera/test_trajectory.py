"""Rotations, poses in continuous time, and pose noise."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from aenerf_ns.camera.noise import perturb
from aenerf_ns.camera.rotation import (
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_quaternion,
)
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, Trajectory, homogeneous
from aenerf_ns.errors import DataError

# Unix time in nanoseconds, which float64 seconds cannot hold.
EPOCH = 1_600_000_000_123_456_789


def angles() -> torch.Tensor:
    return torch.tensor([0.0, 1e-12, 1e-6, 9.9e-3, 1.01e-2, 0.5, 2.0, math.pi - 1e-6, math.pi], dtype=torch.float64)


def test_rotation_from_vector_is_the_matrix_exponential() -> None:
    axis = torch.tensor([0.48, -0.6, 0.64], dtype=torch.float64)
    vectors = angles()[:, None] * axis
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    generators = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    torch.testing.assert_close(rotation_from_vector(vectors), torch.matrix_exp(generators), rtol=0, atol=1e-14)


@pytest.mark.parametrize("size", [0.0, 1e-9, 9.99e-3, 1.001e-2, 1.0])
def test_rotation_from_vector_has_exact_first_and_second_derivatives(size: float) -> None:
    vector = (size * torch.tensor([0.48, -0.6, 0.64], dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(rotation_from_vector, vector, atol=1e-8)
    assert torch.autograd.gradgradcheck(rotation_from_vector, vector, atol=1e-6)


def test_quaternions_and_rotations_round_trip() -> None:
    generator = torch.Generator().manual_seed(1)
    axes = torch.nn.functional.normalize(torch.randn(9, 3, generator=generator, dtype=torch.float64), dim=-1)
    rotations = rotation_from_vector(angles()[:, None] * axes)
    quaternions = quaternion_from_rotation(rotations)
    torch.testing.assert_close(quaternions.norm(dim=-1), torch.ones(9, dtype=torch.float64))
    for sign in (1, -1):
        torch.testing.assert_close(rotation_from_quaternion(sign * quaternions), rotations, rtol=0, atol=1e-14)
        back = rotation_from_vector(vector_from_quaternion(sign * quaternions))
        torch.testing.assert_close(back, rotations, rtol=0, atol=1e-13)


def test_the_pose_at_a_knot_is_the_knot(random_poses: torch.Tensor) -> None:
    times = EPOCH + np.array([0, 3, 1_000_000, 5_000_001, 5_000_002, 10**9, 2 * 10**9, 10**10])
    trajectory = Trajectory(times, random_poses)
    torch.testing.assert_close(trajectory.interpolate(times), random_poses, rtol=0, atol=1e-13)


def test_between_knots_is_lerp_and_slerp(random_poses: torch.Tensor) -> None:
    first, second = random_poses[:2]
    trajectory = Trajectory([EPOCH, EPOCH + 1000], random_poses[:2])
    for weight in (0.001, 0.25, 0.5, 0.999):
        pose = trajectory.interpolate(EPOCH + round(1000 * weight))
        torch.testing.assert_close(pose[:, 3], torch.lerp(first[:, 3], second[:, 3], weight), rtol=0, atol=1e-12)
        # Slerp turns by a share of the angle about the one axis.
        whole = vector_from_quaternion(quaternion_from_rotation(first[:, :3].T @ second[:, :3]))
        part = vector_from_quaternion(quaternion_from_rotation(first[:, :3].T @ pose[:, :3]))
        torch.testing.assert_close(part, weight * whole, rtol=0, atol=1e-12)


def test_the_pose_resolves_nanoseconds_of_the_unix_time(random_poses: torch.Tensor) -> None:
    trajectory = Trajectory(EPOCH + 10**9 * np.arange(8), random_poses)
    here, there = trajectory.interpolate([EPOCH + 10**9 + 5, EPOCH + 10**9 + 6])
    speed = (random_poses[2, :, 3] - random_poses[1, :, 3]) * 1e-9
    torch.testing.assert_close(there[:, 3] - here[:, 3], speed, rtol=1e-5, atol=0)


def test_the_pose_is_differentiable_in_time(random_poses: torch.Tensor) -> None:
    trajectory = Trajectory(10**9 * np.arange(8), random_poses)
    seconds = torch.tensor([0.3, 4.7], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(trajectory.pose, seconds)


def test_the_rate_is_the_derivative_of_the_pose(random_poses: torch.Tensor) -> None:
    trajectory = Trajectory(10**9 * np.arange(8), random_poses)
    seconds = torch.tensor([0.0, 0.3, 2.0, 4.7], dtype=torch.float64)
    pose, rate = trajectory.pose_and_rate(seconds)
    assert torch.equal(pose, trajectory.pose(seconds))
    _, expected = torch.func.jvp(trajectory.pose, (seconds,), (torch.ones_like(seconds),))
    torch.testing.assert_close(rate, expected, rtol=0, atol=1e-13)


def test_outside_the_span_is_an_error(random_poses: torch.Tensor) -> None:
    trajectory = Trajectory(100 + 10 * np.arange(8), random_poses, "poses.txt")
    for time in (99, 171):
        with pytest.raises(DataError, match=f"poses.txt: no pose at {time} ns, outside the trajectory's 100 to 170"):
            trajectory.interpolate([120, time])


def test_a_part_of_a_trajectory_covers_what_was_asked_for(random_poses: torch.Tensor) -> None:
    trajectory = Trajectory(100 + 10 * np.arange(8), random_poses, "poses.txt")
    assert trajectory.between(115, 131).times.tolist() == [110, 120, 130, 140]
    assert trajectory.between(110, 130).times.tolist() == [110, 120, 130]
    assert trajectory.between(0, 105).times.tolist() == [100, 110]
    assert len(trajectory.between(0, 10**9)) == 8
    for start, end in ((0, 99), (171, 200)):
        with pytest.raises(DataError, match=f"poses.txt: .*do not overlap the events from {start} to {end} ns"):
            trajectory.between(start, end)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda times, poses: (times[[0, 2, 1]], poses), "pose 2 is at 10 ns, not after .* at 20 ns"),
        (lambda times, poses: (times[[0, 1, 1]], poses), "pose 2 is at 10 ns, not after .* at 10 ns"),
        (lambda times, poses: (times[:1], poses[:1]), "at least two timed poses"),
        (lambda times, poses: (times, poses[:2]), "3 times and 2 poses"),
        (lambda times, poses: (times, poses * torch.tensor([1.0, 1.0, 1.0, math.nan])), "pose 0 is not finite"),
        (lambda times, poses: (times, poses * 1.01), "is not a rigid motion"),
        (lambda times, poses: (times, poses * torch.tensor([1.0, 1.0, -1.0, 1.0])), "is not a rigid motion"),
    ],
)
def test_malformed_trajectories_are_refused(change, message: str, random_poses: torch.Tensor) -> None:
    times, poses = change(np.array([0, 10, 20]), random_poses[:3])
    with pytest.raises(DataError, match=f"^poses.txt: .*{message}"):
        Trajectory(times, poses, "poses.txt")


def test_a_trajectory_adds_nothing_to_checkpoints(random_poses: torch.Tensor) -> None:
    assert not Trajectory(np.arange(8), random_poses).state_dict()


def test_pose_noise_has_the_stated_size_is_smooth_and_seeded(random_poses: torch.Tensor) -> None:
    times = np.arange(0, 4 * 10**9, 4 * 10**6)
    truth = Trajectory(10**9 * np.arange(8), random_poses).interpolate(times)
    truth = Trajectory(times, truth)
    noisy = perturb(truth, rotation_degrees=2.0, translation=0.05, correlation_time=0.25, seed=3)
    error = homogeneous(truth.camera_to_worlds).inverse() @ homogeneous(noisy.camera_to_worlds)
    vectors = vector_from_quaternion(quaternion_from_rotation(error[:, :3, :3]))
    assert math.degrees(vectors.norm(dim=-1).square().mean().sqrt()) == pytest.approx(2.0, rel=1e-9)
    assert error[:, :3, 3].norm(dim=-1).square().mean().sqrt().item() == pytest.approx(0.05, rel=1e-9)
    # From one pose to the next, 4 ms on, it changes by about 4 / 250 of its size; white noise by 1.4 times its size.
    step = (error[1:, :3, 3] - error[:-1, :3, 3]).norm(dim=-1).square().mean().sqrt().item()
    assert 0.3 < step / (0.05 * 4 / 250) < 3
    again = perturb(truth, rotation_degrees=2.0, translation=0.05, correlation_time=0.25, seed=3)
    other = perturb(truth, rotation_degrees=2.0, translation=0.05, correlation_time=0.25, seed=4)
    assert torch.equal(noisy.camera_to_worlds, again.camera_to_worlds)
    assert not torch.equal(noisy.camera_to_worlds, other.camera_to_worlds)


def test_no_pose_noise_changes_nothing(random_poses: torch.Tensor) -> None:
    truth = Trajectory(10**9 * np.arange(8), random_poses)
    assert torch.equal(perturb(truth, 0, 0, 0.25, 0).camera_to_worlds, truth.camera_to_worlds)
    with pytest.raises(ValueError, match="must not be negative"):
        perturb(truth, -1, 0, 0.25, 0)


def test_opencv_axes_become_opengl_axes() -> None:
    opencv = torch.eye(4, dtype=torch.float64)
    opengl = opencv @ OPENCV_TO_OPENGL
    forward_opencv, forward_opengl = opencv[:3, 2], -opengl[:3, 2]
    down_opencv, up_opengl = opencv[:3, 1], opengl[:3, 1]
    assert torch.equal(forward_opencv, forward_opengl)
    assert torch.equal(down_opencv, -up_opengl)
