"""Rotations, poses in continuous time, and pose noise."""

import math

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from aenerf_ns.camera.noise import perturb
from aenerf_ns.camera.rotation import quaternion_from_rotation, rotation_from_quaternion, rotation_from_vector
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, Trajectory, homogeneous
from aenerf_ns.errors import DataError

# Unix time in nanoseconds, which float64 seconds cannot hold.
EPOCH = 1_600_000_000_123_456_789


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 0.999, 1.001, 2.0, math.pi - 1e-6, math.pi])
def test_rotations_are_those_of_scipy(angle: float) -> None:
    vectors = angle * np.array([[0.48, -0.6, 0.64], [0, 0, 1], [0, -1, 0], [0.8, 0, -0.6]])
    expected = Rotation.from_rotvec(vectors)
    rotations = rotation_from_vector(torch.from_numpy(vectors))
    np.testing.assert_allclose(rotations, expected.as_matrix(), rtol=0, atol=1e-14)
    quaternions = quaternion_from_rotation(rotations)
    assert (Rotation.from_quat(quaternions.numpy()) * expected.inv()).magnitude().max() < 1e-14
    assert (quaternions[:, 3] >= 0).all()
    for sign in (1, -1):
        torch.testing.assert_close(rotation_from_quaternion(sign * quaternions), rotations, rtol=0, atol=1e-14)


def test_pose_at_a_knot_is_the_knot(random_poses: torch.Tensor) -> None:
    times = EPOCH + np.array([0, 3, 1_000_000, 5_000_001, 5_000_002, 10**9, 2 * 10**9, 10**10])
    trajectory = Trajectory(times, random_poses)
    torch.testing.assert_close(trajectory.interpolate(times), random_poses, rtol=0, atol=1e-13)


def smooth_poses(seconds: np.ndarray) -> torch.Tensor:
    """Poses on a smooth path that turns by up to 130 degrees a second, faster and slower."""
    t = torch.as_tensor(seconds, dtype=torch.float64)[:, None]
    waves = torch.cat([torch.sin(3 * t), torch.cos(2 * t + 0.4), torch.sin(2.3 * t + 1)], -1)
    positions = torch.cat([torch.cos(2 * t), torch.sin(2.4 * t), 0.3 * t], -1)
    return torch.cat([rotation_from_vector(waves), positions[..., None]], -1)


