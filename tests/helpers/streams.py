"""Small event streams, a file that holds one, and how many examples random tests draw."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from hypothesis import strategies as st
from numpy.typing import ArrayLike

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
