"""The drift of pixels tells how their thresholds differ, and nothing where they do not."""

from functools import cache

import numpy as np
import pytest
from helpers.streams import make_stream

from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.events.pair_store import EventPairs
from aenerf_ns.events.pairing import pair_events
from aenerf_ns.events.polarity_drift import polarity_drift
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.simulator.esim import EventSimulator
from aenerf_ns.simulator.options import SensorNoise

WIDTH, HEIGHT = 48, 36


@cache
def record(noise: SensorNoise, num_frames: int = 400) -> tuple[EventPairs, EventSimulator]:
    """A texture that moves on and on over the sensor, and ends elsewhere than it began."""
    simulator = EventSimulator(WIDTH, HEIGHT, SensorModel(), noise, seed=1)
    rng = np.random.default_rng(0)
    waves = rng.normal(0, 0.25, (12, 2))
    phases, strengths = rng.uniform(0, 6, 12), rng.uniform(0.1, 0.4, 12)
    y, x = np.indices((HEIGHT, WIDTH))
    parts = []
    for frame in range(num_frames):
        angles = waves[:, :1, None] * (x + 0.7 * frame) + waves[:, 1:, None] * (y + 0.3 * frame) + phases[:, None, None]
        radiance = 0.2 * np.exp((strengths[:, None, None] * np.sin(angles)).sum(0))
        parts.append(simulator(radiance, 10_000_000 * frame))
    return pair_events(parts), simulator


def true_drift(simulator: EventSimulator) -> np.ndarray:
    positive, negative = simulator.positive_contrast_threshold, simulator.negative_contrast_threshold
    return (negative - positive) / (positive + negative)


def correlation(drift: np.ndarray, truth: np.ndarray) -> float:
    return float(np.corrcoef(drift.ravel(), truth.ravel())[0, 1])


def test_thresholds_that_differ_are_found() -> None:
    pairs, simulator = record(SensorNoise(contrast_threshold_spread=0.03))
    truth, found = true_drift(simulator), polarity_drift(pairs)
    assert found.spread == pytest.approx(truth.std(), rel=0.1)
    assert correlation(found.drift, truth) > 0.9
    # The error is as large as it is said to be.
    assert found.picture()[np.unravel_index(truth.argmin(), truth.shape)] > 200
    assert (found.drift - truth).std() == pytest.approx(np.sqrt(found.variance.mean()), rel=0.5)


def test_nothing_is_found_where_thresholds_are_equal() -> None:
    pairs, _ = record(SensorNoise())
    found = polarity_drift(pairs)
    assert found.spread < 0.005
    assert np.abs(found.drift).max() < 0.005


def test_hot_pixels_neither_count_nor_keep_their_surplus() -> None:
    # Some fire either polarity at random, and one positive events only.
    pairs, simulator = record(SensorNoise(contrast_threshold_spread=0.03, hot_pixel_fraction=0.003, hot_pixel_rate=1e3))
    events = pairs.events()
    times = np.arange(1, 3001, dtype=np.int64) * 1_300_000
    hot = np.stack(np.broadcast_arrays(7, 5, times, 1), 1)
    rows = np.concatenate([np.stack([events.x, events.y, events.t, events.p], 1), hot])
    found = polarity_drift(pair_events([make_stream(rows[np.argsort(rows[:, 2], kind="stable")], WIDTH, HEIGHT)]))
    assert found.spread == pytest.approx(true_drift(simulator).std(), rel=0.1)
    assert found.drift[5, 7] > 0.9


def test_few_events_say_nothing() -> None:
    pairs, _ = record(SensorNoise(contrast_threshold_spread=0.03), num_frames=8)
    found = polarity_drift(pairs)
    assert found.spread == 0
    assert not found.drift.any()


def test_pixels_that_see_the_same_say_nothing() -> None:
    polarity = np.tile(np.repeat([1, -1], 5), 4)
    rows = [(x, y, 1000 * t, int(p)) for t, p in enumerate(polarity) for y in range(HEIGHT) for x in range(WIDTH)]
    found = polarity_drift(pair_events([make_stream(rows, WIDTH, HEIGHT)]))
    assert found.spread == 0
    assert not found.drift.any()
    assert not found.variance.any()


def test_gaps_are_no_surplus() -> None:
    pairs, simulator = record(SensorNoise(contrast_threshold_spread=0.03))
    gaps = tuple((begin * 10**8, (begin + 2) * 10**8) for begin in (7, 25))
    broken = pair_events([pairs.events()], window=TimeWindow(0, 4 * 10**9, gaps))
    assert broken.num_first > 2 * WIDTH * HEIGHT
    truth, found = true_drift(simulator), polarity_drift(broken)
    assert found.spread == pytest.approx(truth.std(), rel=0.1)
    assert correlation(found.drift, truth) > 0.9
