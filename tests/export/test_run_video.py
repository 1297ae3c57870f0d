"""Events between the frames of a video."""

import numpy as np
import pytest
from helpers.streams import EventsInMemory, random_stream

from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.export.video import RenderedEvents, sum_recorded_events


@pytest.mark.parametrize("size", [1, 7, 1000])
def test_sum_recorded_events(size: int) -> None:
    events = random_stream(200, 5, 4, 1000)
    # Before the first event, between events, at an event, and beyond the last.
    times = np.array([-50, 100, 101, int(events.t[120]), 900, 2000, 3000])
    pictures = list(sum_recorded_events(EventsInMemory(events, [size] * (200 // size)), times))
    assert len(pictures) == len(times) - 1
    for picture, first, last in zip(pictures, times[:-1], times[1:], strict=True):
        expected = np.zeros((4, 5), np.int64)
        chosen = (events.t >= first) & (events.t < last)
        np.add.at(expected, (events.y[chosen], events.x[chosen]), events.p[chosen])
        np.testing.assert_array_equal(picture, expected)


def test_trigger_events() -> None:
    sensor = SensorModel(positive_contrast_threshold=0.5, negative_contrast_threshold=0.25, bayer_pattern="RGGB")
    rendered = RenderedEvents(sensor, 2, 2)
    log_radiance = np.zeros((2, 2, 3))
    assert not rendered(log_radiance).any()
    # Red rises, green falls, blue stays. A pixel sees its own filter alone.
    log_radiance[..., 0], log_radiance[..., 1] = 1.2, -0.6
    np.testing.assert_array_equal(rendered(log_radiance), [[2, -2], [-2, 0]])
    # What is left of the change counts on: 0.2 and 0.3 more are one threshold.
    log_radiance[..., 0] = 1.5
    np.testing.assert_array_equal(rendered(log_radiance), [[1, 0], [0, 0]])
