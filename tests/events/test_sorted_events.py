"""The events of a table of pairs and of a stream, in the order of time, and their counts between two times."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.streams import make_stream, random_stream

from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.errors import DataError
from aenerf_ns.events.pairing import pair_events
from aenerf_ns.events.sorted_events import sort_events
from aenerf_ns.events.stream import EventStream

WIDTH, HEIGHT = 5, 4
EPOCH = 1_600_000_000_000_000_000
ALL = np.ones((3, 4), bool)


@pytest.fixture(scope="module")
def stream() -> EventStream:
    """Random events, some of them at one pixel and time."""
    return random_stream(3000, WIDTH, HEIGHT, 20_000)


def as_rows(stream: EventStream) -> list[tuple[int, int, int, int]]:
    """(t, x, y, p) of every event."""
    return list(zip(stream.t.tolist(), stream.x.tolist(), stream.y.tolist(), stream.p.tolist(), strict=True))


def test_events_of_pairs_are_those_of_the_stream(stream: EventStream) -> None:
    sums: dict[tuple[int, int, int], int] = {}
    for t, x, y, p in as_rows(stream):
        sums[t, x, y] = sums.get((t, x, y), 0) + p
    seen, expected = set(), set()
    for (t, x, y), polarity in sums.items():
        # The first of a pixel has no earlier event, and opposite events of one time cancel.
        if (x, y) in seen and polarity:
            expected.add((t, x, y, int(np.sign(polarity))))
        seen.add((x, y))
    # A stream is in the order of time.
    assert set(as_rows(pair_events([stream]).events())) == expected


def test_events_of_some_rows() -> None:
    rows = [
        (0, 0, 1, 1), (1, 0, 2, -1), (0, 0, 3, -1), (3, 2, 4, 1), (1, 0, 5, 1), (1, 0, 5, 1), (0, 0, 6, 1), (3, 2, 7, 1)
    ]  # fmt: skip
    pairs = pair_events([make_stream(rows)])
    # Without the first of each pixel, and events of one pixel and time once.
    assert as_rows(pairs.events()) == [(3, 0, 0, -1), (5, 1, 0, 1), (6, 0, 0, 1), (7, 3, 2, 1)]
    assert as_rows(pairs.events(slice(2, 5))) == [(5, 1, 0, 1), (6, 0, 0, 1)]


def test_every_nth_row_is_an_even_sample(stream: EventStream) -> None:
    pairs = pair_events([stream])
    sample = pairs.events(slice(None, None, 10))
    assert 200 < len(sample) <= 300
    assert set(as_rows(sample)) <= set(as_rows(pairs.events()))
    assert np.histogram(sample.t, 4, (0, 20_000))[0].min() > 40


def test_sorted_events_are_those_of_the_stream(stream: EventStream) -> None:
    found = sort_events([stream], window=TimeWindow(0, 20_000), usable=np.ones((HEIGHT, WIDTH), bool))
    assert as_rows(found.events()) == as_rows(stream)
    assert as_rows(found.events(slice(None, None, 3))) == as_rows(stream)[::3]


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
    known = np.append(stream.t, np.tile(window.pieces(), (9, 1)))
    compared = 0
    for _ in range(600):
        # Half of the times are times of events, or edges of the window and of gaps.
        times = np.where(rng.random(2) < 0.5, rng.choice(known, 2), EPOCH + rng.integers(40, 960, 2))
        start, end = times.tolist()
        if any(first <= start <= end <= last for first, last in window.pieces()):
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


def test_what_cannot_be_counted_is_refused_with_one_line() -> None:
    stream = make_stream([(0, 0, 10, 1)])
    with pytest.raises(DataError, match="none of its 1 events lies between 20 and 30 ns"):
        sort_events([stream], window=TimeWindow(20, 30), usable=ALL)
    with pytest.raises(DataError, match="4 x 3 pixels, its lens model 3 x 4; state one size"):
        sort_events([stream], window=TimeWindow(), usable=ALL.T)
