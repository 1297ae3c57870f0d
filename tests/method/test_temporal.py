"""The temporal derivative and the pose correction, in float64 against finite differences and double backward."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from helpers.small_models import ALL_LOSSES, make_batch, make_model, make_rays
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.model_components.losses import distortion_loss, interlevel_loss

from aenerf_ns.camera.rotation import TwistExponential, cross_matrix, motion_from_twist, rotation_from_vector
from aenerf_ns.camera.trajectory import Trajectory, homogeneous
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.method.model import AENeRFModel
from aenerf_ns.method.pose_correction import PoseCorrection, PoseCorrectionConfig, world_rays
from aenerf_ns.supervision.losses import temporal_loss


def exact_model(mode: str, **options: Any) -> AENeRFModel:
    """A float64 model whose field and pose correction are far from trivial."""
    sensor = SensorModel(0.2, 0.3, bayer_pattern="RGGB")
    model = make_model(
        sensor, camera_optimizer=PoseCorrectionConfig(mode=mode), loss_coefficients=ALL_LOSSES, **options
    )
    if model.config.backbone == "hash":
        torch.nn.init.uniform_(model.field.encoding.hash_table, -1, 1)
    else:
        for layer in model.field.density_network.layers:
            torch.nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
    model.field.average_init_density = 2.0
    for name, parameter in model.camera_optimizer.named_parameters():
        if name.endswith("control_twists"):
            torch.nn.init.normal_(parameter, std=0.03)
        elif name.endswith("output.weight"):
            torch.nn.init.normal_(parameter, std=0.5)
    return model.double()


def rendered_at(model: AENeRFModel, rays: RayBundle, seconds: torch.Tensor, samples: Any) -> torch.Tensor:
    """Log-radiance (N, channels) from the corrected poses at the given times, the samples' distances unchanged."""
    origins, directions = world_rays(model.camera_optimizer.pose(seconds), rays.metadata["camera_directions"])
    frustums = samples.frustums
    moved = replace(
        frustums,
        origins=origins[:, None].expand_as(frustums.origins),
        directions=directions[:, None].expand_as(frustums.directions),
    )
    return model._composite(replace(samples, frustums=moved))[0]


@pytest.mark.parametrize("mode", ["off", "network", "spline"])
@pytest.mark.parametrize("contraction", ["l2", "none"])
@pytest.mark.parametrize("backbone", ["hash", "mlp"])
def test_the_rate_is_exact_along_the_whole_chain(mode: str, contraction: str, backbone: str) -> None:
    model = exact_model(
        mode,
        scene_contraction=contraction,
        bounded=contraction == "none",
        backbone=backbone,
        field={"num_hidden_layers": 1 if backbone == "hash" else 6, "num_frequencies": 4},
        # Where light hardly passes, differences are coarse.
        average_init_density=0.01,
    )
    captured: list[tuple] = []
    composite = model._composite
    model._composite = lambda samples: captured.append(samples) or composite(samples)  # type: ignore[method-assign,func-returns-value]
    rays = make_rays(60, with_times=True)
    assert rays.times is not None
    origins, directions = world_rays(model.camera_optimizer.pose(rays.times[:, 0]), rays.metadata["camera_directions"])
    rays = replace(rays, origins=origins.detach(), directions=directions.detach())
    outputs = model(rays)
    model._composite = composite  # type: ignore[method-assign]
    moving, samples = rays[40:], captured[1]
    assert moving.times is not None
    # The samples hold the dual rays; what is used of them here are the distances.
    seconds = moving.times[:, 0].detach()
    step = 3e-7
    with torch.no_grad():
        ahead, behind = (rendered_at(model, moving, seconds + s, samples) for s in (step, -step))
    numerical = (ahead - behind) / (2 * step)
    rate = outputs["log_radiance_rate"]
    error = ((numerical - rate).abs() / rate.abs().clamp_min(1e-2)).flatten()
    # The hash grid is piecewise linear: a difference that straddles a cell's face is no derivative.
    assert error.quantile(0.9 if backbone == "hash" else 1.0) < 1e-6
    assert rate.abs().median() > 1e-3

    target, interval = torch.full((20,), 0.2, dtype=torch.float64), torch.full((20,), 0.3, dtype=torch.float64)
    parameters = [p for part in (model.field, model.camera_optimizer) for p in part.parameters()]
    loss = temporal_loss(rate[:, 1], target, interval)
    forward = torch.autograd.grad(loss, parameters, allow_unused=True, retain_graph=True)
    seconds = seconds.clone().requires_grad_()
    log_radiance = rendered_at(model, moving, seconds, samples)
    (double_backward_rate,) = torch.autograd.grad(log_radiance[:, 1].sum(), seconds, create_graph=True)
    loss = temporal_loss(double_backward_rate, target, interval)
    double_backward = torch.autograd.grad(loss, parameters, allow_unused=True)
    torch.testing.assert_close(rate[:, 1], double_backward_rate, rtol=1e-9, atol=1e-11)
    for a, b in zip(forward, double_backward, strict=True):
        if a is None or b is None:
            assert a is None or a.abs().max() == 0
            assert b is None or b.abs().max() == 0
            continue
        torch.testing.assert_close(a, b, rtol=1e-7, atol=1e-9 * float(b.abs().max() + 1e-30))


