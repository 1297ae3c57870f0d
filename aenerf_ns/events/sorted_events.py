"""Events in the order of time, counted pixel by pixel between two times."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventStream


@dataclass(frozen=True)
class SortedEvents:
    """Events in the order of time, 12 bytes each.

    Every event counts: a pixel's first event, events within the refractory period, and each of several events of a
    pixel at one time. Pairs of events lack some of them, so windows cannot be counted from pairs.

    Attributes:
        times: (N,) int64 nanoseconds, never decreasing.
        codes: (N,) uint32, twice the number of the event's pixel, counted row by row, plus one for a negative event.
        width, height: size of the sensor in pixels.
        pieces: first and last time of each stretch in which the poses are known, in nanoseconds.
        num_outside: events left out, outside the time window or in a gap.
        num_unusable: events left out, at pixels that are not used.
    """

    times: NDArray[np.int64]
    codes: NDArray[np.uint32]
    width: int
    height: int
    pieces: tuple[tuple[int, int], ...]
    num_outside: int
    num_unusable: int

    def counts(self, start: int, end: int) -> NDArray[np.int64]:
        """Count the events of every pixel **after** ``start`` **up to and including** ``end``.

        Windows that share an end and a start share no event and miss none.

        Args:
            start, end: nanoseconds.

        Returns:
            (2, pixels) numbers of positive and of negative events.

        Raises:
            ValueError: the window ends before it starts, leaves the time window or crosses a gap.
        """
        if not any(first <= start <= end <= last for first, last in self.pieces):
            raise ValueError(f"({start}, {end}] ns is not inside one of {self.pieces}")
        begin, stop = np.searchsorted(self.times, [start, end], side="right")
        return np.bincount(self.codes[begin:stop], minlength=2 * self.width * self.height).reshape(-1, 2).T

    def events(self, part: slice = slice(None)) -> EventStream:
        """Return the events of a slice, in the order of time."""
        codes = self.codes[part]
        return EventStream.at_pixels(codes >> 1, self.times[part], codes & 1 == 0, self.width, self.height)

    def summary(self) -> str:
        """Return one line that accounts for every event of the stream."""
        total = len(self.times) + self.num_outside + self.num_unusable
        return (
            f"{total:,} events, {len(self.times):,} of them are used; left out: {self.num_outside:,} outside the time "
            f"window or the poses, {self.num_unusable:,} at pixels without a direction"
        )


def sort_events(chunks: Iterable[EventStream], *, window: TimeWindow, usable: NDArray[np.bool_]) -> SortedEvents:
    """Keep the events of a stream for counting, in memory.

    Args:
        chunks: the stream in pieces, in the order of time, all of one sensor.
        window: events outside the window or in a gap are left out.
        usable: (height, width) whether the events of a pixel are used.

    Raises:
        DataError: the sensor and ``usable`` differ in size, or no event is left.
    """
    height, width = usable.shape
    used = usable.ravel()
    times, codes = [np.zeros(0, np.int64)], [np.zeros(0, np.uint32)]
    total = inside = 0
    source: str | Path = "events"
    for chunk in chunks:
        source = chunk.source
        chunk.require_size_of(usable)
        total += len(chunk)
        kept = window.contains(chunk.t)
        inside += int(kept.sum())
        pixel = chunk.y.astype(np.uint32) * np.uint32(width) + chunk.x
        kept &= used[pixel]
        times.append(chunk.t[kept])
        codes.append((2 * pixel[kept] + (chunk.p[kept] < 0)).astype(np.uint32))
    found = SortedEvents(
        times=np.concatenate(times),
        codes=np.concatenate(codes),
        width=width,
        height=height,
        pieces=tuple(window.pieces()),
        num_outside=total - inside,
        num_unusable=inside - sum(map(len, times)),
    )
    if len(found.times) == 0:
        raise DataError(
            source,
            f"none of its {total} events lies between {window.start} and {window.end} ns, the span of the poses and "
            "the time window, at a pixel that is used",
            "check that events and poses share one clock and one unit of time",
        )
    return found
