"""Event streams, pairing, the sensor model and event pictures."""

import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.streams import EventsInMemory, assert_same_pairs, make_stream, sorted_rows, unpacked
from hypothesis import given, settings
from hypothesis import strategies as st

from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.errors import DataError
from aenerf_ns.events.pair_store import event_counts, own_counts
from aenerf_ns.events.pairing import pair_events
from aenerf_ns.events.picture import polarity_picture
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.simulator.esim import EventSimulator
from aenerf_ns.supervision.pair_table import find_rows

WIDTH, HEIGHT = 4, 3
EPOCH = 1_600_000_000_000_000_000
EVENTS = sorted_rows(WIDTH, HEIGHT)


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


@settings(max_examples=300, deadline=None)
@given(
    EVENTS,
    st.lists(st.integers(0, 20), max_size=6),
    st.integers(0, 5),
    st.integers(1, 60),
    st.integers(0, 2**12 - 1),
    st.tuples(st.integers(0, 40), st.integers(40, 90)),
)
def test_pairs_are_those_of_brute_force_however_the_stream_is_cut(
    rows: list[tuple[int, int, int, int]],
    sizes: list[int],
    refractory_period: int,
    in_memory: int,
    unused: int,
    window: tuple[int, int],
) -> None:
    # In nanoseconds of Unix time.
    rows = [(x, y, EPOCH + 3 * t, p) for x, y, t, p in rows]
    start, end = (EPOCH + time for time in window)
    usable = (unused >> np.arange(WIDTH * HEIGHT) & 1 == 0).reshape(HEIGHT, WIDTH)
    inside = [row for row in rows if start <= row[2] <= end]
    used = [row for row in inside if usable[row[1], row[0]]]
    options = {"refractory_period": refractory_period, "usable": usable, "window": TimeWindow(start, end)}
    if not used:
        none_inside = f"none of its {len(rows)} events lies between {start} and {end} ns"
        with pytest.raises(DataError, match="no event lies on a pixel with a direction" if inside else none_inside):
            pair_events([make_stream(rows)], **options)
        return
    pairs = pair_events(EventsInMemory(make_stream(rows), sizes).read_chunks(), **options)
    found = unpacked(pairs)
    expected = brute_force_pairs(used, refractory_period)
    assert {pair[:6] for pair in found} == expected
    assert len(found) == len(expected)
    # By pixel, then by time.
    assert found == sorted(found, key=lambda pair: (pair[1], pair[0], pair[3]))
    # Every event is in a pair or accounted for.
    assert (pairs.num_events, pairs.num_outside) == (len(rows), len(rows) - len(inside))
    assert pairs.num_unusable == len(inside) - len(used)
    distinct = len({(x, y, t) for x, y, t, _ in used})
    assert pairs.num_merged == len(used) - distinct >= sum(pair[4] + pair[5] - 1 for pair in found)
    assert len(pairs) + pairs.num_first + pairs.num_within_refractory_period == distinct
    # A pair is joined with the pair that ends where it begins.
    reaches: dict[tuple[int, int, int], int] = {}
    for x, y, begin, end, _, _, reach in found:
        assert reach == 1 + reaches.get((x, y, begin), 0)
        reaches[x, y, end] = reach
    # The same in a file.
    with tempfile.TemporaryDirectory() as folder, (Path(folder) / "rows").open("w+b") as file:
        in_file = pair_events(
            EventsInMemory(make_stream(rows), sizes).read_chunks(),
            **options,
            open_file=lambda: (file, Path(folder)),
            events_in_memory=in_memory,
        )
        assert_same_pairs(in_file, pairs)


@settings(max_examples=200, deadline=None)
@given(EVENTS, st.integers(0, 2), st.integers(0, 2**32))
def test_pairs_are_found_by_place_and_by_number(
    rows: list[tuple[int, int, int, int]], refractory_period: int, seed: int
) -> None:
    # Several blocks of pairs.
    last = rows[-1][2] + 1
    pairs = pair_events(
        [make_stream([(x, y, t + i * last, p) for i in range(20) for x, y, t, p in rows])],
        refractory_period=refractory_period,
    )
    known = unpacked(pairs)
    if not known:
        return
    durations = np.cumsum([pair[3] - pair[2] for pair in known])
    generator = np.random.default_rng(seed)
    places = np.append(generator.integers(0, durations[-1], 50), [0, durations[-1] - 1])
    # Every pair once, from as many numbers.
    events = np.arange(len(pairs))
    spans = generator.integers(1, 12, len(places) + len(events))
    arguments = (pairs.rows, pairs.replacement_rows, pairs.block_ends, places, events, spans)
    found = find_rows(*map(torch.from_numpy, arguments)).numpy()
    ends = {(y * WIDTH + x, time): index for index, (x, y, _, time, *_) in enumerate(known)}
    drawn = []
    for first, last, span in zip(*found.T, spans.tolist(), strict=True):
        index = ends[int(pairs.rows[last, 1]) >> 40, int(pairs.rows[last, 0])]
        drawn.append(index)
        assert pairs.rows[last - 1, 0] == known[index][2]
        assert pairs.rows[first, 0] == known[index + 1 - min(span, known[index][6])][2]
    assert drawn[: len(places)] == np.searchsorted(durations, places, side="right").tolist()
    assert sorted(drawn[len(places) :]) == list(range(len(known)))


