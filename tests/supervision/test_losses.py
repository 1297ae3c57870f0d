"""Loss values, image metrics and image encodings on cases worked out by hand."""

import math
from collections.abc import Callable

import pytest
import torch
from torchvision.models import alexnet

from aenerf_ns.camera.image_encoding import decode, encode, to_channels
from aenerf_ns.errors import DataError
from aenerf_ns.method.image_metrics import ImageMetrics
from aenerf_ns.supervision.losses import temporal_loss


def test_temporal_loss_by_hand() -> None:
    rate, change = torch.tensor([30.0, -10.0, 5.0]), torch.tensor([0.2, -0.5, 0.0])
    interval = torch.tensor([0.01, 0.1, 0.3])
    # G_gt is 20 and -5; the third pair's events cancel.
    assert temporal_loss(rate, change, interval).item() == pytest.approx((10 / 20 + 5 / 5) / 2)
    loss = temporal_loss(torch.zeros(2), torch.tensor([0.3, -0.3]), torch.tensor([1e-9, 1.0]))
    assert loss.item() == pytest.approx(1)
    assert temporal_loss(torch.zeros(1), torch.zeros(1), torch.ones(1)).item() == 0


def test_srgb_encoding_has_the_standards_values_and_inverts() -> None:
    radiance = torch.tensor([0.0, 0.0031308, 0.18, 1.0], dtype=torch.float64)
    expected = torch.tensor([0.0, 0.04045, 0.461356, 1.0], dtype=torch.float64)
    torch.testing.assert_close(encode(radiance, "srgb"), expected, atol=2e-6, rtol=0)
    torch.testing.assert_close(decode(encode(radiance, "srgb"), "srgb"), radiance, atol=1e-9, rtol=0)
    assert torch.equal(encode(torch.tensor([-1.0, 0.5, 2.0]), "linear"), torch.tensor([0.0, 0.5, 1.0]))


def test_a_monochrome_sensor_sees_luminance() -> None:
    colors = torch.tensor([[1.0, 1.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    torch.testing.assert_close(to_channels(colors, 1)[:, 0], torch.tensor([1.0, 0.2126, 0.7152]))
    assert torch.equal(to_channels(colors, 3), colors)


def test_psnr_by_hand_and_lpips_is_absent_unless_asked_for() -> None:
    reference = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0)) * 0.5
    metrics = ImageMetrics(with_lpips=False)
    values = metrics(reference + 0.1, reference)
    assert values["psnr"] == pytest.approx(-20 * math.log10(0.1), abs=1e-3)
    assert 0 < values["ssim"] < 1
    assert metrics(reference, reference)["psnr"] == 100
    # Pixels outside the mask change nothing.
    mask = torch.arange(16).expand(16, 16)[..., None] < 13
    masked = metrics(torch.where(mask, reference + 0.1, -5.0), reference, mask)
    assert masked["psnr"] == pytest.approx(values["psnr"])
    assert masked["ssim"] == pytest.approx(values["ssim"], abs=0.1)
    # A rendering that is not finite is no good one.
    assert math.isnan(metrics(reference * torch.nan, reference)["psnr"])
    assert "lpips" not in values
    assert metrics.lpips_absent is not None
    assert "ssim" in metrics(reference[:6, :6], reference[:6, :6])
    with pytest.raises(DataError, match="images of 16 x 5 pixels; give 6 or more, which SSIM needs"):
        metrics(reference[:5], reference[:5])


def replace_downloads(monkeypatch: pytest.MonkeyPatch, download: Callable[..., object]) -> None:
    monkeypatch.setattr("torch.hub.load_state_dict_from_url", download)
    monkeypatch.setattr("torchvision._internally_replaced_utils.load_state_dict_from_url", download, raising=False)
    monkeypatch.setattr("torchvision.models._api.load_state_dict_from_url", download, raising=False)


def test_lpips_without_weights_is_absent_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_connection(*_: object, **__: object) -> None:
        raise OSError("no connection")

    replace_downloads(monkeypatch, no_connection)
    image = torch.rand(64, 64, 3)
    metrics = ImageMetrics(with_lpips=True)
    before = torch.get_rng_state()
    values = metrics(image, image)
    # Else what a training draws after its first evaluation would depend on the connection.
    assert torch.equal(torch.get_rng_state(), before)
    assert "lpips" not in values
    assert "no connection" in str(metrics.lpips_absent)


def test_lpips_with_weights_leaves_the_random_numbers_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    replace_downloads(monkeypatch, lambda *_, **__: alexnet().state_dict())
    image = torch.rand(64, 64, 3)
    before = torch.get_rng_state()
    values = ImageMetrics(with_lpips=True)(image, image)
    assert torch.equal(torch.get_rng_state(), before)
    assert values["lpips"] == pytest.approx(0)
