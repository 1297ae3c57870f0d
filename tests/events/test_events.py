"""Event streams, pairing, the sensor model and event pictures."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest
from conftest import make_stream
from hypothesis import given, settings
from hypothesis import strategies as st

from aenerf_ns.errors import DataError
from aenerf_ns.events.pairs import EventPairs, PairsInTime, pair_events
from aenerf_ns.events.picture import polarity_picture
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.events.time_window import TimeWindow

WIDTH, HEIGHT = 4, 3
# Small ranges, so that pixels repeat and times coincide.
EVENTS = st.lists(
    st.tuples(st.integers(0, WIDTH - 1), st.integers(0, HEIGHT - 1), st.integers(0, 30), st.sampled_from([-1, 1])),
    min_size=1,
    max_size=120,
).map(lambda rows: sorted(rows, key=lambda row: row[2]))


def brute_force_pairs(rows: list[tuple[int, int, int, int]], refractory_period: int) -> set[tuple[int, ...]]:
    """(x, y, previous time, time, positives, negatives) of every pair, the slow and obvious way."""
    pairs = set()
    for pixel in {(x, y) for x, y, _, _ in rows}:
        here = [(t, p) for x, y, t, p in rows if (x, y) == pixel]
        times = sorted({t for t, _ in here})
        for previous, time in pairwise(times):
            if time - previous > refractory_period:
                polarities = [p for t, p in here if t == time]
                pairs.add((*pixel, previous, time, polarities.count(1), polarities.count(-1)))
    return pairs


def as_set(pairs: EventPairs) -> set[tuple[int, ...]]:
    columns = (pairs.x, pairs.y, pairs.previous_time, pairs.time, pairs.num_positive, pairs.num_negative)
    rows = list(zip(*(column.tolist() for column in columns), strict=True))
    assert len(set(rows)) == len(rows)
    return set(rows)


def cut(stream: EventStream, sizes: list[int]) -> Iterator[EventStream]:
    begin = 0
    for size in [*sizes, len(stream)]:
        yield stream[begin : begin + size]
        begin += size


@settings(max_examples=300, deadline=None)
@given(EVENTS, st.lists(st.integers(0, 20), max_size=6), st.integers(0, 5), st.integers(0, 10))
def test_pairs_are_those_of_brute_force_however_the_stream_is_cut(
    rows: list[tuple[int, int, int, int]], sizes: list[int], refractory_period: int, shortest: int
) -> None:
    pairs = pair_events(cut(make_stream(rows), sizes), refractory_period=refractory_period)
    assert as_set(pairs) == brute_force_pairs(rows, refractory_period)
    assert (np.diff(pairs.time) >= 0).all()
    # Every event is in a pair or accounted for.
    merged_in_pairs = pairs.num_positive.astype(int).sum() + pairs.num_negative.astype(int).sum() - len(pairs)
    assert pairs.num_events == len(rows)
    distinct = len({(x, y, t) for x, y, t, _ in rows})
    assert pairs.num_merged == len(rows) - distinct >= merged_in_pairs
    assert len(pairs) + pairs.num_first + pairs.num_within_refractory_period == distinct
    # The predecessor is the pair of the same pixel that ends where this one begins, if neither is too short.
    long = pairs.time - pairs.previous_time >= shortest
    ends = {(x, y, t): i for i, (x, y, t) in enumerate(zip(pairs.x, pairs.y, pairs.time, strict=True)) if long[i]}
    begins = zip(pairs.x, pairs.y, pairs.previous_time, strict=True)
    expected = [ends.get(begin, -1) if long[i] else -1 for i, begin in enumerate(begins)]
    assert pairs.predecessors(shortest).tolist() == expected


@settings(max_examples=200, deadline=None)
@given(EVENTS, st.integers(1, 3), st.integers(0, 2**32))
def test_moments_fall_into_the_intervals_laid_end_to_end(
    rows: list[tuple[int, int, int, int]], times: int, seed: int
) -> None:
    # Several blocks of pairs.
    last = max((t for _, _, t, _ in rows), default=0) + 1
    pairs = pair_events([make_stream([(x, y, t + i * last, p) for i in range(20 * times) for x, y, t, p in rows])])
    generator = np.random.default_rng(seed)
    usable = generator.random((3, 4)) < 0.7
    durations = np.where(usable[pairs.y, pairs.x], pairs.time - pairs.previous_time, 0)
    if durations.sum() == 0:
        return
    places = np.concatenate([generator.random(50), [0.0, 1 - 2.0**-53, 1.0]])
    ends = np.cumsum(durations)
    expected = np.searchsorted(ends, np.minimum(places * ends[-1], np.nextafter(float(ends[-1]), 0)), side="right")
    assert PairsInTime(pairs, usable).at(places).tolist() == expected.tolist()


def test_no_pair_spans_a_gap_however_the_stream_is_cut() -> None:
    rows = [(1, 2, t, 1) for t in (0, 10, 11, 15, 20, 20, 25, 40)]
    expected = [(0, 10), (20, 25), (25, 40)]
    for gaps in (((10, 20),), ((-9, -3), (10, 20), (50, 60))):
        for sizes in ([8], [1] * 8, [3, 5]):
            pairs = pair_events(cut(make_stream(rows), sizes), window=TimeWindow(gaps=gaps))
            assert list(zip(pairs.previous_time.tolist(), pairs.time.tolist(), strict=True)) == expected
            assert (pairs.num_outside, pairs.num_first, pairs.num_merged) == (2, 2, 1)
            assert pairs.predecessors().tolist() == [-1, -1, 1]
    # What a gap leaves of the time window.
    pairs = pair_events([make_stream(rows)], window=TimeWindow(10, 25, ((5, 11), (20, 30))))
    assert list(zip(pairs.previous_time.tolist(), pairs.time.tolist(), strict=True)) == [(11, 15), (15, 20)]


@given(EVENTS, st.integers(0, 30), st.integers(0, 30))
@settings(max_examples=100, deadline=None)
def test_events_outside_the_time_window_are_left_out_and_counted(
    rows: list[tuple[int, int, int, int]], start: int, end: int
) -> None:
    inside = [row for row in rows if start <= row[2] <= end]
    if not inside:
        with pytest.raises(DataError, match=f"none of its {len(rows)} events lies between {start} and {end} ns"):
            pair_events([make_stream(rows)], window=TimeWindow(start, end))
        return
    pairs = pair_events([make_stream(rows)], window=TimeWindow(start, end), expected_events=len(rows))
    assert as_set(pairs) == brute_force_pairs(inside, 0)
    assert pairs.num_outside == len(rows) - len(inside)


def test_pairing_large_times_is_exact() -> None:
    start = 1_600_000_000_000_000_000
    pairs = pair_events([make_stream([(1, 2, start, 1), (1, 2, start + 1, -1)])])
    assert as_set(pairs) == {(1, 2, start, start + 1, 0, 1)}


def test_more_merged_events_than_can_be_counted_are_refused() -> None:
    rows = [(0, 0, 1, 1)] + [(0, 0, 7, 1)] * 256
    with pytest.raises(DataError, match=r"pixel \(0, 0\) share the time 7 ns"):
        pair_events([make_stream(rows)])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"x": np.array([0, 4, 0], np.uint16)}, "event 1 has x = 4 on a sensor of width 4"),
        ({"y": np.array([0, 0, 3], np.uint16)}, "event 2 has y = 3 on a sensor of height 3"),
        ({"t": np.array([5, 4, 6], np.int64)}, "event 1 is at 4 ns, before the event ahead of it at 5 ns"),
        ({"p": np.array([1, 0, 1], np.int8)}, r"event 1 has polarity 0; .*2 \* p - 1"),
        ({"t": np.array([1.0, 2.0, 3.0])}, "column t has type float64 .*one row of int64"),
        ({"x": np.array([0, 1, 2], np.int64)}, "column x has type int64"),
        ({"p": np.array([1, 1], np.int8)}, "column p has 2 entries but column t has 3"),
    ],
)
def test_malformed_streams_are_refused(change: dict[str, np.ndarray], message: str) -> None:
    columns = {
        "x": np.array([0, 1, 2], np.uint16),
        "y": np.array([0, 1, 2], np.uint16),
        "t": np.array([1, 2, 3], np.int64),
        "p": np.array([1, -1, 1], np.int8),
    }
    EventStream(**columns, width=WIDTH, height=HEIGHT, source="good.h5")
    with pytest.raises(DataError, match=f"^bad.h5: .*{message}") as error:
        EventStream(**{**columns, **change}, width=WIDTH, height=HEIGHT, source="bad.h5")
    assert "\n" not in str(error.value)


def test_bayer_channels_follow_the_raw_pixel() -> None:
    sensor = SensorModel(bayer_pattern="RGGB")
    x, y = np.array([0, 1, 0, 1, 2, 3], np.uint16), np.array([0, 0, 1, 1, 2, 3], np.uint16)
    assert sensor.channel(x, y).tolist() == [0, 1, 1, 2, 0, 2]
    assert sensor.num_channels == 3
    assert SensorModel().channel(x, y).tolist() == [0] * 6


@pytest.mark.parametrize(
    "values", [(0.0, 0.25), (0.25, -1.0), (float("nan"), 0.25), (0.25, 0.25, -1), (0.25, 0.25, 0, "BGGR")]
)
def test_impossible_sensors_are_refused(values: tuple) -> None:
    with pytest.raises(ValueError, match="must"):
        SensorModel(*values)


def test_polarity_picture_shows_signs() -> None:
    picture = polarity_picture(np.array([0, 0, 1]), np.array([1, 1, 0]), np.array([1, 1, -1]), 2, 2).astype(int)
    positive, negative, neither = picture[1, 0], picture[0, 1], picture[0, 0]
    assert positive[0] > neither[0] > positive[2]
    assert negative[2] > neither[2] > negative[0]
    assert (picture[1, 1] == neither).all()
    assert (np.diff(neither) == 0).all()
