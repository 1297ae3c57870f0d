"""Counts of events between two times: exact at both ends, in no gap."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.streams import make_stream, random_stream

from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.errors import DataError
from aenerf_ns.events.sorted_events import sort_events
from aenerf_ns.events.stream import EventStream

EPOCH = 1_600_000_000_000_000_000
ALL = np.ones((3, 4), bool)


def brute_force(stream: EventStream, start: int, end: int, window: TimeWindow, usable: np.ndarray) -> np.ndarray:
    counts = np.zeros((2, 12), int)
    for x, y, t, p in zip(stream.x, stream.y, stream.t, stream.p, strict=True):
        if start < t <= end and window.contains(t) and usable[y, x]:
            counts[0 if p > 0 else 1, 4 * int(y) + x] += 1
    return counts


@pytest.mark.parametrize("gaps", [(), ((EPOCH + 300, EPOCH + 420), (EPOCH + 700, EPOCH + 701))])
def test_counts_are_those_of_brute_force_with_random_times_at_both_ends(gaps: tuple[tuple[int, int], ...]) -> None:
    rng = np.random.default_rng(0)
    window = TimeWindow(EPOCH + 50, EPOCH + 950, gaps)
    # Few different times, so that many events share a time, a pixel or both.
    stream = random_stream(400, 4, 3, 200)
    stream = replace(stream, t=EPOCH + 5 * stream.t)
    usable = rng.random((3, 4)) > 0.2
    events = sort_events((stream[i : i + 70] for i in range(0, 400, 70)), window=window, usable=usable)
    compared = 0
    for _ in range(300):
        # Half of the times are times of events.
        times = np.where(rng.random(2) < 0.5, rng.choice(stream.t, 2), EPOCH + rng.integers(40, 960, 2))
        start, end = map(int, np.sort(times))
        if any(first <= start and end <= last for first, last in window.pieces()):
            counts = events.counts(start, end)
            np.testing.assert_array_equal(counts, brute_force(stream, start, end, window, usable))
            compared += counts.any()
        else:
            with pytest.raises(ValueError, match="is not inside one of"):
                events.counts(start, end)
    assert compared > 50
    left_out = events.num_outside + events.num_unusable
    assert (~window.contains(stream.t)).sum() == events.num_outside > 0
    assert len(events.times) + left_out == 400
    assert f"400 events, {len(events.times)} of them are used" in events.summary()


def test_events_at_the_edges_of_a_gap_count_and_those_inside_do_not() -> None:
    stream = make_stream([(0, 0, t, 1) for t in (10, 20, 21, 39, 40, 50)])
    events = sort_events([stream], window=TimeWindow(0, 60, ((20, 40),)), usable=ALL)
    assert events.counts(0, 20)[0, 0] == 2
    # The event at 40 is at the start of its window, whose change begins after it.
    assert events.counts(40, 60)[0, 0] == 1
    for start, end in ((15, 45), (20, 10)):
        with pytest.raises(ValueError, match="is not inside"):
            events.counts(start, end)


def test_what_cannot_be_counted_is_refused_with_one_line() -> None:
    stream = make_stream([(0, 0, 10, 1)])
    with pytest.raises(DataError, match="none of its 1 events lies between 20 and 30 ns"):
        sort_events([stream], window=TimeWindow(20, 30), usable=ALL)
    with pytest.raises(DataError, match="4 x 3 pixels, its lens model 3 x 4; state one size"):
        sort_events([stream], window=TimeWindow(), usable=ALL.T)
