"""The protocols of color correction: what each recovers, from which views, and that it is stored."""

from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from helpers.small_pipelines import make_pipeline, make_pipeline_config
from nerfstudio.cameras.rays import RayBundle
from PIL import Image

from aenerf_ns.camera.image_encoding import encode
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.evaluation.color_fit import replace_color_correction
from aenerf_ns.method.color_correction import (
    COLOR_CORRECTIONS,
    AffineColorCorrection,
    NetworkColorCorrection,
    NoColorCorrection,
    TranslatedGammaColorCorrection,
)
from aenerf_ns.method.color_protocol import ColorCorrectionProtocol

FITTED = [protocol for protocol in COLOR_CORRECTIONS if protocol != "none"]


def mean_squared_error(correction: torch.nn.Module, log_radiance: torch.Tensor, reference: torch.Tensor) -> float:
    return float((correction(log_radiance) - encode(reference, "srgb")).square().mean())


def crosstalk(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Log-radiance and reference radiance (count, 3) between which lie an offset and an exponent of each channel, and
    a mixture of the channels, which no map of single channels undoes."""
    reference = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))
    mixture = torch.tensor([[0.8, 0.2, 0.0], [0.1, 0.7, 0.2], [0.0, 0.3, 0.7]])
    exponent, gain = torch.tensor([0.5, 0.8, 1.5]), torch.tensor([0.3, 2.0, 1.0])
    return exponent * torch.log(reference @ mixture.T + 1e-3) + torch.log(gain), reference


@pytest.mark.parametrize("protocol", ["affine", "affine-test", "translated-gamma"])
def test_affine_fit_recovers_gain_and_exponent_of_each_channel(protocol: ColorCorrectionProtocol) -> None:
    generator = torch.Generator().manual_seed(0)
    reference = torch.rand(5000, 3, generator=generator)
    gain, exponent = torch.tensor([0.3, 2.0, 1.0]), torch.tensor([0.5, 1.0, 1.7])
    log_radiance = exponent * torch.log(reference + 1e-3) + torch.log(gain)
    correction = COLOR_CORRECTIONS[protocol](3, "srgb")
    correction.fit(log_radiance, reference, num_views=7)
    torch.testing.assert_close(correction.scale, 1 / exponent)
    torch.testing.assert_close(correction.offset, -torch.log(gain) / exponent)
    torch.testing.assert_close(correction(log_radiance), encode(reference, "srgb"), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("num_pixels", [1, 4])
@pytest.mark.parametrize("protocol", ["affine", "translated-gamma"])
def test_fit_of_a_constant_rendering_is_the_mean(protocol: ColorCorrectionProtocol, num_pixels: int) -> None:
    correction = COLOR_CORRECTIONS[protocol](1, "linear")
    correction.fit(torch.full((num_pixels, 1), 0.7), torch.full((num_pixels, 1), 0.25), num_views=1)
    torch.testing.assert_close(correction(torch.tensor([[0.7]])), torch.tensor([[0.25]]))


def black_level(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Log-radiance and reference radiance (count, 3) = b L^a - c, with a black level c that differs by channel."""
    log_radiance = 2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)) - 1
    a, b, c = torch.tensor([0.7, 1.0, 1.6]), torch.tensor([0.3, 0.25, 0.1]), torch.tensor([-0.05, 0.02, -0.1])
    return log_radiance, b * torch.exp(a * log_radiance) - c


def test_reversed_polarities_are_named() -> None:
    radiance = torch.linspace(0.1, 0.9, 50)[:, None]
    correction = AffineColorCorrection(1, "linear")
    assert not correction.is_reversed
    correction.fit(radiance.log(), radiance, num_views=2)
    assert "reversed" not in correction.description
    correction.fit(-radiance.log(), radiance, num_views=2)
    assert "negative slope, as if the events' polarities were reversed" in correction.description


def test_translated_gamma_recovers_exponent_gain_and_black_level() -> None:
    affine, gamma = AffineColorCorrection(3, "srgb"), TranslatedGammaColorCorrection(3, "srgb")
    for correction in (affine, gamma):
        correction.fit(*black_level(2000, seed=0), num_views=4)
    torch.testing.assert_close(gamma.scale, torch.tensor([0.7, 1.0, 1.6]), atol=1e-4, rtol=0)
    torch.testing.assert_close(gamma.offset.exp(), torch.tensor([0.3, 0.25, 0.1]), atol=1e-4, rtol=0)
    torch.testing.assert_close(gamma.black, torch.tensor([-0.05, 0.02, -0.1]), atol=1e-4, rtol=0)
    assert gamma.description == "translated-gamma, fitted on 4 validation views, exponent a = 0.700, 1.000, 1.600"
    # Two runs are measured alike even if their fits find other exponents.
    assert gamma.fitted_on == "4 validation views"
    held_out = black_level(2000, seed=1)
    assert mean_squared_error(gamma, *held_out) < 1e-8
    # A PSNR of less than 45 dB.
    assert mean_squared_error(affine, *held_out) > 3e-5