def degrees_between(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    relative = first[..., :3].mT @ second[..., :3]
    return torch.as_tensor(np.degrees(Rotation.from_matrix(relative.numpy()).magnitude()))


@pytest.mark.parametrize("uneven", [False, True])
def test_poses_between_knots_are_near_the_truth(uneven: bool) -> None:
    times = 40_000_000 * np.arange(76)
    if uneven:
        times[1:-1] += np.random.default_rng(1).integers(-12_000_000, 12_000_000, 74)
    fine = np.arange(0, times[-1], 3_000_000)
    knots, truth = smooth_poses(times * 1e-9), smooth_poses(fine * 1e-9)
    poses = Trajectory(times, knots).interpolate(fine)
    # Straight lines between the knots are off by 0.05 degrees and 6e-4.
    assert degrees_between(poses, truth).mean() < 0.001
    assert (poses - truth)[..., 3].norm(dim=-1).mean() < 1e-5
    # The ends are no worse.
    assert degrees_between(poses, truth).max() < 0.01


# Three are joined by a parabola.
@pytest.mark.parametrize("seconds", [[0, 0.8, 2, 3, 4.5, 5, 6, 7.3], [0, 2.9, 7.3]])
def test_spline_is_that_of_scipy(seconds: list[float]) -> None:
    seconds = np.array(seconds)
    knots = smooth_poses(seconds / 10)
    trajectory = Trajectory(np.rint(seconds * 1e9).astype(int), knots)
    fine = np.linspace(0, 7.3, 50)
    expected = CubicSpline(seconds, knots[:, :, 3].numpy())(fine)
    positions = trajectory.pose(torch.from_numpy(fine))[:, :, 3]
    np.testing.assert_allclose(positions, expected, rtol=0, atol=1e-12)


def test_velocity_and_acceleration_are_continuous() -> None:
    seconds = np.array([0, 0.1, 0.25, 0.3, 0.42, 0.5, 0.62])
    trajectory = Trajectory(np.rint(seconds * 1e9).astype(int), smooth_poses(seconds))
    step = 1e-6
    rates = [trajectory.pose_and_rate(torch.from_numpy(seconds[1:-1]) + k * step)[1] for k in (-1.5, -0.5, 0.5, 1.5)]
    torch.testing.assert_close(rates[1], rates[2], rtol=0, atol=1e-4)
    before, after = (rates[1] - rates[0]) / step, (rates[3] - rates[2]) / step
    torch.testing.assert_close(before, after, rtol=0, atol=2e-3)
    assert before.abs().max() > 1


def test_two_knots_are_joined_by_a_steady_motion(random_poses: torch.Tensor) -> None:
    # A quarter turn about one axis: the rate differs by less than a thousandth from slerp's.
    turn = rotation_from_vector(torch.tensor([[0.0, 0.0, math.pi / 2]], dtype=torch.float64))
    second = torch.cat([random_poses[:1, :, :3] @ turn, random_poses[1:2, :, 3:]], -1)
    poses = torch.cat([random_poses[:1], second])
    trajectory = Trajectory([EPOCH, EPOCH + 1000], poses)
    for weight in (0.001, 0.25, 0.5, 0.999):
        pose = trajectory.interpolate(EPOCH + round(1000 * weight))
        torch.testing.assert_close(pose[:, 3], torch.lerp(poses[0, :, 3], poses[1, :, 3], weight), rtol=0, atol=1e-12)
        part = Rotation.from_matrix((poses[0, :, :3].T @ pose[:, :3]).numpy()).as_rotvec()
        np.testing.assert_allclose(part, [0, 0, weight * math.pi / 2], rtol=0, atol=1e-3)


@pytest.mark.parametrize("lost", [4, 5, 60])
def test_no_spline_crosses_a_long_gap(lost: int) -> None:
    times = 10**7 * np.r_[np.arange(40), 39 + lost + 1 + np.arange(40)]
    seconds = times * 1e-9
    trajectory = Trajectory(times, smooth_poses(seconds))
    start, end = seconds[39:41]
    middle = trajectory.pose(torch.tensor([(start + end) / 2], dtype=torch.float64))
    truth = smooth_poses(np.array([(start + end) / 2]))
    ends = trajectory.camera_to_worlds[39:41]
    if lost == 4:
        # Four lost frames in a row are bridged.
        assert degrees_between(middle, truth) < 1e-3
        return
    torch.testing.assert_close(middle[0, :, 3], ends[:, :, 3].mean(0), rtol=0, atol=1e-12)
    halves = degrees_between(middle.expand(2, 3, 4), ends)
    assert halves[0].item() == pytest.approx(halves[1].item(), rel=1e-9)
    assert halves.sum().item() == pytest.approx(degrees_between(*ends).item(), rel=1e-9)
    # On both sides the spline is as good as without the gap, and it does not depend on the other side.
    for part in (slice(0, 40), slice(40, 80)):
        fine = torch.linspace(seconds[part][0], seconds[part][-1], 100, dtype=torch.float64)
        alone = Trajectory(times[part], smooth_poses(seconds[part]))
        expected = alone.pose((fine - seconds[part][0]).clamp_min(0))
        torch.testing.assert_close(trajectory.pose(fine)[:-1], expected[:-1], rtol=0, atol=1e-10)
        assert degrees_between(trajectory.pose(fine), smooth_poses(fine.numpy())).max() < 1e-3


def test_step_to_another_rate_is_no_gap() -> None:
    # Only the first of the longer segments is beside a short one.
    seconds = np.r_[np.arange(10) * 0.01, 0.09 + 0.08 * np.arange(1, 11)]
    trajectory = Trajectory(np.rint(seconds * 1e9).astype(int), smooth_poses(seconds))
    fine = np.linspace(0.18, seconds[-1], 99)
    assert degrees_between(trajectory.pose(torch.from_numpy(fine)), smooth_poses(fine)).max() < 0.1


@pytest.mark.parametrize("turn", [60.0, 149.0, 151.0, 179.0])
def test_large_turns_between_knots_do_not_flip(turn: float) -> None:
    # The camera turns about one axis. Whatever the knots' quaternions, it never goes the longer way round.
    angles = math.radians(turn) * torch.arange(12, dtype=torch.float64)
    axis = torch.tensor([0.48, -0.6, 0.64], dtype=torch.float64)
    poses = torch.cat([rotation_from_vector(angles[:, None] * axis), torch.zeros(12, 3, 1).double()], -1)
    fine = torch.linspace(0, 10.999, 400, dtype=torch.float64)
    expected = rotation_from_vector(math.radians(turn) * fine[:, None] * axis)
    pose, rate = Trajectory(10**9 * np.arange(12), poses).pose_and_rate(fine)
    assert degrees_between(pose, expected).max() < 8
    turning = (pose[..., :3].mT @ rate[..., :3])[:, 2, 1] / axis[0]
    assert (turning > 0).all()


def test_crop_keeps_the_poses(random_poses: torch.Tensor) -> None:
    trajectory = Trajectory(EPOCH + 10**9 * np.arange(8), random_poses)
    part = trajectory.crop(EPOCH + 3 * 10**9 + 5, EPOCH + 5 * 10**9)
    assert len(part) == 3
    times = EPOCH + np.linspace(3 * 10**9, 5 * 10**9 - 1, 31).astype(np.int64)
    torch.testing.assert_close(part.interpolate(times), trajectory.interpolate(times), rtol=0, atol=1e-12)
    again = part.crop(EPOCH + 4 * 10**9, EPOCH + 5 * 10**9).interpolate(times[16:])
    torch.testing.assert_close(again, trajectory.interpolate(times[16:]), rtol=0, atol=1e-12)


def test_transform_commutes_with_interpolation(random_poses: torch.Tensor) -> None:
    trajectory = Trajectory(10**9 * np.arange(8), random_poses)
    world, axes = homogeneous(random_poses[3]), OPENCV_TO_OPENGL
    times = np.linspace(0, 7 * 10**9, 50).astype(np.int64)
    transformed = trajectory.transform(lambda poses: world @ poses @ axes).interpolate(times)
    expected = (world @ homogeneous(trajectory.interpolate(times)) @ axes)[:, :3]
    torch.testing.assert_close(transformed, expected, rtol=0, atol=1e-12)


def test_poses_resolve_nanoseconds_of_unix_time(random_poses: torch.Tensor) -> None:
    trajectory = Trajectory(EPOCH + 10**9 * np.arange(8), random_poses)
    here, there = trajectory.interpolate([EPOCH + 10**9 + 5, EPOCH + 10**9 + 6])
    _, rate = trajectory.pose_and_rate(torch.tensor([1.0], dtype=torch.float64))
    torch.testing.assert_close(there[:, 3] - here[:, 3], rate[0, :, 3] * 1e-9, rtol=1e-5, atol=1e-15)


def test_times_outside_the_span_are_refused(random_poses: torch.Tensor) -> None:
    trajectory = Trajectory(100 + 10 * np.arange(8), random_poses, "poses.txt")
    for time in (99, 171):
        with pytest.raises(DataError, match=f"poses.txt: no pose at {time} ns, outside the trajectory's 100 to 170"):
            trajectory.interpolate([120, time])


@pytest.mark.parametrize(
    ("start", "end", "expected"),
    [
        (115, 131, [110, 120, 130, 140]),
        (110, 130, [110, 120, 130]),
        (0, 105, [100, 110]),
        (0, 10**9, range(100, 180, 10)),
        (0, 99, None),
        (171, 200, None),
    ],
)
def test_crop_covers_the_interval(start: int, end: int, expected, random_poses: torch.Tensor) -> None:
    trajectory = Trajectory(100 + 10 * np.arange(8), random_poses, "poses.txt")
    if expected is not None:
        assert trajectory.crop(start, end).times.tolist() == list(expected)
        return
    with pytest.raises(DataError, match=f"poses.txt: .*do not overlap the events from {start} to {end} ns"):
        trajectory.crop(start, end)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        # So far from the start, float64 seconds do not resolve nanoseconds.
        (lambda times, poses: (times + np.r_[0, 10**18, 10**18], poses), "pose 2 is at .*20 ns, not after .*10 ns"),
        (lambda times, poses: (times, poses[:2]), "3 times and 2 poses"),
        (lambda times, poses: (times, poses * torch.tensor([1.0, 1.0, 1.0, math.nan])), "pose 0 is not finite"),
        (lambda times, poses: (times, poses * 1.01), "is not a rigid motion"),
    ],
)
def test_malformed_trajectories_are_refused(change, message: str, random_poses: torch.Tensor) -> None:
    times, poses = change(np.array([0, 10, 20]), random_poses[:3])
    with pytest.raises(DataError, match=f"^poses.txt: .*{message}"):
        Trajectory(times, poses, "poses.txt")


