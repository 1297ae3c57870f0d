"""The model: rendering, losses and color correction on small exact cases."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from helpers.small_models import ALL_LOSSES, make_batch, make_model, make_rays
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import Frustums, RaySamples
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.model_components.losses import interlevel_loss
from nerfstudio.model_components.renderers import background_color_override_context
from torch import Tensor

from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.method.field import to_unit_cube
from aenerf_ns.method.pose_correction import PoseCorrectionConfig
from aenerf_ns.supervision.event_pairs import PairLossCoefficients, PairSupervisionConfig


@pytest.mark.parametrize("backbone", ["hash", "mlp"])
@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("bayer_pattern", ["", "RGGB"])
def test_outputs_have_their_shapes_and_ranges(backbone: str, bounded: bool, bayer_pattern: str) -> None:
    sensor = SensorModel(bayer_pattern=bayer_pattern)
    model = make_model(sensor, bounded=bounded, backbone=backbone).eval()
    outputs = model(make_rays())
    channels = 3 if bayer_pattern else 1
    assert outputs["log_radiance"].shape == (10, channels)
    assert outputs["rgb"].shape == (10, 3)
    assert outputs["depth"].shape == outputs["accumulation"].shape == (10, 1)
    assert (outputs["rgb"] >= 0).all()
    assert (outputs["rgb"] <= 1).all()
    assert all(torch.isfinite(value).all() for value in outputs.values())


@pytest.mark.parametrize("bounded", [False, True])
def test_beside_a_crop_box_there_is_the_color_of_the_crop(bounded: bool) -> None:
    model = make_model(bounded=bounded).eval()
    camera = Cameras(torch.eye(4)[None, :3], fx=4.0, fy=4.0, cx=4.0, cy=3.0, width=8, height=6)
    box = OrientedBox(torch.eye(3), torch.tensor([0.0, 0.0, -1.0]), torch.full((3,), 0.5))
    color = torch.tensor([1.0, 0.5, 0.0])
    with background_color_override_context(color):
        outputs = model.get_outputs_for_camera(camera, box)
    assert all(torch.isfinite(value).all() for value in outputs.values())
    assert outputs["accumulation"][0, 0] == 0
    assert torch.equal(outputs["rgb"][0, 0], color)
    assert outputs["depth"][0, 0] == model.config.far_plane
    assert outputs["accumulation"][3, 4] > 0
    without = model.get_outputs_for_camera(camera, box)["rgb"]
    torch.testing.assert_close(outputs["rgb"], torch.lerp(color, without, outputs["accumulation"]))


def test_between_events_changes_within_the_thresholds_are_right() -> None:
    model = make_model(loss_coefficients=PairLossCoefficients(interlevel_loss=0.0, distortion_loss=0.0))
    # Events tell of -0.3, 0.2, -0.3, 0.2, -0.3; the thresholds are 0.2 and 0.3.
    log_radiance = torch.zeros(10, 1)
    log_radiance[5:, 0] = torch.tensor([-0.61, 0.38, -0.05, -0.08, -0.3])
    outputs = model(make_rays()) | {"log_radiance": log_radiance.requires_grad_()}
    batch = replace(make_batch(5), ends_between_events=torch.tensor([True, True, True, True, False]))
    loss = model.get_loss_dict(outputs, batch)["reconstruction_loss"]
    errors = torch.tensor([-0.01, 0.0, 0.05, 0.0, 0.0])
    torch.testing.assert_close(loss, (errors**2).mean() / 0.25**2)
    (gradient,) = torch.autograd.grad(loss, log_radiance)
    torch.testing.assert_close(gradient[5:, 0], 2 * errors / 5 / 0.25**2)
    # Of changes that are known to a threshold the sign says nothing.
    assert model.get_metrics_dict(outputs, batch)["polarity_agreement"] == 1


def test_losses_are_those_of_the_rendered_changes() -> None:
    model = make_model(loss_coefficients=PairLossCoefficients(2.0, interlevel_loss=3.0, distortion_loss=0.0))
    model.field.average_init_density = 5.0
    positive, weight = torch.tensor([0.0, 1.0, 0.0, 2.0, 0.0]), torch.tensor([1.0, 0.5, 0.0, 1.0, 1.0])
    outputs, batch = model(make_rays()), replace(make_batch(5), num_positive=positive, weight=weight)
    losses = model.get_loss_dict(outputs, batch)
    change = outputs["log_radiance"][5:, 0] - outputs["log_radiance"][:5, 0]
    target = torch.tensor([-0.3, 0.2, -0.3, 0.4, -0.3])
    expected = 2.0 * (weight * (change - target) ** 2).mean() / 0.25**2
    torch.testing.assert_close(losses["reconstruction_loss"], expected)
    assert losses["distortion_loss"] == 0
    # It is in units of the mean threshold, too.
    expected = 3.0 * interlevel_loss(outputs["weights_list"], outputs["ray_samples_list"]) / 0.25**2
    assert expected > 0
    torch.testing.assert_close(losses["interlevel_loss"], expected)


@pytest.mark.parametrize(
    "backbone",
    [{}, {"backbone": "mlp", "field": {"num_hidden_layers": 6}, "proposal": {"num_samples_per_ray": (16, 8)}}],
)
@pytest.mark.parametrize("bounded", [True, False])
def test_every_parameter_is_in_one_group_and_gets_a_gradient(backbone: dict[str, Any], bounded: bool) -> None:
    correction = PoseCorrectionConfig(mode="spline", rigid_offset=True, clock_offset=0.0)
    supervision = PairSupervisionConfig(learn_contrast_threshold_ratio=True, learn_refractory_period=True)
    parts = {"camera_optimizer": correction, "supervision": supervision, "loss_coefficients": ALL_LOSSES}
    model = make_model(bounded=bounded, **parts, **backbone)
    model.supervision.prepare(SimpleNamespace(pairs=SimpleNamespace(shortest_interval=10_000)))
    # Denser than the proposals, or their loss has no gradient.
    model.field.average_init_density = 5.0
    outputs, batch = model(make_rays(15, with_times=True)), make_batch(5)
    metrics = model.get_metrics_dict(outputs, batch)
    for name, value in ("clock_offset_seconds", 0), ("contrast_threshold_ratio", 2 / 3), ("refractory_period_ns", 5000):
        assert metrics[name] == pytest.approx(value, rel=1e-3)
    losses = model.get_loss_dict(outputs, batch)
    assert set(losses) == {
        "reconstruction_loss", "temporal_loss", "interlevel_loss", "distortion_loss", "pose_correction_penalty"
    }  # fmt: skip
    torch.stack(list(losses.values())).sum().backward()
    groups = model.get_param_groups()
    grouped = [parameter for group in groups.values() for parameter in group]
    assert len(grouped) == len(set(grouped))
    # An optimizer without parameters is an error.
    assert all(groups.values())
    named = {name: parameter for name, parameter in model.named_parameters() if parameter.numel() > 0}
    assert set(named.values()) == set(grouped)
    for name, parameter in named.items():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().max() > 0, name
    # Weight decay is for the weights of the field's networks alone.
    decayed = {name for name, parameter in named.items() if any(parameter is other for other in groups["networks"])}
    assert decayed == {name for name in named if ".layers." in name and name.startswith("field.")}


def test_the_mlps_are_those_of_the_paper() -> None:
    model = make_model(
        backbone="mlp",
        field={"num_hidden_layers": 8, "hidden_dim": 1024, "geometry_feature_dim": 256},
        proposal={"num_samples_per_ray": (16, 8), "num_hidden_layers": 4, "hidden_dim": 256},
    )
    # Ten frequencies of sine and cosine, and the position itself.
    encoded = 63
    shapes = [tuple(layer.weight.shape) for layer in model.field.density_network.layers]
    assert shapes == [
        (1024, encoded), *[(1024, 1024)] * 4, (1024, 1024 + encoded), *[(1024, 1024)] * 2, (1 + 256, 1024)
    ]  # fmt: skip
    # One proposal network, evaluated twice.
    (proposal_network,) = model.proposal_networks
    shapes = [tuple(layer.weight.shape) for layer in proposal_network.density_network.layers]
    assert shapes == [(256, encoded), *[(256, 256)] * 3, (1, 256)]
    assert len(model.density_fns) == 2


@pytest.mark.parametrize("bounded", [False, True])
def test_the_mlp_sees_the_mean_of_the_encoding_over_a_sample(bounded: bool) -> None:
    model = make_model(backbone="mlp", bounded=bounded, field={"num_frequencies": 5})
    origin, direction = torch.tensor([-0.5, 0.2, -0.7]), torch.tensor([0.6, 0.0, 0.8])
    across = torch.tensor([[0.0, 1.0, 0.0], [0.8, 0.0, -0.6]])
    edges = torch.tensor([0.5, 0.7, 0.9, 1.3, 1.9])[:, None]
    frustums = Frustums(
        origins=origin.expand(1, 4, 3),
        directions=direction.expand(1, 4, 3),
        starts=edges[None, :-1],
        ends=edges[None, 1:],
        pixel_area=torch.full((1, 4, 1), 0.02),
    )
    seen: list[Tensor] = []
    model.field.density_network.forward = lambda encoded: seen.append(encoded) or torch.zeros(len(encoded), 16)
    model.field.get_density(RaySamples(frustums=frustums))
    distances = edges[:-1, None] + edges.diff(dim=0)[:, None] * torch.rand(4, 20000, 1)
    offsets = 0.02**0.5 * distances * (torch.rand(4, 20000, 2) - 0.5)
    points, middles = origin + distances * direction + offsets @ across, frustums.get_positions()[0]
    within, plain = (
        model.field.encoding(to_unit_cube(places, model.field.spatial_distortion, model.field.aabb))
        for places in (points, middles)
    )
    # A Gaussian takes the place of the frustum. It lacks the small oscillations of what ends abruptly.
    torch.testing.assert_close(seen[0], within.mean(1), rtol=0, atol=0.2)
    assert (plain - within.mean(1)).abs().max() > 0.7


@pytest.mark.parametrize("bounded", [False, True])
def test_the_mlp_density_is_softplus_and_ends_at_the_box(bounded: bool) -> None:
    model = make_model(backbone="mlp", bounded=bounded, average_init_density=0.3)
    with torch.no_grad():
        model.field.density_network.layers[-1].weight.zero_()
        model.field.density_network.layers[-1].bias.fill_(2.0)
    positions = torch.tensor([[0.5, -0.2, 0.9], [0.5, -0.2, 1.1]])
    # softplus(log(exp(d) - 1)) = d: the density where the network gives 0.
    inside = torch.log1p(torch.exp(torch.tensor(2.0)) * torch.expm1(torch.tensor(0.3)))
    expected = torch.stack([inside, inside * (not bounded)])[:, None]
    torch.testing.assert_close(model.field.density_fn(positions), expected)


@pytest.mark.parametrize("mode", ["off", "spline"])
def test_a_field_that_moves_along_has_room_beyond_the_box(mode: str) -> None:
    model = make_model(bounded=True, camera_optimizer=PoseCorrectionConfig(mode=mode))
    if model.warp is not None:
        model.warp.update(model.camera_optimizer)
    # The box ends at 1, and a twentieth of its side is 0.1.
    positions = torch.tensor([[[0.0, 0.0, 0.99]], [[0.0, -1.09, 0.0]], [[1.11, 0.0, 0.0]]])
    densities = [network.density_fn(positions)[:, 0, 0] > 0 for network in (model.field, *model.proposal_networks)]
    for has_density in densities:
        assert has_density.tolist() == [True, mode == "spline", False]
    # No ray is followed beyond the box, with either.
    assert model.collider(make_rays()).nears.min() >= 2


def test_rays_past_a_bounded_scene_see_the_background() -> None:
    model = make_model(bounded=True).eval()
    outputs = model(make_rays(away=True))
    assert outputs["accumulation"].max() < 1e-3
    expected = torch.log(F.softplus(model.raw_background) + 1e-3).expand(10, 1)
    torch.testing.assert_close(outputs["log_radiance"], expected, atol=1e-3, rtol=0)
    # From z = 3, so behind the box: the viewer hides what lies behind a pixel's depth.
    torch.testing.assert_close(outputs["depth"], torch.full((10, 1), 3 + 12**0.5), atol=1e-3, rtol=0)
    assert make_model(bounded=False).raw_background is None


def test_a_camera_within_the_box_sees_nothing_nearer_than_the_near_plane() -> None:
    model = make_model(bounded=True, near_plane=0.3)
    rays = make_rays(5)
    rays.origins = torch.zeros(5, 3)
    for training in (True, False):
        nears = model.train(training).collider(rays).nears
        torch.testing.assert_close(nears, torch.full((5, 1), 0.3))
        assert (rays.fars >= 1).all()
    # And from so near a wall nothing of it.
    rays.origins = torch.tensor([0.0, 0.0, -0.9]).expand(5, 3)
    assert model(rays)["accumulation"].max() < 1e-3


def test_image_metrics_compare_with_what_the_sensor_sees() -> None:
    model = make_model().eval()
    reference = torch.rand(16, 16, 3)
    gray = model.reference_display(reference)
    outputs = {"rgb": gray, "accumulation": torch.ones(16, 16, 1), "depth": torch.ones(16, 16, 1)}
    metrics, images = model.get_image_metrics_and_images(outputs, {"image": reference})
    assert metrics["psnr"] > 60
    assert metrics["ssim"] == pytest.approx(1.0, abs=1e-4)
    assert images["img"].shape == (16, 32, 3)
    # The ends of the color map: no error, and one of half of the range of display values.
    dark, bright = torch.tensor([0.267, 0.005, 0.329]), torch.tensor([0.993, 0.906, 0.144])
    torch.testing.assert_close(images["error"], dark.expand(16, 16, 3), atol=2e-3, rtol=0)
    outputs["rgb"] = torch.where(gray > 0.5, gray - 0.5, gray + 0.5)
    _, images = model.get_image_metrics_and_images(outputs, {"image": reference})
    torch.testing.assert_close(images["error"], bright.expand(16, 16, 3), atol=0.02, rtol=0)


def test_pictures_are_also_rendered_without_color_correction() -> None:
    rays = make_rays()
    outputs = make_model(color_correction="none").eval()(rays)
    # The viewer shows the first when it starts.
    assert list(outputs) == ["rgb", "uncorrected_rgb", "log_radiance", "accumulation", "depth"]
    torch.testing.assert_close(outputs["uncorrected_rgb"], outputs["rgb"])
    model = make_model(sensor=SensorModel(0.2, 0.3, bayer_pattern="RGGB")).eval()
    before = model(rays)
    model.color_correction.stretch(before["log_radiance"])
    after = model(rays)
    assert (after["rgb"] - before["rgb"]).abs().max() > 0.01
    torch.testing.assert_close(after["uncorrected_rgb"], before["uncorrected_rgb"])
    torch.testing.assert_close(after["mean_log_radiance"], after["log_radiance"].mean(-1, keepdim=True))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"proposal": {"num_samples_per_ray": (8, 8), "max_resolutions": (32,)}}, "2 values, .*_resolutions 1"),
        ({"field": {"num_samples_per_ray": 0}}, "field.num_samples_per_ray 0; give one or more"),
        ({"proposal": {"num_samples_per_ray": (0,)}}, "proposal.num_samples_per_ray 0; give one or more"),
        ({"proposal": {"num_levels": 0}}, "proposal.num_levels 0; give one or more"),
        ({"camera_optimizer": PoseCorrectionConfig(knot_interval=0.0)}, "knot_interval 0; give seconds above 0"),
        ({"camera_optimizer": PoseCorrectionConfig(knot_interval=math.inf)}, "knot_interval inf; give seconds"),
        ({"camera_optimizer": PoseCorrectionConfig(clock_offset=-20.0)}, "clock_offset -20; give seconds, fewer than"),
        ({"camera_optimizer": PoseCorrectionConfig(clock_offset=math.nan)}, "clock_offset nan; give seconds"),
        ({"far_plane": 1e8}, r"far_plane 1e\+08; give a far plane above the near one, at most 1e\+07"),
        ({"average_init_density": 0.0}, "average_init_density 0; give a number above 0"),
        ({"color_correction_num_rays": 0}, "color_correction_num_rays 0; give thousands"),
        ({"average_init_density": 1000.0}, "average_init_density 1000; .* below 700"),
    ],
)
def test_impossible_options_are_one_line(options: dict, message: str) -> None:
    with pytest.raises(DataError, match=message):
        make_model(**options)


def test_rendering_in_chunks_changes_nothing() -> None:
    model = make_model(eval_num_rays_per_chunk=3).train()
    rays = make_rays()
    whole = make_model().eval()(make_rays())["log_radiance"]
    torch.testing.assert_close(model.render_rays(rays, "log_radiance"), [whole])
    assert model.training


def test_a_picture_does_not_move_the_steps_that_train_the_proposal_networks() -> None:
    model = make_model()
    sampler = model.proposal_sampler
    # Late enough for the sampler to leave out steps, and due for an update.
    sampler._step, sampler._steps_since_update = 5000, 100
    model.eval()(make_rays())
    assert sampler._steps_since_update == 100
    model.train()(make_rays())
    assert sampler._steps_since_update == 0