def test_the_network_learns_what_no_affine_map_can() -> None:
    affine, network = AffineColorCorrection(3, "srgb"), NetworkColorCorrection(3, "srgb")
    for correction in (affine, network):
        correction.fit(*crosstalk(2000, seed=0), num_views=4)
    held_out = crosstalk(2000, seed=1)
    # 10 dB.
    assert mean_squared_error(network, *held_out) < 0.1 * mean_squared_error(affine, *held_out)
    assert network(held_out[0]).min() >= 0
    assert network(held_out[0]).max() <= 1


@pytest.mark.parametrize("num_channels", [1, 3])
def test_the_network_is_the_affine_map_until_it_is_fitted_in_full(num_channels: int) -> None:
    log_radiance, reference = (values[:, :num_channels] for values in crosstalk(500, seed=0))
    affine, network = AffineColorCorrection(num_channels, "srgb"), NetworkColorCorrection(num_channels, "srgb")
    assert torch.equal(network(log_radiance), affine(log_radiance))
    affine.fit(log_radiance, reference, num_views=4)
    network.fit(log_radiance, reference, num_views=4)
    assert not torch.equal(network(log_radiance), affine(log_radiance))
    assert network.description == "network, fitted on 4 validation views"
    network.fit(log_radiance, reference, num_views=4, rough=True)
    assert torch.equal(network(log_radiance), affine(log_radiance))
    # A checkpoint of a run that was stopped early must not pass for the whole.
    assert network.description == "network, fitted on 4 validation views, its affine part only"


def test_the_network_is_bounded_far_from_what_it_was_fitted_on() -> None:
    affine, network = AffineColorCorrection(1, "srgb"), NetworkColorCorrection(1, "srgb")
    log_radiance, reference = (values[:, :1] for values in crosstalk(500, seed=0))
    for correction in (affine, network):
        correction.fit(log_radiance, reference, num_views=1)
    far = torch.tensor([[-100.0], [100.0]])
    torch.testing.assert_close(network(far), affine(far), atol=0.25, rtol=0)


@pytest.mark.parametrize("protocol", FITTED)
def test_percentile_stretch_covers_the_display(protocol: ColorCorrectionProtocol) -> None:
    correction = COLOR_CORRECTIONS[protocol](1, "linear")
    # What was fitted before leaves no trace.
    correction.fit(*(values[:, :1] for values in crosstalk(100, seed=0)), num_views=2)
    log_radiance = torch.linspace(-5, 3, 1001)[:, None]
    correction.stretch(log_radiance)
    shown = correction(log_radiance)
    assert shown[10].item() == pytest.approx(0.02, rel=1e-3)
    assert shown[990].item() == pytest.approx(0.9, rel=1e-3)
    assert correction.description.startswith("percentile stretch, no ")


@pytest.mark.parametrize("protocol", COLOR_CORRECTIONS)
def test_fits_are_the_same_every_time_and_are_restored_from_checkpoints(protocol: ColorCorrectionProtocol) -> None:
    log_radiance, reference = crosstalk(200, seed=0)
    before = torch.get_rng_state()
    first, again, restored = (COLOR_CORRECTIONS[protocol](3, "srgb") for _ in range(3))
    if not isinstance(first, NoColorCorrection):
        with torch.no_grad():
            first.fit(log_radiance, reference, num_views=3)
        # From another state.
        again.fit(-log_radiance.flip(0), reference, num_views=8)
        again.fit(log_radiance, reference, num_views=3)
    # The framework wants an optimizer for every parameter that is trained.
    assert not any(parameter.requires_grad for parameter in first.parameters())
    assert torch.equal(torch.get_rng_state(), before)
    restored.load_state_dict(first.state_dict(), strict=True)
    for other in (again, restored):
        assert torch.equal(other(log_radiance), first(log_radiance))
        assert other.description == first.description


def test_checkpoints_of_the_affine_protocol_hold_these_buffers() -> None:
    # Checkpoints of the first version do.
    assert set(AffineColorCorrection(3, "srgb").state_dict()) == {"scale", "offset", "num_views"}


