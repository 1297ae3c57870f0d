"""The filter that runs forwards and backwards."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from helpers.streams import make_stream, random_stream

from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.reconstruction.batches import batches_of
from aenerf_ns.reconstruction.two_sided import log_intensities

WIDTH, HEIGHT, BATCH = 12, 10, 60
SENSOR = SensorModel(0.2, 0.2)


@pytest.fixture
def events() -> EventStream:
    """100 batches of random events, of polarities that differ from region to region."""
    count = 100 * BATCH
    events = random_stream(count, WIDTH, HEIGHT, count)
    polarity = np.where(np.random.default_rng(1).random(count) < events.x / WIDTH, 1, -1).astype(np.int8)
    return replace(events, t=np.arange(count), p=polarity)


def states_of(events: EventStream) -> Iterator[tuple[int, np.ndarray]]:
    return log_intensities(batches_of([events], BATCH), SENSOR, 0.12)


def test_states_are_sums_of_exponentials() -> None:
    rows = [(2, 1, 0, 1), (3, 1, 1, 1), (2, 1, 2, -1), (2, 1, 3, 1)]
    ((_, state),) = log_intensities(batches_of([make_stream(rows, 4, 3)], 4), SensorModel(0.3, 0.2), 0.12)
    # A twelfth of an event per pixel goes by from one event to the next.
    kept = np.exp(-0.12 / 12 * np.arange(5))
    assert state[1, 2] == pytest.approx(0.3 * kept[4] - 0.2 * kept[2] + 0.3 * kept[1], abs=1e-6)
    assert state[1, 3] == pytest.approx(0.3 * kept[3], abs=1e-6)
    assert np.count_nonzero(state) == 2


def test_what_a_blind_pixel_misses_is_added() -> None:
    # Single events of one polarity, 10, 30 and 11 ns apart, and one of the other.
    rows = [(0, 0, t, 1) for t in (0, 10, 40, 51)] + [(0, 0, 81, -1)]
    reversed_rows = [(x, y, 81 - t, -p) for x, y, t, p in reversed(rows)]
    sensor, seen = SensorModel(0.3, 0.2, refractory_period=10), 4 + 10 / (30 - 10) + 7 / 8
    for stream, expected in ((rows, 0.3 * seen - 0.2), (reversed_rows, 0.3 - 0.2 * seen)):
        ((_, state),) = log_intensities(batches_of([make_stream(stream, 1, 1)], 5), sensor, 1e-6)
        assert state[0, 0] == pytest.approx(expected, rel=1e-4)


def test_both_directions_of_time_count_alike(events: EventStream) -> None:
    last = int(events.t[-1])
    reversed_events = EventStream(
        events.x[::-1].copy(), events.y[::-1].copy(), last - events.t[::-1], -events.p[::-1], WIDTH, HEIGHT
    )
    images, mirrored = ([image for _, image in states_of(stream)] for stream in (events, reversed_events))
    # The last image of each is of one direction only. Images that wait for less than all that follows differ a little.
    for k in range(99):
        assert np.abs(images[k] - mirrored[98 - k]).max() < 0.03 * np.ptp(images[k]), k
