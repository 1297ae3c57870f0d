"""Small event streams, a file that holds one, the pairs of a table, and how many examples random tests draw."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from aenerf_ns.events.pair_store import EventPairs
from aenerf_ns.events.stream import EventStream
from aenerf_ns.files.event_reader import EventFile

FUZZ_EXAMPLES = int(os.environ.get("AENERF_FUZZ_EXAMPLES", "60"))
"""Examples of each test that feeds readers with damaged and random input; many more when they are set to."""


def make_stream(rows: ArrayLike, width: int = 4, height: int = 3) -> EventStream:
    """A stream of (x, y, t, p) rows."""
    x, y, t, p = np.array(rows, dtype=np.int64).reshape(-1, 4).T
    return EventStream(
        x.astype(np.uint16), y.astype(np.uint16), t.astype(np.int64), p.astype(np.int8), width, height, "made"
    )


def random_stream(count: int, width: int, height: int, end: int, start: int = 0, seed: int = 0) -> EventStream:
    """Events at random pixels, of random polarities, at random times from ``start`` on and before ``end``."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(start, end, count))
    x, y = rng.integers(0, width, count).astype(np.uint16), rng.integers(0, height, count).astype(np.uint16)
    return EventStream(x, y, t, rng.choice(np.array([-1, 1], np.int8), count), width, height, "made")


def sorted_rows(width: int, height: int) -> st.SearchStrategy[list[tuple[int, int, int, int]]]:
    """Draw rows (x, y, t, p) in order, from small ranges, so that pixels repeat and times coincide."""
    row = st.tuples(st.integers(0, width - 1), st.integers(0, height - 1), st.integers(0, 30), st.sampled_from([-1, 1]))
    return st.lists(row, min_size=1, max_size=120).map(lambda rows: sorted(rows, key=lambda row: row[2]))


class EventsInMemory(EventFile):
    """Stands for a file. Its events come in pieces of the given sizes, and the others in a last one."""

    def __init__(self, events: EventStream, sizes: Sequence[int] = ()) -> None:
        super().__init__(Path("made"), events.width, events.height)
        self._events, self._sizes = events, sizes

    def read_chunks(self) -> Iterator[EventStream]:
        begin = 0
        for size in [*self._sizes, len(self._events)]:
            yield self._events[begin : begin + size]
            begin += size

    def require(self) -> None:
        pass


def assert_same_pairs(first: EventPairs, second: EventPairs) -> None:
    for field in fields(EventPairs):
        assert np.array_equal(getattr(first, field.name), getattr(second, field.name)), field.name


def unpacked(pairs: EventPairs) -> list[tuple[int, ...]]:
    """(x, y, previous time, time, positives, negatives, reach) of every pair, in the order of the rows."""
    assert len(pairs.rows) % 16 == 0
    found, positive, negative, heads = [], 0, 0, 0
    for row, (time, number) in enumerate(pairs.rows.tolist()):
        pixel, reach, low = number >> 40, number >> 32 & 255, number & 0xFFFFFFFF
        if reach:
            # In eighths of an event, with what the pixel is blind to after it: no whole number of events.
            sums = (low - positive) & 0xFFFF, ((low >> 16) - negative) & 0xFFFF
            counts = tuple(int(other == 0) if own % 8 else own // 8 for own, other in (sums, sums[::-1]))
            positive, negative = low & 0xFFFF, low >> 16
            place = (pixel % pairs.width, pixel // pairs.width)
            found.append((*place, int(pairs.rows[row - 1, 0]), time, *counts, reach))
        else:
            positive = negative = 0
            if (time, number) != (0, 0) or row == 0:
                assert low == heads
                heads += 1
    assert len(found) == len(pairs)
    return found