@pytest.mark.parametrize("test_mode", ["val", "test"])
def test_each_protocol_is_fitted_on_its_own_views(test_mode: Literal["test", "val"], tmp_path: Path) -> None:
    pipeline = make_pipeline(tmp_path / "made", test_mode)
    gray, orange = torch.full((3,), 0.4), torch.tensor([0.8, 0.4, 0.2])
    expected: dict[ColorCorrectionProtocol, tuple[str, torch.Tensor]] = {
        "affine": ("affine, fitted on 2 validation views", gray),
        "affine-test": ("affine-test, fitted on the 3 test views themselves", orange),
        "translated-gamma": ("translated-gamma, fitted on 2 validation views, exponent a = ", gray),
        "network": ("network, fitted on 2 validation views", gray),
    }
    camera = pipeline.datamanager.reference_views("test").cameras[0:1]
    rays = camera.generate_rays(0, keep_shape=False)
    for protocol, (description, color) in expected.items():
        replace_color_correction(pipeline.trained_run(), protocol)
        assert pipeline.model.color_correction.description.startswith(description)
        # All references are alike, so whatever is rendered becomes their color.
        shown = pipeline.model.eval()(rays)["rgb"]
        torch.testing.assert_close(shown, color.expand_as(shown), atol=0.02, rtol=0)
    pipeline.color_fit.fit(1 / 8)
    assert pipeline.model.color_correction.description.endswith("its affine part only")
    # The fit adds no parameters to those that the framework optimizes.
    optimized = {parameter for group in pipeline.get_param_groups().values() for parameter in group}
    assert optimized.isdisjoint(pipeline.model.color_correction.parameters())
    replace_color_correction(pipeline.trained_run(), "none")
    outputs = pipeline.model.eval()(rays)
    torch.testing.assert_close(outputs["rgb"], encode(torch.exp(outputs["log_radiance"]), "srgb"))
    assert pipeline.model.color_correction.description == "none"


def test_pixels_without_a_direction_are_not_fitted(tmp_path: Path) -> None:
    make_pipeline_config(tmp_path / "made")
    file = tmp_path / "made" / "transforms.json"
    file.write_text(file.read_text().replace('"k1": 0.0', '"k1": -1.0'))
    usable = CameraIntrinsics(6, 4, 5.0, 5.0, 3.0, 2.0, distortion=(-1.0, 0.0, 0.0, 0.0, 0.0)).pixel_directions()[1]
    assert 0 < usable.sum() < 24
    for image in (tmp_path / "made" / "images" / "val").iterdir():
        Image.fromarray(np.where(usable[..., None], np.uint8(102), np.uint8(255)).repeat(3, -1)).save(image)
    pipeline = make_pipeline(tmp_path / "made", "val")
    pipeline.color_fit.fit()
    views = pipeline.datamanager.reference_views("val")
    assert views[0]["mask"][..., 0].tolist() == usable.tolist()
    # Pictures of half the size.
    small = type(views)(views._dataparser_outputs, scale_factor=0.5)
    assert small[0]["mask"].shape[:2] == small[0]["image"].shape[:2] == (2, 3)
    rays = views.cameras[0:1].generate_rays(0, keep_shape=False)
    shown = pipeline.model.eval()(rays)["rgb"].unflatten(0, (4, 6))[torch.from_numpy(usable)]
    torch.testing.assert_close(shown, torch.full_like(shown, 0.4), atol=0.02, rtol=0)


def test_without_reference_views_every_fitted_protocol_says_that_it_is_a_stretch(tmp_path: Path) -> None:
    pipeline = make_pipeline(tmp_path / "made", "test", num_views=0)
    # There is one test view, which the protocols for validation views may not use.
    for protocol, description in (
        ("affine", "percentile stretch, no validation views (protocol affine)"),
        ("translated-gamma", "percentile stretch, no validation views (protocol translated-gamma)"),
        ("network", "percentile stretch, no validation views (protocol network)"),
        ("affine-test", "affine-test, fitted on the 1 test views themselves"),
    ):
        replace_color_correction(pipeline.trained_run(), protocol)
        assert pipeline.model.color_correction.description == description


def test_reference_views_are_placed_by_the_poses_of_the_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline = make_pipeline(tmp_path / "made", "val", pose_correction="spline")
    seen: list[torch.Tensor] = []
    render = pipeline.model.render_rays

    def spy(rays: RayBundle, *names: str) -> list[torch.Tensor]:
        seen.append(rays.origins)
        return render(rays, *names)

    monkeypatch.setattr(pipeline.model, "render_rays", spy)
    pipeline.color_fit.fit()
    correction = pipeline.model.camera_optimizer
    with torch.no_grad():
        # The whole scene moves 0.5 along the camera's y axis.
        correction.twists.control_twists[:, 1] = 0.5 / correction.trajectory.extent
    pipeline.color_fit.fit()
    before, after = seen
    expected = correction.apply_to_camera(pipeline.datamanager.reference_views("val").cameras)[0, :, 3]
    torch.testing.assert_close(after, expected.expand_as(after))
    torch.testing.assert_close((after - before).norm(dim=-1), torch.full((64,), 0.5))


@pytest.mark.parametrize("psnr", [20.0, float("nan")])
def test_a_metric_that_is_not_a_number_is_named(psnr: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline = make_pipeline(tmp_path / "made", "test", num_views=0)
    # One test view, whose metrics have no standard deviation.
    monkeypatch.setattr(pipeline.model, "get_image_metrics_and_images", lambda *_: ({"psnr": psnr, "ssim": 0.5}, {}))
    if psnr == 20:
        metrics = pipeline.get_average_eval_image_metrics(get_std=True)
        assert metrics["psnr"] == 20
        assert "psnr_std" not in metrics
    else:
        with pytest.raises(SystemExit, match="psnr of the test views is not a number"):
            pipeline.get_average_eval_image_metrics(get_std=True)
