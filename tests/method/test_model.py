"""The event ray sampler and the model: rays, rendering, losses and colour correction on small exact cases."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.model_components.losses import interlevel_loss
from nerfstudio.viewer.utils import CameraState, get_camera
from small_models import ALL_LOSSES, CAMERA, EPOCH, make_batch, make_model, make_rays, make_sampler

from aenerf_ns.camera.lens import EventCamera
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.method.pose_correction import PoseCorrectionConfig


def test_rays_lie_at_both_ends_of_each_interval(random_poses: torch.Tensor) -> None:
    sensor = SensorModel(refractory_period=1_000)
    sampler = make_sampler(random_poses, sensor)
    rays, batch = sampler.sample()
    PoseCorrectionConfig(mode="off").setup(
        num_cameras=0, device="cpu", trajectory=sampler.trajectory, camera_times=torch.zeros(0, dtype=torch.int64)
    ).apply_to_raybundle(rays)
    assert rays.origins.shape == (40, 3)
    assert rays.directions.dtype == torch.float32
    assert rays.times is not None
    starts, ends = (torch.round(rays.times[:, 0] * 1e9).long() + EPOCH).chunk(2)
    pixel_directions, _ = CAMERA.pixel_directions()
    known = {
        (EPOCH + 6_000, EPOCH + 250_000_000): ((3, 1), -1),
        (EPOCH + 101_000, EPOCH + 600_000_000): ((0, 2), -1),
        (EPOCH + 250_001_000, EPOCH + 10**9): ((3, 1), 1),
    }
    seen = set()
    for i, interval in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
        (x, y), polarity = known[interval]
        seen.add(interval)
        assert batch["num_positive"][i] - batch["num_negative"][i] == polarity
        for ray, time in ((i, interval[0]), (i + 20, interval[1])):
            pose = sampler.trajectory.interpolate(time)
            torch.testing.assert_close(rays.origins[ray], pose[:, 3].float())
            direction = pose[:, :3] @ torch.from_numpy(pixel_directions[y, x])
            torch.testing.assert_close(rays.directions[ray], direction.float(), rtol=0, atol=1e-6)
    assert seen == set(known)


def test_a_pair_spans_several_events(random_poses: torch.Tensor) -> None:
    sampler = make_sampler(random_poses, SensorModel(), max_events_per_pair=3)
    sampler.num_rays_per_batch = 8000
    rays, batch = sampler.sample()
    assert rays.times is not None
    starts, ends = torch.round(rays.times[:, 0] * 1e9).long().chunk(2)
    counts = zip(
        starts.tolist(),
        ends.tolist(),
        batch["num_positive"].tolist(),
        batch["num_negative"].tolist(),
        batch["last_num_negative"].tolist(),
        [round(seconds, 6) for seconds in batch["last_interval"].tolist()],
        strict=True,
    )
    # All that end with an event of their pixel, never beyond its first.
    found = Counter(counts)
    one, two = (250_000_000, 10**9, 1, 0, 0, 0.75), (5_000, 10**9, 1, 1, 0, 0.75)
    assert found.keys() == {
        (100_000, 600_000_000, 0, 1, 1, 0.5999),
        (5_000, 250_000_000, 0, 1, 1, 0.249995),
        one,
        two,
    }
    # One event in half of the cases: log 2 / log 4.
    assert found[one] / found[two] == pytest.approx(1, abs=0.2)


@pytest.mark.parametrize("refractory_period", [12_000_000, 12_500_000])
def test_pairs_span_events_beside_which_the_refractory_period_is_short(
    random_poses: torch.Tensor, refractory_period: int
) -> None:
    # The middle one of a pixel's three events is 245 ms after the first, 750 ms before the last.
    sensor = SensorModel(refractory_period=refractory_period)
    sampler = make_sampler(random_poses, sensor, max_events_per_pair=3)
    sampler.num_rays_per_batch = 400
    rays, batch = sampler.sample()
    assert rays.times is not None
    longer = batch["num_positive"] + batch["num_negative"] > 1
    assert longer.any() == (refractory_period == 12_000_000)
    starts, ends = torch.round(rays.times[:, 0] * 1e9).long().chunk(2)
    assert (starts[longer] == 5_000 + refractory_period).all()
    assert (ends[longer] == 10**9).all()


@pytest.mark.parametrize("max_events_per_pair", [1, 3])
def test_a_third_ray_lies_between_the_last_two_events(random_poses: torch.Tensor, max_events_per_pair: int) -> None:
    sampler = make_sampler(random_poses, SensorModel(refractory_period=1_000), max_events_per_pair=max_events_per_pair)
    sampler.num_rays_per_batch = 6000
    sampler.with_time_within = True
    rays, batch = sampler.sample()
    assert rays.times is not None
    start, end, within = rays.times[:, 0].chunk(3)
    assert ((batch["num_positive"] + batch["num_negative"]).max() > 1) == (max_events_per_pair > 1)
    single = batch["num_positive"] + batch["num_negative"] == 1
    torch.testing.assert_close(batch["last_interval"][single], (end - start)[single].float())
    assert (batch["last_num_positive"] + batch["last_num_negative"] == 1).all()
    part = 1 - (end - within) / batch["last_interval"]
    assert part.min() >= 0
    assert part.max() <= 1
    # A normal distribution of mean 0.5 and deviation 0.25, cut at two deviations, has the deviation 0.22.
    assert part.mean().item() == pytest.approx(0.5, abs=0.02)
    assert part.std().item() == pytest.approx(0.22, abs=0.01)
    # A batch to log the loss on has none.
    assert len(sampler.sample(5)[0]) == 10


def test_a_share_of_the_pairs_ends_at_uniform_moments(random_poses: torch.Tensor) -> None:
    sampler = make_sampler(random_poses, SensorModel(refractory_period=1_000), max_events_per_pair=3, share=0.75)
    sampler.num_rays_per_batch = 40_000
    rays, batch = sampler.sample()
    assert rays.times is not None
    starts, ends = rays.times[:, 0].chunk(2)
    between = batch["ends_between_events"]
    assert between.sum() == 15_000
    count = batch["num_positive"] + batch["num_negative"]
    # Nothing has happened since the pair's start, or since an event that is counted: the pixel's middle one.
    assert set(count[between].tolist()) == {0, 1}
    assert set(count[~between].tolist()) == {1, 2}
    # As many as the intervals take up, and at any time within.
    intervals = [(0.000_101, 0.6), (0.000_006, 0.25), (0.250_001, 1.0)]
    total = sum(end - start for start, end in intervals)
    for index, (start, end) in enumerate(intervals):
        inside = between & (batch["last_interval"] - (end - start)).abs().lt(1e-6)
        assert inside.sum() / 15_000 == pytest.approx((end - start) / total, abs=0.02)
        assert ends[inside].min() == pytest.approx(start, abs=0.005)
        assert ends[inside].max() == pytest.approx(end, abs=0.005)
        assert ends[inside].mean() == pytest.approx((start + end) / 2, abs=0.02)
        longer = inside & (count == 1)
        assert longer.any() == (index == 2)
        assert torch.allclose(starts[longer], torch.tensor(0.000_006, dtype=torch.float64))
        assert torch.allclose(starts[inside & ~longer], torch.tensor(start, dtype=torch.float64))


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_sampling_is_seeded(share: float, random_poses: torch.Tensor) -> None:
    sampler = make_sampler(random_poses, SensorModel(), share=share)
    batches = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        batches.append(sampler.sample()[0].times)
    assert torch.equal(batches[0], batches[1])
    assert not torch.equal(batches[0], batches[2])


def test_the_colour_filter_is_that_of_the_raw_pixel(random_poses: torch.Tensor) -> None:
    _, batch = make_sampler(random_poses, SensorModel(bayer_pattern="RGGB")).sample()
    # Pixel (3, 1) is blue and pixel (0, 2) red.
    assert set(batch["channel"].tolist()) == {0, 2}


def test_pixels_without_a_direction_are_not_sampled(random_poses: torch.Tensor) -> None:
    # This lens model folds over towards the corners, pixel (0, 2) among them.
    nowhere = EventCamera(4, 3, 0.1, 0.1, 30.0, 1.5, "radial_tangential", (-0.4, 0.0, 0.0, 0.0, 0.0))
    for share in (0.0, 1.0):
        with pytest.raises(DataError, match="no event lies on a pixel with a direction"):
            make_sampler(random_poses, SensorModel(), nowhere, share=share).prepare()
    folded = EventCamera(4, 3, 1.2, 1.2, 3.0, 1.5, "radial_tangential", (-0.4, 0.0, 0.0, 0.0, 0.0))
    assert not folded.pixel_directions()[1][2, 0]
    assert folded.pixel_directions()[1][1, 3]
    for share in (0.0, 1.0):
        _, batch = make_sampler(random_poses, SensorModel(bayer_pattern="RGGB"), folded, share=share).sample()
        assert set(batch["channel"].tolist()) == {2}


@pytest.mark.parametrize("backbone", ["hash", "mlp"])
@pytest.mark.parametrize("contraction", ["l2", "linf", "none"])
@pytest.mark.parametrize("bayer_pattern", ["", "RGGB"])
def test_outputs_have_their_shapes_and_ranges(backbone: str, contraction: str, bayer_pattern: str) -> None:
    sensor = SensorModel(bayer_pattern=bayer_pattern)
    model = make_model(sensor, scene_contraction=contraction, backbone=backbone).eval()
    outputs = model(make_rays())
    channels = 3 if bayer_pattern else 1
    assert outputs["log_radiance"].shape == (10, channels)
    assert outputs["rgb"].shape == (10, 3)
    assert outputs["depth"].shape == outputs["accumulation"].shape == (10, 1)
    assert (outputs["rgb"] >= 0).all()
    assert (outputs["rgb"] <= 1).all()
    assert all(torch.isfinite(value).all() for value in outputs.values())


def test_proposal_loss_is_normalised_by_the_mean_threshold() -> None:
    model = make_model(loss_coefficients={"interlevel_loss": 3.0})
    model.field.average_init_density = 5.0
    outputs = model(make_rays())
    losses = model.get_loss_dict(outputs, make_batch(5))
    expected = 3.0 * interlevel_loss(outputs["weights_list"], outputs["ray_samples_list"]) / 0.25**2
    assert expected > 0
    torch.testing.assert_close(losses["interlevel_loss"], expected)


def test_between_events_changes_within_the_thresholds_are_right() -> None:
    model = make_model(loss_coefficients={"reconstruction_loss": 1.0, "interlevel_loss": 0.0, "distortion_loss": 0.0})
    # Events tell of -0.3, 0.2, -0.3, 0.2, -0.3; the thresholds are 0.2 and 0.3.
    log_radiance = torch.zeros(10, 1)
    log_radiance[5:, 0] = torch.tensor([-0.61, 0.38, -0.05, -0.08, -0.3])
    outputs = model(make_rays()) | {"log_radiance": log_radiance.requires_grad_()}
    batch = make_batch(5) | {"ends_between_events": torch.tensor([True, True, True, True, False])}
    loss = model.get_loss_dict(outputs, batch)["reconstruction_loss"]
    errors = torch.tensor([-0.01, 0.0, 0.05, 0.0, 0.0])
    torch.testing.assert_close(loss, (errors**2).mean() / 0.25**2)
    (gradient,) = torch.autograd.grad(loss, log_radiance)
    torch.testing.assert_close(gradient[5:, 0], 2 * errors / 5 / 0.25**2)
    # Of changes that are known to a threshold the sign says nothing.
    assert model.get_metrics_dict(outputs, batch)["polarity_agreement"] == 1


def test_losses_are_those_of_the_rendered_changes() -> None:
    model = make_model(loss_coefficients={"reconstruction_loss": 2.0, "interlevel_loss": 0.0, "distortion_loss": 0.0})
    outputs, batch = model(make_rays()), make_batch(5)
    losses = model.get_loss_dict(outputs, batch)
    change = outputs["log_radiance"][5:, 0] - outputs["log_radiance"][:5, 0]
    target = torch.tensor([-0.3, 0.2, -0.3, 0.2, -0.3])
    expected = 2.0 * ((change - target) ** 2).mean() / 0.25**2
    torch.testing.assert_close(losses["reconstruction_loss"], expected)
    assert losses["interlevel_loss"] == 0
    assert losses["distortion_loss"] == 0


@pytest.mark.parametrize(
    "backbone", [{}, {"backbone": "mlp", "num_hidden_layers": 6, "num_proposal_samples_per_ray": (16, 8)}]
)
@pytest.mark.parametrize("bounded", [True, False])
def test_every_parameter_is_in_one_group_and_gets_a_gradient(backbone: dict[str, Any], bounded: bool) -> None:
    correction = PoseCorrectionConfig(mode="spline")
    model = make_model(bounded=bounded, camera_optimizer=correction, loss_coefficients=ALL_LOSSES, **backbone)
    # Denser than the proposals, or their loss has no gradient.
    model.field.average_init_density = 5.0
    losses = model.get_loss_dict(model(make_rays(15, with_times=True)), make_batch(5))
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
    # Weight decay is for network weights alone.
    decayed = {name for name, parameter in named.items() if any(parameter is other for other in groups["networks"])}
    assert decayed == {name for name in named if ".layers." in name}


def test_the_mlps_are_those_of_the_paper() -> None:
    model = make_model(
        backbone="mlp",
        num_hidden_layers=8,
        hidden_dim=1024,
        geometry_feature_dim=256,
        num_proposal_samples_per_ray=(16, 8),
        proposal_num_hidden_layers=4,
        proposal_hidden_dim=256,
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


@pytest.mark.parametrize("contraction", ["l2", "linf", "none"])
def test_the_mlp_density_is_softplus_and_ends_at_the_box(contraction: str) -> None:
    model = make_model(backbone="mlp", scene_contraction=contraction, average_init_density=0.3)
    with torch.no_grad():
        model.field.density_network.layers[-1].weight.zero_()
        model.field.density_network.layers[-1].bias.fill_(2.0)
    positions = torch.tensor([[0.5, -0.2, 0.9], [0.5, -0.2, 1.1]])
    # softplus(log(exp(d) - 1)) = d: the density where the network gives 0.
    inside = torch.log1p(torch.exp(torch.tensor(2.0)) * torch.expm1(torch.tensor(0.3)))
    expected = torch.stack([inside, inside * (contraction != "none")])[:, None]
    torch.testing.assert_close(model.field.density_fn(positions), expected)


def test_rays_past_a_bounded_scene_see_the_background() -> None:
    model = make_model(bounded=True).eval()
    outputs = model(make_rays(away=True))
    assert outputs["accumulation"].max() < 1e-3
    assert model.raw_background is not None
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


def test_the_picture_is_the_colour_corrected_one() -> None:
    model = make_model().eval()
    model.color_correction.scale.fill_(0.5)
    model.color_correction.offset.fill_(-1.0)
    outputs = model(make_rays())
    linear = (torch.exp(0.5 * outputs["log_radiance"] - 1) - 1e-3).clamp(0, 1)
    expected = torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    torch.testing.assert_close(outputs["rgb"], expected.expand(-1, 3))


def test_image_metrics_compare_with_what_the_sensor_sees() -> None:
    model = make_model().eval()
    reference = torch.rand(16, 16, 3)
    grey = model.reference_display(reference)
    outputs = {"rgb": grey, "accumulation": torch.ones(16, 16, 1), "depth": torch.ones(16, 16, 1)}
    metrics, images = model.get_image_metrics_and_images(outputs, {"image": reference})
    assert metrics["psnr"] > 60
    assert metrics["ssim"] == pytest.approx(1.0, abs=1e-4)
    assert images["img"].shape == (16, 32, 3)


def test_rendering_in_chunks_changes_nothing() -> None:
    model = make_model(eval_num_rays_per_chunk=3).train()
    rays = make_rays()
    whole = make_model().eval()(make_rays())["log_radiance"]
    torch.testing.assert_close(model.render_log_radiance(rays), whole)
    assert model.training


@pytest.mark.parametrize("mode", ["off", "spline"])
def test_the_viewer_s_cameras_are_rendered(mode: str) -> None:
    # They have a time, too, which is none of the trajectory's.
    model = make_model(camera_optimizer=PoseCorrectionConfig(mode=mode)).eval()
    state = CameraState(fov=1.0, aspect=4 / 3, c2w=torch.eye(4)[:3], camera_type=CameraType.PERSPECTIVE)
    camera = get_camera(state, 6, 8)
    assert camera.times is not None
    assert model.get_outputs_for_camera(camera)["rgb"].shape == (6, 8, 3)