def test_the_third_ray_takes_part_in_the_framework_s_losses() -> None:
    model = make_model(loss_coefficients=ALL_LOSSES)
    outputs = model(make_rays(15, with_times=True))
    assert [len(weights) for weights in outputs["weights_list"]] == [15, 15]
    assert outputs["log_radiance"].shape == (15, 1)
    assert outputs["log_radiance_rate"].shape == (5, 1)
    for loss in (interlevel_loss, distortion_loss):
        assert torch.isfinite(loss(outputs["weights_list"], outputs["ray_samples_list"]))


def test_without_the_temporal_loss_there_is_no_third_ray() -> None:
    model = make_model()
    assert model.supervision.num_rate_rays(15) == 0
    outputs = model(make_rays(10, with_times=True))
    assert "temporal_loss" not in model.get_loss_dict(outputs, make_batch(5))


def make_correction(mode: str, duration: float = 2.0) -> PoseCorrection:
    poses = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    poses[:, 0, 3] = torch.arange(5)
    poses[:, :3, :3] = rotation_from_vector(torch.arange(5, dtype=torch.float64)[:, None] * torch.tensor([0.1, 0.2, 0]))
    trajectory = Trajectory([round(i * duration / 4 * 1e9) for i in range(5)], poses)
    torch.manual_seed(0)
    config = PoseCorrectionConfig(mode=mode)
    return config.setup(num_cameras=3, device="cpu", trajectory=trajectory, camera_times=trajectory.times[[0, 2, 4]])


@pytest.mark.parametrize("mode", ["network", "spline"])
def test_correction_starts_as_the_identity_with_finite_non_zero_gradients(mode: str) -> None:
    correction = make_correction(mode)
    seconds = torch.linspace(0, 2, 17, dtype=torch.float64)
    base = correction.trajectory.pose(seconds)
    pose = correction.pose(seconds)
    assert torch.equal(pose, base)
    motion = correction(torch.tensor([0, 1, 2]))
    torch.testing.assert_close(motion, torch.eye(4)[:3].expand(3, 3, 4), rtol=0, atol=1e-7)
    (pose * torch.randn(pose.shape, generator=torch.Generator().manual_seed(1), dtype=pose.dtype)).sum().backward()
    gradients = [p.grad for p in correction.parameters() if p.grad is not None]
    assert all(torch.isfinite(gradient).all() for gradient in gradients)
    assert max(float(gradient.abs().max()) for gradient in gradients) > 1e-3
    losses: dict[str, torch.Tensor] = {}
    correction.get_loss_dict(losses)
    assert losses["pose_correction_penalty"] == 0


def test_off_has_no_parameters_and_changes_nothing() -> None:
    correction = make_correction("off")
    groups: dict[str, list] = {}
    correction.get_param_groups(groups)
    assert groups == {}
    rays = make_rays(4, with_times=True)
    correction.apply_to_raybundle(rays)
    assert rays.times is not None
    base = correction.trajectory.pose(rays.times[:, 0])
    assert torch.equal(rays.origins, base[:, :, 3].float())


def test_the_unit_of_length_does_not_matter() -> None:
    """Parameters that turn a trajectory into another one do the same to the same trajectory in millimeters."""
    correction = make_correction("spline")
    scaled = correction.trajectory.camera_to_worlds.clone()
    scaled[:, :, 3] *= 1000
    in_millimetres = PoseCorrectionConfig(mode="spline").setup(
        num_cameras=3,
        device="cpu",
        trajectory=Trajectory(correction.trajectory.times, scaled),
        camera_times=correction.trajectory.times[:3],
    )
    torch.nn.init.normal_(correction.twists.control_twists, std=0.1)
    in_millimetres.load_state_dict(correction.state_dict())
    seconds = torch.linspace(0, 2, 9, dtype=torch.float64)
    expected = correction.pose(seconds).detach()
    expected[:, :, 3] *= 1000
    torch.testing.assert_close(in_millimetres.pose(seconds).detach(), expected, rtol=1e-6, atol=1e-6)
    losses: dict[str, torch.Tensor] = {}
    penalties = []
    for one in (correction, in_millimetres):
        one.get_loss_dict(losses)
        penalties.append(losses["pose_correction_penalty"].item())
    assert penalties[0] == pytest.approx(penalties[1])


