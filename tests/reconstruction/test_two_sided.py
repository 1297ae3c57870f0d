"""Images of events by the filter that runs forwards and backwards."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from helpers.streams import make_stream

from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.reconstruction.batches import batches_of
from aenerf_ns.reconstruction.two_sided import two_sided_images

WIDTH, HEIGHT, BATCH = 12, 10, 60
SENSOR = SensorModel(0.2, 0.2)


@pytest.fixture
def events() -> EventStream:
    """100 batches of random events, of polarities that differ from region to region."""
    generator = np.random.default_rng(0)
    count = 100 * BATCH
    x, y = generator.integers(0, WIDTH, count), generator.integers(0, HEIGHT, count)
    polarity = np.where(generator.random(count) < x / WIDTH, 1, -1)
    return make_stream(list(zip(x, y, np.arange(count), polarity, strict=True)), WIDTH, HEIGHT)


def images_of(events: EventStream) -> Iterator[tuple[int, np.ndarray]]:
    return two_sided_images(batches_of([events], BATCH), SENSOR)


def test_an_image_of_each_batch(events: EventStream) -> None:
    times, images = zip(*images_of(events), strict=True)
    # A tenth of an event per pixel ahead of the end of the batch.
    assert list(times) == [BATCH * (k + 1) - 1 - WIDTH * HEIGHT // 10 for k in range(100)]
    assert {(image.shape, image.dtype.name) for image in images} == {((HEIGHT, WIDTH), "uint8")}
    assert {(image.min(), image.max()) for image in images} == {(0, 255)}


def test_both_directions_of_time_count_alike(events: EventStream) -> None:
    last = int(events.t[-1])
    reversed_events = EventStream(
        events.x[::-1].copy(), events.y[::-1].copy(), last - events.t[::-1], -events.p[::-1], WIDTH, HEIGHT
    )
    images, mirrored = ([image for _, image in images_of(stream)] for stream in (events, reversed_events))
    # The last image of each is of one direction only. Images that wait for less than all that follows differ a little.
    for k in range(99):
        assert np.abs(images[k].astype(int) - mirrored[98 - k].astype(int)).max() <= 8, k


def test_a_change_shows_before_and_after_it() -> None:
    # Noise everywhere, and one pixel that gets much brighter in the middle.
    generator = np.random.default_rng(1)
    rows = [(generator.integers(WIDTH), generator.integers(HEIGHT), time, 1 - 2 * (time % 2)) for time in range(1200)]
    rows[600:620] = [(4, 5, time, 1) for time in range(600, 620)]
    images = [image for _, image in images_of(make_stream(rows, WIDTH, HEIGHT))]
    # Images 9 and 10 end before and after the events of the pixel.
    assert images[9][5, 4] == 0
    assert images[10][5, 4] == 255
