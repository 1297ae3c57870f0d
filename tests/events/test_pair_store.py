"""The events of a table of pairs, in the order of time."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.streams import make_stream, random_stream

from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.events.pairing import pair_events
from aenerf_ns.events.sorted_events import sort_events
from aenerf_ns.events.stream import EventStream

WIDTH, HEIGHT = 5, 4


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


def test_nearest_events_and_subsample(stream: EventStream) -> None:
    around = stream.nearest(10_000, 100)
    assert len(around) == 100
    assert (around.t < 10_000).sum() == 50
    left_out = np.setdiff1d(stream.t, around.t)
    assert not ((left_out > around.t[0]) & (left_out < around.t[-1])).any()
    assert around.subsample(7).t.tolist() == around.t[np.linspace(0, 99, 7).astype(int)].tolist()
    assert around.subsample(100) is around
