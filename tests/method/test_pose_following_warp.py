"""The field moves along with corrections of the poses."""

import math

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from aenerf_ns.camera.rotation import motion_from_twist
from aenerf_ns.camera.trajectory import Trajectory, homogeneous
from aenerf_ns.method.pose_correction import PoseCorrection, PoseCorrectionConfig
from aenerf_ns.method.pose_following_warp import PoseFollowingWarp

_DURATION = 2.0
BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])


@pytest.fixture
def correction() -> PoseCorrection:
    times = torch.linspace(0, _DURATION * 1e9, 21, dtype=torch.float64).long()
    turn = torch.linspace(0, 1, 21, dtype=torch.float64)[:, None]
    motions = motion_from_twist(turn * torch.tensor([0.4, 0.2, -0.3, 0.1, 0.8, 0.2], dtype=torch.float64))
    return PoseCorrection(PoseCorrectionConfig(mode="spline"), 1, "cpu", Trajectory(times, motions), times[:1])


def _set(correction: PoseCorrection, twist: Tensor) -> None:
    """Let the camera move by a twist in the world at all times."""
    twists = correction.twists
    seconds = torch.linspace(0, _DURATION, 200, dtype=torch.float64)
    wanted = torch.linalg.inv(homogeneous(correction.trajectory.pose(seconds)))
    # The twist as each camera sees it.
    rotation, position = wanted[:, :3, :3], wanted[:, :3, 3]
    omega = (rotation @ twist[3:, None])[..., 0]
    velocity = (rotation @ twist[:3, None])[..., 0] + torch.linalg.cross(position, omega)
    target = torch.cat([velocity, omega], -1) / correction._twist_units
    optimizer = torch.optim.LBFGS(twists.parameters(), max_iter=200, tolerance_grad=1e-12, tolerance_change=1e-14)

    def loss() -> Tensor:
        optimizer.zero_grad()
        error = (twists(seconds, None) - target).square().sum()
        error.backward()
        return error

    optimizer.step(loss)


def test_a_motion_that_all_times_share_moves_the_field_with_the_cameras(correction: PoseCorrection) -> None:
    warp = PoseFollowingWarp(correction, None, BOX)
    twist = 1e-2 * torch.tensor([0.3, -0.2, 0.5, 0.4, 0.1, -0.6], dtype=torch.float64)
    _set(correction, twist)
    base = correction.trajectory.pose(torch.tensor([0.7], dtype=torch.float64))
    corrected = correction.pose(torch.tensor([0.7], dtype=torch.float64))
    seen = torch.tensor([0.1, -0.2, 0.4, 1.0], dtype=torch.float64)
    warp.update(correction)
    found = warp((corrected @ seen).float())
    # To first order: the square of the twist is left.
    assert (found - (base @ seen).float()).abs().max() < 3e-4
    assert (corrected @ seen - base @ seen).norm() > 3e-3


def test_a_place_moves_with_the_times_that_see_it(correction: PoseCorrection) -> None:
    warp = PoseFollowingWarp(correction, None, BOX)
    left, right = torch.tensor([-0.8, 0.0, 0.0]), torch.tensor([0.8, 0.0, 0.0])
    early, late = torch.tensor([0.2], dtype=torch.float64), torch.tensor([1.8], dtype=torch.float64)
    warp.accumulate(left.expand(1, 4, 3), torch.full((1, 4), 0.25), early)
    warp.accumulate(right.expand(1, 4, 3), torch.full((1, 4), 0.25), late)
    warp.update_weights()
    with torch.no_grad():
        # Only the late half of the recording is corrected.
        correction.twists.control_twists[14:, 0] = 0.02
        warp.update(correction)
        moved = torch.stack([left, right]) - warp(torch.stack([left, right]))
    expected = correction.world_twists(late, correction.trajectory.pose(late))[0]
    shift = expected[:3] + torch.linalg.cross(expected[3:], right.double())
    assert moved[0].norm() < 1e-3 * shift.norm()
    torch.testing.assert_close(moved[1].double(), shift, rtol=2e-2, atol=1e-5)


def test_without_corrections_nothing_moves(correction: PoseCorrection) -> None:
    warp = PoseFollowingWarp(correction, None, BOX)
    warp.update(correction)
    positions = torch.randn(50, 3)
    assert torch.equal(warp(positions), positions)


def test_a_position_that_is_not_a_number_stays_one(correction: PoseCorrection) -> None:
    warp = PoseFollowingWarp(correction, None, BOX)
    warp.update(correction)
    found = warp(torch.tensor([[math.nan, math.inf, -math.inf], [0.0, 0.0, 0.0]]))
    assert found[0, 0].isnan()
    assert found[1].isfinite().all()


def test_positions_that_move_have_rates(correction: PoseCorrection) -> None:
    warp = PoseFollowingWarp(correction, None, BOX)
    correction.twists.control_twists.data.fill_(0.01)
    warp.update(correction)
    positions, rates = torch.zeros(3, 3), torch.eye(3)
    with forward_ad.dual_level():
        moved = forward_ad.unpack_dual(warp(forward_ad.make_dual(positions, rates)))
        tangent = moved.tangent
    step = 1e-3
    difference = (warp(positions + step * rates) - warp(positions - step * rates)) / (2 * step)
    torch.testing.assert_close(tangent, difference, rtol=1e-2, atol=1e-2)


def test_gradients_of_the_proposals_do_not_reach_the_motion(correction: PoseCorrection) -> None:
    warp = PoseFollowingWarp(correction, None, BOX)
    warp.update(correction)
    assert warp(torch.rand(4, 3)).requires_grad
    assert not warp(torch.rand(4, 3), detached=True).requires_grad


def test_the_times_of_a_long_recording_are_bounded() -> None:
    times = torch.tensor([0, 3600 * 10**9])
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, 0, 3] = 1
    correction = PoseCorrection(PoseCorrectionConfig(mode="spline"), 1, "cpu", Trajectory(times, poses), times)
    warp = PoseFollowingWarp(correction, None, BOX)
    assert len(warp._seconds) == 256
    assert math.isclose(float(warp._seconds[-1]), 3600)