def test_trajectory_adds_nothing_to_checkpoints(random_poses: torch.Tensor) -> None:
    assert not Trajectory(np.arange(8), random_poses).state_dict()


def test_pose_noise_is_sized_smooth_and_seeded(random_poses: torch.Tensor) -> None:
    times = np.arange(0, 4 * 10**9, 4 * 10**6)
    truth = Trajectory(times, Trajectory(10**9 * np.arange(8), random_poses).interpolate(times))
    noisy = perturb(truth, rotation_degrees=2.0, translation=0.05, correlation_time=0.25, seed=3)
    error = homogeneous(truth.camera_to_worlds).inverse() @ homogeneous(noisy.camera_to_worlds)
    angles = Rotation.from_matrix(error[:, :3, :3].numpy()).magnitude()
    assert math.degrees(np.sqrt(np.mean(angles**2))) == pytest.approx(2.0, rel=1e-9)
    assert error[:, :3, 3].norm(dim=-1).square().mean().sqrt().item() == pytest.approx(0.05, rel=1e-9)
    # From one pose to the next, 4 ms on, it changes by about 4 / 250 of its size; white noise by 1.4 times its size.
    step = (error[1:, :3, 3] - error[:-1, :3, 3]).norm(dim=-1).square().mean().sqrt().item()
    assert 0.3 < step / (0.05 * 4 / 250) < 3
    again = perturb(truth, rotation_degrees=2.0, translation=0.05, correlation_time=0.25, seed=3)
    other = perturb(truth, rotation_degrees=2.0, translation=0.05, correlation_time=0.25, seed=4)
    assert torch.equal(noisy.camera_to_worlds, again.camera_to_worlds)
    assert not torch.equal(noisy.camera_to_worlds, other.camera_to_worlds)


