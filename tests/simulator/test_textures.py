"""Procedural textures."""

import numpy as np
import pytest

from aenerf_ns.simulator import textures as tx


@pytest.mark.parametrize("exponent", [0.8, 1.5])
def test_spectral_noise_has_its_spectrum(exponent: float) -> None:
    noise = tx.spectral_noise(128, np.random.default_rng(0), exponent)
    assert abs(noise.mean()) < 1e-12
    assert abs(noise.std() - 1) < 1e-12
    frequency = np.fft.fftfreq(128) * 128
    radius = np.hypot(frequency[:, None], frequency[None, :])
    power = np.abs(np.fft.fft2(noise)) ** 2
    rings = np.array([2, 4, 8, 16, 32])
    ring_power = [power[(radius >= r) & (radius < 2 * r)].mean() for r in rings]
    slope = np.polyfit(np.log(rings), np.log(ring_power), 1)[0]
    assert abs(slope + 2 * exponent) < 0.25


def test_linear_color_is_srgb() -> None:
    np.testing.assert_allclose(tx.linear_color("00bcff"), [0, 0.502886, 1], atol=1e-6)
