"""Events in the order of time, from the tables that training reads."""

from __future__ import annotations

import numpy as np
import pytest

from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.events.pairing import pair_events
from aenerf_ns.events.sorted_events import sort_events
from aenerf_ns.events.stream import EventStream
from aenerf_ns.events.timeline import EventTimeline, timeline_of_pairs, timeline_of_windows

WIDTH, HEIGHT, NUM_EVENTS = 5, 4, 3000


@pytest.fixture(scope="module")
def stream() -> EventStream:
    """Random events, some of them at one pixel and time."""
    generator = np.random.default_rng(0)
    return EventStream(
        generator.integers(WIDTH, size=NUM_EVENTS, dtype=np.uint16),
        generator.integers(HEIGHT, size=NUM_EVENTS, dtype=np.uint16),
        np.sort(generator.integers(20_000, size=NUM_EVENTS)) * 1000,
        generator.choice(np.array([-1, 1], np.int8), NUM_EVENTS),
        WIDTH,
        HEIGHT,
    )


def net(stream: EventStream) -> dict[tuple[int, int], int]:
    """The sum of polarities of each pixel and time."""
    sums: dict[tuple[int, int], int] = {}
    for x, y, t, p in zip(stream.x, stream.y, stream.t, stream.p, strict=True):
        key = int(t), int(y) * WIDTH + int(x)
        sums[key] = sums.get(key, 0) + int(p)
    return sums


def as_dictionary(timeline: EventTimeline) -> dict[tuple[int, int], int]:
    rows = zip(timeline.times.tolist(), timeline.pixels.tolist(), timeline.polarities.tolist(), strict=True)
    return {(time, pixel): polarity for time, pixel, polarity in rows}


def test_the_timeline_of_pairs_has_the_events_with_their_polarities(stream: EventStream) -> None:
    timeline = timeline_of_pairs(pair_events([stream]), most=NUM_EVENTS)
    assert (np.diff(timeline.times) >= 0).all()
    seen: set[int] = set()
    expected = {}
    for (time, pixel), polarity in net(stream).items():
        # The first of a pixel has no earlier event, and opposite events of one time cancel.
        if pixel in seen and polarity:
            expected[time, pixel] = int(np.sign(polarity))
        seen.add(pixel)
    assert as_dictionary(timeline) == expected


def test_a_long_recording_is_thinned_evenly(stream: EventStream) -> None:
    whole, thinned = (timeline_of_pairs(pair_events([stream]), most) for most in (NUM_EVENTS, 300))
    assert 200 < len(thinned) <= 300
    assert as_dictionary(thinned).items() <= as_dictionary(whole).items()
    counts = np.histogram(thinned.times, 4, (0, 20_000_000))[0]
    assert counts.min() > 40


def test_the_timeline_of_windows_has_every_event(stream: EventStream) -> None:
    usable = np.ones((HEIGHT, WIDTH), bool)
    windows = sort_events([stream], window=TimeWindow(0, 20_000_000), usable=usable)
    timeline = timeline_of_windows(windows, NUM_EVENTS)
    np.testing.assert_array_equal(timeline.times, stream.t)
    np.testing.assert_array_equal(timeline.polarities, stream.p)
    np.testing.assert_array_equal(timeline.pixels, stream.y.astype(int) * WIDTH + stream.x)
    assert len(timeline_of_windows(windows, 1000)) == 1000


def test_events_around_a_time_are_the_nearest_ones_before_and_after(stream: EventStream) -> None:
    timeline = timeline_of_pairs(pair_events([stream]), most=NUM_EVENTS)
    around = timeline.nearest(10_000_000, 100)
    assert len(around) == 100
    assert (around.times < 10_000_000).sum() == 50
    left_out = np.setdiff1d(timeline.times, around.times)
    assert not ((left_out > around.times[0]) & (left_out < around.times[-1])).any()
    assert around.thinned(7).times.tolist() == around.times[np.linspace(0, 99, 7).astype(int)].tolist()
    assert around.thinned(100) is around
