"""The bound of the noise, against simulated noise."""

import numpy as np
import pytest

from aenerf_ns.checking.noise import NoiseRate
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.simulator.esim import EventSimulator
from aenerf_ns.simulator.options import SensorNoise

WIDTH, HEIGHT = 60, 40


def noise_rate(noise: SensorNoise) -> float | None:
    """Let a sensor see an edge that crosses a dark field once in 0.6 s, for 6 s; the first pixel is hot."""
    simulator, rate = EventSimulator(WIDTH, HEIGHT, SensorModel(), noise), NoiseRate(WIDTH, HEIGHT)
    columns = np.broadcast_to(np.arange(WIDTH), (HEIGHT, WIDTH))
    for index in range(601):
        image = 0.02 + 0.1 * (columns < index % WIDTH)
        rate.add(simulator(image, 10_000_000 * index))
    is_hot = np.zeros((HEIGHT, WIDTH), bool)
    is_hot[0, 0] = True
    return rate.rate(is_hot)


@pytest.mark.parametrize("rate", [0.0, 0.5, 5.0])
def test_edges_are_no_noise(rate: float) -> None:
    found = noise_rate(SensorNoise(shot_noise_rate=rate))
    # The light of the field leaves nearly all of the noise.
    assert found == pytest.approx(rate, rel=0.15, abs=0.02)


def test_neighbors_that_are_never_quiet_give_no_rate() -> None:
    assert noise_rate(SensorNoise(shot_noise_rate=200.0)) is None
    assert NoiseRate(WIDTH, HEIGHT).rate(np.zeros((HEIGHT, WIDTH), bool)) is None
