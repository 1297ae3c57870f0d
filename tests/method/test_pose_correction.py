"""The pose correction and its offsets, against exact derivatives and in a known scene."""

from typing import Any

import numpy as np
import pytest
import torch
from helpers.small_models import make_correction
from scipy.interpolate import BSpline
from torch import Tensor

from aenerf_ns.camera.rotation import motion_from_twist
from aenerf_ns.camera.trajectory import Trajectory, homogeneous
from aenerf_ns.errors import DataError
from aenerf_ns.method.pose_correction import PoseCorrection, TwistSpline, world_rays

_RIGID = torch.tensor([0.01, -0.02, 0.015, 0.02, 0.03, -0.01], dtype=torch.float64)


def _trajectory() -> Trajectory:
    """A camera above the plane z = 0 that swings back and forth for two seconds, and looks down."""
    seconds = torch.linspace(0, 2, 401, dtype=torch.float64)
    phase = torch.outer(seconds, torch.tensor([3.0, 4.1, 5.3, 2.9, 3.7, 4.7], dtype=torch.float64))
    twists = torch.tensor([0.5, 0.5, 0.2, 0.2, 0.2, 0.3], dtype=torch.float64) * torch.sin(phase)
    above = torch.eye(4, dtype=torch.float64)
    above[2, 3] = 2.0
    return Trajectory((seconds * 1e9).round().long(), above @ motion_from_twist(twists))


def _jittering(size: float = 0.003) -> Trajectory:
    """The same camera, but every pose is off by its own error, in radians and units."""
    smooth, generator = _trajectory(), torch.Generator().manual_seed(0)
    errors = motion_from_twist(size * torch.randn(len(smooth), 6, dtype=torch.float64, generator=generator))
    return Trajectory(smooth.times, homogeneous(smooth.camera_to_worlds) @ errors)


def _correction(jitter: bool = False, **options: Any) -> PoseCorrection:
    torch.manual_seed(0)
    return make_correction(_jittering() if jitter else _trajectory(), **options)


def _set(correction: PoseCorrection, size: float) -> None:
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in correction.parameters():
            parameter.copy_(size * torch.randn(parameter.shape, generator=generator))


def _penalty(correction: PoseCorrection) -> float:
    losses: dict[str, Tensor] = {}
    correction.get_loss_dict(losses)
    return float(losses["pose_correction_penalty"])


@pytest.mark.parametrize(("mode", "jitter"), [("off", False), ("network", False), ("spline", False), ("spline", True)])
@pytest.mark.parametrize("offsets", [{"rigid_offset": True}, {"clock_offset": 0.03}])
def test_poses_and_rates_are_exact(mode: str, jitter: bool, offsets: dict[str, Any]) -> None:
    correction = _correction(jitter, mode=mode, **offsets)
    _set(correction, 0.1)
    # At both ends there are times that the clock offset moves out of the trajectory.
    seconds = torch.linspace(0.0013, 1.9987, 999, dtype=torch.float64)
    pose, rate = correction.pose_and_rate(seconds)
    coarse = mode == "network"
    torch.testing.assert_close(pose, correction.pose(seconds), rtol=0, atol=1e-7 if coarse else 1e-14)
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
def test_a_correction_begins_as_the_identity_with_gradients(mode: str) -> None:
    correction = _correction(mode=mode, rigid_offset=True, clock_offset=0.0)
    seconds = torch.linspace(0, 2, 17, dtype=torch.float64)
    pose = correction.pose(seconds)
    assert torch.equal(pose, correction.trajectory.pose(seconds))
    torch.testing.assert_close(correction(torch.arange(3)), torch.eye(4)[:3].expand(3, 3, 4), rtol=0, atol=1e-7)
    assert mode == "off" or _penalty(correction) == 0
    pose[:, 0].sum().backward()
    gradients = {name: p.grad for name, p in correction.named_parameters() if p.grad is not None}
    assert all(gradient.isfinite().all() for gradient in gradients.values())
    for part in ("rigid_offset", "clock_change", *(["twists"] if mode != "off" else [])):
        assert max(gradient.abs().max() for name, gradient in gradients.items() if name.startswith(part)) > 1e-3


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


@pytest.mark.parametrize(
    "options", [{"mode": "network"}, {"mode": "spline"}, {"rigid_offset": True}, {"clock_offset": 0.0}]
)
def test_corrections_belong_to_the_times_of_their_poses(options: dict[str, Any]) -> None:
    trajectory = _trajectory()
    later = Trajectory(trajectory.times + 5, trajectory.camera_to_worlds)
    state, other = _correction(**options).state_dict(), make_correction(later, **options)
    line = "its poses are from 5 to 2000000005 ns, and the corrections of poses from 0 to 2000000000 ns; give"
    with pytest.raises(DataError, match=line):
        other.load_state_dict(state)
    # Checkpoints of earlier versions do not have it.
    del state["span"]
    other.load_state_dict(state)


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
    correction = make_correction(trajectory, rigid_offset=True, clock_offset=0.0)
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
    correction = make_correction(given, rigid_offset=True, clock_offset=0.0)
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