def test_a_camera_that_only_turns_is_corrected_in_scene_units() -> None:
    correction = make_correction("spline")
    turning = correction.trajectory.camera_to_worlds.clone()
    turning[:, :, 3] = 0
    correction = PoseCorrectionConfig(mode="spline").setup(
        num_cameras=3,
        device="cpu",
        trajectory=Trajectory(correction.trajectory.times, turning),
        camera_times=correction.trajectory.times[:3],
    )
    with torch.no_grad():
        correction.twists.control_twists[:, 0] = 0.5
    seconds = torch.linspace(0, 2, 9, dtype=torch.float64)
    distance = correction.pose(seconds)[:, :, 3].norm(dim=-1)
    torch.testing.assert_close(distance, torch.full_like(distance, 0.5))


@pytest.mark.parametrize("mode", ["network", "spline"])
def test_the_viewer_s_motion_takes_the_base_pose_to_the_corrected_one(mode: str) -> None:
    correction = make_correction(mode)
    for parameter in correction.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    seconds = torch.tensor([0.0, 1.0, 2.0], dtype=torch.float64)
    motion = homogeneous(correction(torch.arange(3)).double())
    moved = homogeneous(correction.trajectory.pose(seconds)) @ motion
    torch.testing.assert_close(moved[:, :3], correction.pose(seconds), rtol=0, atol=1e-6)


def test_the_spline_is_smooth_and_reproduces_a_straight_line() -> None:
    correction = make_correction("spline")
    spline = correction.twists
    assert spline is not None
    with torch.no_grad():
        # A uniform B-spline whose control points lie on a line is that line.
        spline.control_twists.copy_(torch.arange(len(spline.control_twists))[:, None] * torch.ones(6))
    seconds = torch.linspace(0, 2, 401, dtype=torch.float64)
    twist = spline(seconds, correction.trajectory.pose(seconds))
    expected = 1 + seconds / 0.1
    torch.testing.assert_close(twist[:, 0].double(), expected, rtol=0, atol=1e-4)


def test_motion_from_twist_is_the_matrix_exponential() -> None:
    generator = torch.Generator().manual_seed(0)
    for size in (0.0, 1e-9, 9.9e-3, 1.01e-2, 0.7, 3.0):
        twist = torch.randn(6, generator=generator, dtype=torch.float64)
        twist = twist * torch.tensor([1, 1, 1, *[size / float(twist[3:].norm())] * 3], dtype=torch.float64)
        generator_matrix = torch.zeros(4, 4, dtype=torch.float64)
        generator_matrix[:3, :3] = cross_matrix(twist[3:])
        generator_matrix[:3, 3] = twist[:3]
        torch.testing.assert_close(motion_from_twist(twist), torch.matrix_exp(generator_matrix), rtol=0, atol=1e-13)
        assert torch.autograd.gradcheck(motion_from_twist, twist.requires_grad_(), atol=1e-7)


# The angles lie on both sides of the one where closed forms take over from series.
@pytest.mark.parametrize("size", [0.0, 1e-9, 0.1, 0.999, 1.001, 3.0, 8.0])
def test_the_rate_of_a_moving_exponential_is_exact_and_smooth(size: float, random_poses: torch.Tensor) -> None:
    exponential = TwistExponential()
    generator = torch.Generator().manual_seed(0)
    twist, twist_rate = torch.randn(2, len(random_poses), 6, generator=generator, dtype=torch.float64)
    twist[:, 3:] *= size / twist[:, 3:].norm(dim=-1, keepdim=True)
    base_rate = torch.randn(random_poses.shape, generator=generator, dtype=torch.float64)
    arguments = (random_poses, base_rate, twist, twist_rate)
    value, rate = exponential.with_rate(*arguments)
    expected = torch.func.jvp(exponential, (random_poses, twist), (base_rate, twist_rate))
    torch.testing.assert_close(value, expected[0], rtol=0, atol=1e-13)
    torch.testing.assert_close(rate, expected[1], rtol=0, atol=1e-12)
    few = [argument[:2].clone().requires_grad_() for argument in arguments]
    assert torch.autograd.gradcheck(exponential.with_rate, few, atol=1e-6)
    assert torch.autograd.gradgradcheck(exponential.with_rate, few, atol=1e-5)
