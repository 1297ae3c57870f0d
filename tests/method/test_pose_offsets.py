"""One clock offset and one rigid offset of all poses, against finite differences and in a known scene."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers.small_models import ALL_LOSSES, make_batch, make_model, make_rays
from torch import Tensor

from aenerf_ns.camera.rotation import motion_from_twist
from aenerf_ns.camera.trajectory import Trajectory, homogeneous
from aenerf_ns.method.pose_correction import PoseCorrection, PoseCorrectionConfig, world_rays

_RIGID = torch.tensor([0.01, -0.02, 0.015, 0.02, 0.03, -0.01], dtype=torch.float64)


def _trajectory() -> Trajectory:
    """A camera above the plane z = 0 that swings back and forth for two seconds, and looks down."""
    seconds = torch.linspace(0, 2, 401, dtype=torch.float64)
    phase = torch.outer(seconds, torch.tensor([3.0, 4.1, 5.3, 2.9, 3.7, 4.7], dtype=torch.float64))
    twists = torch.tensor([0.5, 0.5, 0.2, 0.2, 0.2, 0.3], dtype=torch.float64) * torch.sin(phase)
    above = torch.eye(4, dtype=torch.float64)
    above[2, 3] = 2.0
    return Trajectory((seconds * 1e9).round().long(), above @ motion_from_twist(twists))


def _correction(trajectory: Trajectory | None = None, **options: Any) -> PoseCorrection:
    trajectory = trajectory or _trajectory()
    return PoseCorrectionConfig(**options).setup(
        num_cameras=1, device="cpu", trajectory=trajectory, camera_times=trajectory.times[:1]
    )


def _set(correction: PoseCorrection, size: float) -> None:
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in correction.parameters():
            parameter.copy_(size * torch.randn(parameter.shape, generator=generator))


@pytest.mark.parametrize("mode", ["off", "network", "spline"])
@pytest.mark.parametrize("offsets", [{"rigid_offset": True}, {"clock_offset": 0.03}])
def test_poses_and_rates_are_exact(mode: str, offsets: dict[str, Any]) -> None:
    correction = _correction(mode=mode, **offsets)
    _set(correction, 0.1)
    # At both ends there are times that the clock offset moves out of the trajectory.
    seconds = torch.linspace(0.0013, 1.9987, 999, dtype=torch.float64)
    pose, rate = correction.pose_and_rate(seconds)
    step = 1e-6
    numerical = (correction.pose(seconds + step) - correction.pose(seconds - step)) / (2 * step)
    coarse = mode == "network"
    torch.testing.assert_close(pose, correction.pose(seconds), rtol=0, atol=1e-7 if coarse else 1e-14)
    if not coarse:
        torch.testing.assert_close(rate, numerical, rtol=1e-5, atol=1e-7)
    _, expected = torch.func.jvp(correction.pose, (seconds,), (torch.ones_like(seconds),))
    torch.testing.assert_close(rate, expected, rtol=0, atol=1e-4 if coarse else 1e-12)


def test_offsets_mean_what_they_say() -> None:
    correction = _correction(rigid_offset=True, clock_offset=0.03)
    with torch.no_grad():
        correction.rigid_offset.copy_(_RIGID / correction._twist_units)
    seconds = torch.linspace(0, 1.9, 50, dtype=torch.float64)
    expected = homogeneous(correction.trajectory.pose(seconds + 0.03)) @ motion_from_twist(_RIGID)
    torch.testing.assert_close(correction.pose(seconds), expected[:, :3], rtol=0, atol=1e-8)
    end = correction.trajectory.pose(torch.tensor([2.0, 2.0], dtype=torch.float64)) @ motion_from_twist(_RIGID)
    beyond, rate = correction.pose_and_rate(torch.tensor([1.98, 2.0], dtype=torch.float64))
    torch.testing.assert_close(beyond, end, rtol=0, atol=1e-8)
    assert not rate.any()


@pytest.mark.parametrize("mode", ["off", "network", "spline"])
def test_offsets_begin_as_the_identity_with_gradients(mode: str) -> None:
    correction = _correction(mode=mode, rigid_offset=True, clock_offset=0.0)
    seconds = torch.linspace(0, 2, 17, dtype=torch.float64)
    pose = correction.pose(seconds)
    assert torch.equal(pose, correction.trajectory.pose(seconds))
    pose[:, 0].sum().backward()
    for parameter in (correction.rigid_offset, correction.clock_change):
        assert parameter.grad.isfinite().all()
        assert parameter.grad.abs().max() > 1e-3


def test_a_clock_offset_moves_no_reference_view() -> None:
    correction = _correction(clock_offset=0.02)
    alignment = correction.alignment()
    torch.testing.assert_close(alignment.rotation, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-9)
    assert alignment.scale == pytest.approx(1, abs=1e-9)
    assert alignment.translation.abs().max() < 1e-9


def test_a_learned_clock_offset_belongs_to_its_start() -> None:
    first = _correction(clock_offset=0.02)
    _set(first, 0.1)
    again, other = _correction(clock_offset=0.02), _correction(clock_offset=0.03)
    state = first.state_dict()
    with pytest.raises(RuntimeError, match=r"it began with clock-offset 0.02, not 0.03"):
        other.load_state_dict(state)
    # Checkpoints of earlier versions do not have it.
    for loaded in (state, {"clock_change": state["clock_change"]}):
        again.load_state_dict(loaded)
        assert again.offsets() == first.offsets()


@torch.no_grad()
def test_many_poses_are_those_of_few() -> None:
    correction = _correction(mode="network")
    _set(correction, 0.1)
    seconds = torch.linspace(0, 2, 4500, dtype=torch.float64)
    for many, few in zip(correction.pose_and_rate(seconds), correction.pose_and_rate(seconds[3000:3100]), strict=True):
        torch.testing.assert_close(many[3000:3100], few, rtol=0, atol=1e-4)
    torch.testing.assert_close(correction.pose(seconds)[3000:3100], correction.pose(seconds[3000:3100]))


def test_the_field_stands_where_the_camera_stands_still() -> None:
    correction = _correction(mode="off", clock_offset=0.1)
    correction.clock_change.data.fill_(0.01)
    seconds = torch.tensor([1.0, 1.95, 2.0], dtype=torch.float64)
    twists = correction.world_twists(seconds, correction.trajectory.pose(seconds + 0.1 * (seconds < 1.5)))
    assert twists[0].abs().max() > 1e-4
    assert not twists[1:].any()


def test_the_clock_offset_is_bounded() -> None:
    correction = _correction(clock_offset=0.01)
    for raw, expected in ((1e6, 0.06), (-1e6, -0.04)):
        correction.clock_change.data.fill_(raw)
        assert correction.offsets()["clock_offset_seconds"] == pytest.approx(expected)
        assert float(correction.clock_change_share()) == pytest.approx((expected - 0.01) / 0.05)


def test_a_camera_that_stands_still_has_finite_offsets() -> None:
    trajectory = Trajectory([0, 10**9], torch.eye(4, dtype=torch.float64).repeat(2, 1, 1))
    correction = _correction(trajectory, rigid_offset=True, clock_offset=0.0)
    _set(correction, 1.0)
    assert correction.pose(torch.tensor([0.0, 0.5], dtype=torch.float64)).isfinite().all()


@pytest.mark.parametrize("offsets", [{"rigid_offset": True}, {"clock_offset": 0.0}, {"clock_offset": 0.05}])
def test_world_twists_are_the_corrections_to_first_order(offsets: dict[str, Any]) -> None:
    seconds = torch.linspace(0.1, 1.9, 20, dtype=torch.float64)
    errors = []
    for size in (1e-2, 1e-3):
        correction = _correction(mode="spline", **offsets)
        _set(correction, size)
        base = correction.trajectory.pose(correction.on_clock_of_poses(seconds, at_first=True))
        twists = correction.world_twists(seconds, base)
        moved = homogeneous(correction.pose(seconds))
        expected = motion_from_twist(twists) @ homogeneous(base)
        assert (moved - homogeneous(base)).abs().max() > 0.1 * size
        errors.append((moved - expected).abs().max())
    # What is left is of second order.
    assert errors[1] < 2e-2 * errors[0]


def _log_radiance(correction: PoseCorrection, seconds: Tensor, directions: Tensor) -> Tensor:
    """Of a plane z = 0 with a smooth texture."""
    origins, directions = world_rays(correction.pose(seconds), directions)
    x, y, _ = (origins - directions * (origins[:, 2:] / directions[:, 2:])).unbind(-1)
    return torch.sin(2 * x + 0.3) + torch.cos(1.7 * y + 0.2) + 0.5 * torch.sin(x - 1.3 * y)


def test_both_offsets_are_found_in_a_known_scene() -> None:
    truth = _correction()
    # The given trajectory is 20 ms ahead, and of a body that the camera is fastened to at an angle.
    given = truth.trajectory.transform(lambda poses: poses @ torch.linalg.inv(motion_from_twist(_RIGID)))
    given = Trajectory(given.times + 20_000_000, given.camera_to_worlds)
    correction = _correction(given, rigid_offset=True, clock_offset=0.0)
    groups: dict[str, list[torch.nn.Parameter]] = {}
    correction.get_param_groups(groups)
    optimizer = torch.optim.LBFGS(groups["camera_opt"], max_iter=100, line_search_fn="strong_wolfe")
    generator = torch.Generator().manual_seed(0)
    # On the clock of the events, which the true poses have.
    seconds = 0.1 + 1.8 * torch.rand(1000, generator=generator, dtype=torch.float64)
    directions = torch.randn(1000, 3, generator=generator, dtype=torch.float64) * 0.2
    directions[:, 2] = -1
    directions /= directions.norm(dim=-1, keepdim=True)
    seen = _log_radiance(truth, seconds, directions)

    def loss() -> Tensor:
        optimizer.zero_grad()
        # The given trajectory begins 20 ms after the true one.
        error = (_log_radiance(correction, seconds - 0.02, directions) - seen).square().mean()
        error.backward()
        return error

    optimizer.step(loss)
    found = correction.offsets()
    assert found["clock_offset_seconds"] == pytest.approx(0.02, abs=1e-4)
    rigid = (correction._twist_units * correction.rigid_offset).detach()
    torch.testing.assert_close(rigid, _RIGID, rtol=0, atol=1e-3)
    assert found["rigid_offset_degrees"] == pytest.approx(float(torch.rad2deg(_RIGID[3:].norm())), abs=0.05)
    assert found["rigid_offset_translation"] == pytest.approx(float(_RIGID[:3].norm()), abs=1e-3)


def test_without_offsets_nothing_is_added() -> None:
    correction = _correction(mode="spline")
    assert [name for name, _ in correction.named_parameters()] == ["twists.control_twists"]
    assert correction.offsets() == {}


@pytest.mark.parametrize("mode", ["off", "spline"])
def test_a_model_teaches_the_offsets(mode: str) -> None:
    model = make_model(
        camera_optimizer=PoseCorrectionConfig(mode=mode, rigid_offset=True, clock_offset=0.0),
        loss_coefficients=ALL_LOSSES,
    )
    torch.nn.init.uniform_(model.field.encoding.hash_table, -1, 1)
    correction = model.camera_optimizer
    assert set(model.get_param_groups()["camera_opt"]) == set(correction.parameters())
    outputs, batch = model(make_rays(15, with_times=True)), make_batch(5)
    sum(model.get_loss_dict(outputs, batch).values()).backward()
    for parameter in (correction.rigid_offset, correction.clock_change):
        assert parameter.grad.isfinite().all()
        assert parameter.grad.abs().max() > 0
    assert model.get_metrics_dict(outputs, batch)["clock_offset_seconds"] == 0
