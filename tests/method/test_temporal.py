"""The temporal derivative, in float64 against double backward."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from helpers.small_models import ALL_LOSSES, make_batch, make_model, make_rays
from nerfstudio.cameras.rays import RayBundle

from aenerf_ns.camera.rotation import TwistExponential, motion_from_twist
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.method.model import AENeRFModel
from aenerf_ns.method.pose_correction import PoseCorrectionConfig, world_rays
from aenerf_ns.supervision.event_pairs import PairLossCoefficients
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
@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("backbone", ["hash", "mlp"])
def test_the_rate_is_exact_along_the_whole_chain(mode: str, bounded: bool, backbone: str) -> None:
    model = exact_model(
        mode,
        bounded=bounded,
        backbone=backbone,
        field={"num_hidden_layers": 1 if backbone == "hash" else 6, "num_frequencies": 4},
        # So that light passes, and all samples count.
        average_init_density=0.01,
    )
    captured: list[tuple] = []
    composite = model._composite
    model._composite = lambda samples: captured.append(samples) or composite(samples)
    rays = make_rays(60, with_times=True)
    origins, directions = world_rays(model.camera_optimizer.pose(rays.times[:, 0]), rays.metadata["camera_directions"])
    rays = replace(rays, origins=origins.detach(), directions=directions.detach())
    outputs = model(rays)
    model._composite = composite
    moving, samples = rays[40:], captured[1]
    # The samples hold the dual rays; what is used of them here are the distances.
    seconds = moving.times[:, 0].detach()
    rate = outputs["log_radiance_rate"]
    assert rate.abs().median() > 1e-3

    target, interval = torch.full((20,), 0.2, dtype=torch.float64), torch.full((20,), 0.3, dtype=torch.float64)
    parameters = [p for part in (model.field, model.camera_optimizer) for p in part.parameters()]
    loss = temporal_loss(rate[:, 1], target, interval)
    forward = torch.autograd.grad(loss, parameters, allow_unused=True, retain_graph=True)
    seconds = seconds.clone().requires_grad_()
    log_radiance = rendered_at(model, moving, seconds, samples)
    rates = [torch.autograd.grad(channel.sum(), seconds, create_graph=True)[0] for channel in log_radiance.unbind(-1)]
    torch.testing.assert_close(rate, torch.stack(rates, -1), rtol=1e-9, atol=1e-11)
    loss = temporal_loss(rates[1], target, interval)
    double_backward = torch.autograd.grad(loss, parameters, allow_unused=True)
    for a, b in zip(forward, double_backward, strict=True):
        if a is None or b is None:
            assert a is None or a.abs().max() == 0
            assert b is None or b.abs().max() == 0
            continue
        torch.testing.assert_close(a, b, rtol=1e-7, atol=1e-9 * float(b.abs().max() + 1e-30))


@pytest.mark.parametrize("rays_per_pair", [2, 3])
def test_with_the_temporal_loss_there_is_a_third_ray_in_all_losses(rays_per_pair: int) -> None:
    temporal, count = rays_per_pair == 3, 5 * rays_per_pair
    model = make_model(loss_coefficients=PairLossCoefficients(temporal_loss=1e-3 * temporal))
    outputs = model(make_rays(count, with_times=True))
    assert [len(weights) for weights in outputs["weights_list"]] == [count, count]
    assert len(outputs["log_radiance"]) == count
    assert model.supervision.num_rate_rays(15) == 5 * temporal
    assert ("temporal_loss" in model.get_loss_dict(outputs, make_batch(5))) == temporal


def test_motion_from_twist_is_the_matrix_exponential() -> None:
    generator = torch.Generator().manual_seed(0)
    for size in (0.0, 1e-9, 0.999, 1.001, 3.0):
        twist = torch.randn(6, generator=generator, dtype=torch.float64)
        twist = twist * torch.tensor([1, 1, 1, *[size / float(twist[3:].norm())] * 3], dtype=torch.float64)
        generator_matrix = torch.zeros(4, 4, dtype=torch.float64)
        generator_matrix[:3, :3] = torch.linalg.cross(twist[3:].expand(3, 3), torch.eye(3, dtype=torch.float64)).T
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