@pytest.mark.parametrize(("merged", "most"), [(31, 255), (255, 1)])
def test_a_pair_joins_255_events_at_most(merged: int, most: int) -> None:
    pairs = pair_events([make_stream([(1, 2, t, 1) for t in range(300) for _ in range(merged)])])
    found = unpacked(pairs)
    assert [pair[6] for pair in found] == [min(i + 1, most) for i in range(299)]
    assert {pair[4:6] for pair in found} == {(merged, 0)}
    later, earlier = pairs.rows[299, 1], pairs.rows[299 - most, 1]
    assert event_counts(later, earlier) == (merged * most, 0)


def test_what_a_blind_pixel_misses_is_counted() -> None:
    """Log-radiance that rises, then falls, steadily: between any two events it changed by as much as is counted."""
    sensor = SensorModel(refractory_period=2_000_000)
    simulator = EventSimulator(1, 1, sensor, log_epsilon=0.0)
    log_radiance = np.concatenate([np.linspace(-3, 3, 301), np.linspace(3, -3, 301)])
    parts = [simulator(np.exp([[value]]), 1_000_000 * i) for i, value in enumerate(log_radiance)]
    rows = pair_events(parts, refractory_period=2_000_000).rows
    num_events = sum(map(len, parts))
    assert num_events == 40
    for first in range(1, num_events - 3):
        for last in range(first + 1, num_events):
            own = own_counts(rows[last, 1], rows[last - 1, 1])
            positive, negative = np.array(own) + event_counts(rows[last - 1, 1], rows[first, 1])
            interval = rows[first, 0] + 2_000_000, rows[last, 0]
            begin, end = np.interp(interval, 1_000_000 * np.arange(602), log_radiance)
            # Rounding, and where the rise ends: what it rises after its last event has no event.
            turns = interval[0] < 300_000_000 < interval[1]
            assert 0.25 * (positive - negative) == pytest.approx(end - begin, abs=0.25 / 8 + 0.25 * turns)


@pytest.mark.parametrize(
    ("times", "missed"),
    [
        # Right after the blindness: at most 4 thresholds, less an eighth, because whole ones would pass for events.
        ((0, 1_001, 2_002, 3_003), (31 / 8, 0.0)),
        # A rate that would miss one whole threshold.
        ((0, 2_000, 4_000, 6_000), (7 / 8, 0.0)),
        # The middle of the blindness is nearer to the middle of the shorter interval: 1/9 and 1/3 thresholds a period.
        ((0, 10_000, 14_000, 24_000), ((4 / 9 + 10 / 3) / 14 // 0.125 / 8, 0.0)),
    ],
)
def test_a_blind_pixel_misses_what_the_rates_say(times: tuple[int, ...], missed: tuple[float, float]) -> None:
    rows = pair_events([make_stream([(0, 0, t, 1) for t in times])], refractory_period=1_000).rows
    counts = event_counts(rows[2, 1], rows[1, 1]), event_counts(rows[1, 1], 0)
    # The event itself, and what is missed after it.
    assert counts[1] == (1 + missed[0], missed[1])
    assert own_counts(rows[1, 1], 0) == own_counts(rows[2, 1], rows[1, 1]) == (1, 0)


def test_a_table_that_cannot_be_made_is_refused() -> None:
    with pytest.raises(DataError, match="its sensor has 4 x 3 pixels, its lens model 3 x 4; state one size"):
        pair_events([make_stream([(1, 2, 3, 1)])], usable=np.ones((4, 3), bool))
    # A sum of two intervals is negative in 64 bits, of three positive again.
    for pixels in ((0, 1), (0, 1, 2)):
        rows = [(x, 0, t, 1) for t in (-(2**62), 2**62 - 1) for x in pixels]
        with pytest.raises(DataError, match="its intervals add up to more than 292 years; check the unit of the times"):
            pair_events([make_stream(rows)])


def test_no_pair_spans_a_gap_however_the_stream_is_cut() -> None:
    rows = [(1, 2, t, 1) for t in (0, 10, 11, 15, 20, 20, 25, 40)]
    expected = [(0, 10), (20, 25), (25, 40)]
    for gaps in (((10, 20),), ((-9, -3), (10, 20), (50, 60))):
        for sizes in ([8], [1] * 8, [3, 5]):
            pairs = pair_events(EventsInMemory(make_stream(rows), sizes).read_chunks(), window=TimeWindow(gaps=gaps))
            assert [pair[2:4] for pair in unpacked(pairs)] == expected
            assert (pairs.num_outside, pairs.num_first, pairs.num_merged) == (2, 2, 1)
            assert [pair[6] for pair in unpacked(pairs)] == [1, 1, 2]
    # What a gap leaves of the time window.
    pairs = pair_events([make_stream(rows)], window=TimeWindow(10, 25, ((5, 11), (20, 30))))
    assert [pair[2:4] for pair in unpacked(pairs)] == [(11, 15), (15, 20)]


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
    with pytest.raises(DataError, match=f"^bad.h5: .*{message}"):
        EventStream(**{**columns, **change}, width=WIDTH, height=HEIGHT, source="bad.h5")


def test_polarity_picture_shows_signs() -> None:
    picture = polarity_picture(make_stream([(0, 1, 0, 1), (0, 1, 1, 1), (1, 0, 2, -1)], 2, 2)).astype(int)
    positive, negative, neither = picture[1, 0], picture[0, 1], picture[0, 0]
    assert positive[0] > neither[0] > positive[2]
    assert negative[2] > neither[2] > negative[0]
    assert (picture[1, 1] == neither).all()
    assert (np.diff(neither) == 0).all()