def test_gauss_markov_noise_keeps_the_same_share_from_pose_to_pose(random_poses: torch.Tensor) -> None:
    times = np.arange(0, 7 * 10**9, 4 * 10**6)
    truth = Trajectory(times, Trajectory(10**9 * np.arange(8), random_poses).interpolate(times))
    # E-3DGS: 0.95 of the error is kept from one pose to the next.
    noisy = perturb(truth, 2.0, 0.05, -0.004 / math.log(0.95), seed=3, kind="gauss-markov")
    error = (homogeneous(truth.camera_to_worlds).inverse() @ homogeneous(noisy.camera_to_worlds))[:, :3, 3]
    assert error.norm(dim=-1).square().mean().sqrt().item() == pytest.approx(0.05, rel=1e-9)
    kept = (error[1:] * error[:-1]).sum() / error.square().sum()
    assert kept.item() == pytest.approx(0.95, abs=0.02)
    new = error[1:] - kept * error[:-1]
    assert ((new[1:] * new[:-1]).sum() / new.square().sum()).abs() < 0.05


def test_no_pose_noise_changes_nothing(random_poses: torch.Tensor) -> None:
    truth = Trajectory(10**9 * np.arange(8), random_poses)
    assert torch.equal(perturb(truth, 0, 0, 0.25, 0).camera_to_worlds, truth.camera_to_worlds)
