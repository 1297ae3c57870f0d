"""Statistics of a stream of events."""

from itertools import pairwise

import numpy as np
import pytest
from helpers.streams import make_stream, random_stream

from aenerf_ns.events.statistics import event_statistics


def test_statistics_are_those_of_brute_force_however_the_stream_is_cut() -> None:
    events = random_stream(400, 5, 4, 200, start=10)
    rows = list(zip(*(getattr(events, name).tolist() for name in "xytp"), strict=True))
    counts = np.zeros((4, 5), int)
    np.add.at(counts, (events.y, events.x), 1)
    previous: dict[tuple[int, int], int] = {}
    pairs, repeated = [], 0
    for x, y, time, _ in rows:
        if previous.get((x, y)) == time:
            repeated += 1
        elif (x, y) in previous:
            pairs.append([previous[x, y], time])
        previous[x, y] = time
    for cuts in ([], [1, 7, 100]):
        edges = [0, *cuts, 400]
        chunks = (events[a:b] for a, b in pairwise(edges))
        found = event_statistics(chunks, 5, 4, (rows[0][2], rows[-1][2]), 6)
        np.testing.assert_array_equal(found.counts, counts)
        assert (found.num_events, found.num_repeated) == (400, repeated)
        assert found.num_positive == sum(row[3] > 0 for row in rows)
        assert found.pair_times.tolist() == pairs
        assert found.rate.sum() == 400


def test_the_sample_of_pairs_is_even_and_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aenerf_ns.events.statistics._MAX_PAIRS", 8)
    n = 1000
    events = make_stream([(0, 0, t, 1) for t in range(n)], 1, 1)
    found = event_statistics([events[:300], events[300:]], 1, 1, (0, n - 1), 4)
    steps = np.diff(found.pair_times[:, 0])
    assert 8 <= len(found.pair_times) <= 16
    assert len(set(steps.tolist())) == 1
    np.testing.assert_array_equal(found.pair_times[:, 1] - found.pair_times[:, 0], 1)
    assert found.rate.tolist() == [250] * 4