@pytest.mark.parametrize(("mode", "names"), [("off", []), ("spline", ["twists.control_twists"])])
def test_what_is_not_asked_for_is_not_there(mode: str, names: list[str]) -> None:
    correction, groups = _correction(mode=mode), dict[str, list]()
    assert [name for name, _ in correction.named_parameters()] == names
    assert correction.offsets() == {}
    correction.get_param_groups(groups)
    assert len(groups) == len(names)


def test_the_unit_of_length_does_not_matter() -> None:
    """Parameters that turn a trajectory into another one do the same to the same trajectory in millimeters."""
    correction = _correction(mode="spline")
    scaled = correction.trajectory.camera_to_worlds.clone()
    scaled[:, :, 3] *= 1000
    in_millimeters = make_correction(Trajectory(correction.trajectory.times, scaled), mode="spline")
    _set(correction, 0.1)
    in_millimeters.load_state_dict(correction.state_dict())
    seconds = torch.linspace(0, 2, 9, dtype=torch.float64)
    expected = correction.pose(seconds).detach()
    expected[:, :, 3] *= 1000
    torch.testing.assert_close(in_millimeters.pose(seconds).detach(), expected, rtol=1e-6, atol=1e-6)
    assert _penalty(correction) == pytest.approx(_penalty(in_millimeters))


def test_a_camera_that_only_turns_is_corrected_in_scene_units() -> None:
    turning = _trajectory()
    turning.camera_to_worlds[:, :, 3] = 0
    correction = make_correction(Trajectory(turning.times, turning.camera_to_worlds), mode="spline")
    with torch.no_grad():
        correction.twists.control_twists[:, 0] = 0.5
    distance = correction.pose(torch.linspace(0, 2, 9, dtype=torch.float64))[:, :, 3].norm(dim=-1)
    torch.testing.assert_close(distance, torch.full_like(distance, 0.5))


@pytest.mark.parametrize("finer", [False, True])
def test_the_spline_is_that_of_scipy(finer: bool) -> None:
    spline, nothing = TwistSpline(1.31, 0.1, finer), torch.empty(0)
    expected = []
    for control, segments in zip(spline.parameters(), (14, 53), strict=False):
        torch.nn.init.normal_(control, generator=torch.Generator().manual_seed(0))
        knots = 1.31 / segments * np.arange(-3, segments + 4)
        expected.append(BSpline(knots, control.detach().double().numpy(), 3))
    assert len(expected) == 1 + finer
    seconds = torch.linspace(0, 1.31, 99, dtype=torch.float64)
    twist, rate = spline.with_rate(seconds, nothing, nothing)
    for found, order in ((spline(seconds, nothing), 0), (twist, 0), (rate, 1)):
        total = sum(part.derivative(order)(seconds) for part in expected)
        np.testing.assert_allclose(found.detach(), total, rtol=0, atol=1e-11)
    np.testing.assert_allclose(spline.slow(seconds, nothing).detach(), expected[0](seconds), rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("trajectory", "counts"),
    [
        (_trajectory(), {"camera_opt": 23}),
        # Below the limit, as poses of a motion capture are.
        (_jittering(1e-4), {"camera_opt": 23}),
        (_jittering(), {"camera_opt": 23, "camera_opt_finer": 83}),
        (Trajectory([0, 2_000_000_000], _trajectory().camera_to_worlds[::400]), {"camera_opt": 23}),
    ],
)
def test_poses_that_jitter_get_a_finer_spline(trajectory: Trajectory, counts: dict[str, int]) -> None:
    groups: dict[str, list] = {}
    make_correction(trajectory, mode="spline").get_param_groups(groups)
    assert {name: sum(map(len, group)) for name, group in groups.items()} == counts


def test_the_field_moves_with_the_slow_part_alone() -> None:
    correction = _correction(jitter=True, mode="spline")
    seconds = torch.linspace(0, 2, 9, dtype=torch.float64)
    base = correction.trajectory.pose(seconds)
    with torch.no_grad():
        correction.twists.finer.control_twists.fill_(0.1)
    assert not correction.world_twists(seconds, base).any()
    assert (correction.pose(seconds) != base).flatten(1).any(1).all()


def test_checkpoints_without_a_finer_spline_load() -> None:
    correction, earlier = _correction(jitter=True, mode="spline"), _correction(mode="spline")
    _set(earlier, 0.1)
    seconds = torch.linspace(0, 2, 9, dtype=torch.float64)
    correction.load_state_dict(earlier.state_dict())
    expected = earlier.twists(seconds, torch.empty(0))
    torch.testing.assert_close(correction.twists(seconds, torch.empty(0)), expected, rtol=0, atol=0)
