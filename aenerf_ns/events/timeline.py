"""Some events of a recording in the order of time, to find those around a moment quickly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.events.pair_store import COUNT_MASK, NEGATIVE_SHIFT, PIXEL_SHIFT, REACH_MASK, REACH_SHIFT, EventPairs
from aenerf_ns.events.sorted_events import SortedEvents


@dataclass(frozen=True)
class EventTimeline:
    """Events in the order of time. If a recording has too many, they are every n-th one.

    Attributes:
        times: (N,) int64 nanoseconds, never decreasing.
        pixels: (N,) int32 numbers of pixels, row * width + column.
        polarities: (N,) int8, +1 where positive events prevail at the pixel and time, −1 where negative ones do.
    """

    times: NDArray[np.int64]
    pixels: NDArray[np.int32]
    polarities: NDArray[np.int8]

    def __len__(self) -> int:
        return len(self.times)

    def nearest(self, time: int, count: int) -> EventTimeline:
        """Return about ``count`` events around a time in nanoseconds, half of them before it.

        Example:
            >>> timeline = EventTimeline(np.arange(0, 100, 10), np.zeros(10, np.int32), np.ones(10, np.int8))
            >>> timeline.nearest(45, 4).times.tolist()
            [30, 40, 50, 60]
            >>> timeline.nearest(0, 4).times.tolist()
            [0, 10]
        """
        middle = int(np.searchsorted(self.times, time))
        return self._part(slice(max(middle - count // 2, 0), middle + count // 2))

    def thinned(self, count: int) -> EventTimeline:
        """Return at most ``count`` of the events, evenly spread over them."""
        if len(self) <= count:
            return self
        return self._part(np.linspace(0, len(self) - 1, count).astype(np.int64))

    def _part(self, index: slice | NDArray[np.int64]) -> EventTimeline:
        return EventTimeline(self.times[index], self.pixels[index], self.polarities[index])


def timeline_of_pairs(pairs: EventPairs, most: int) -> EventTimeline:
    """Return the later events of pairs. The table has no polarity of an event without an earlier one.

    Args:
        pairs: the table.
        most: the most rows that are read.
    """
    step = max(-(-len(pairs.rows) // most), 1)
    # The sums of an event begin at the row before it.
    later = np.arange(1, len(pairs.rows), step)
    times, numbers = pairs.rows[later].T
    earlier = pairs.rows[later - 1, 1]
    # A head has its number in place of the sums, which are 0.
    earlier = np.where(earlier >> REACH_SHIFT & REACH_MASK, earlier, 0)
    positive = (numbers - earlier) & COUNT_MASK
    negative = ((numbers >> NEGATIVE_SHIFT) - (earlier >> NEGATIVE_SHIFT)) & COUNT_MASK
    polarities = np.sign(positive - negative).astype(np.int8)
    # Rows that only fill the last block have no reach either.
    kept = (numbers >> REACH_SHIFT & REACH_MASK > 0) & (polarities != 0)
    order = np.flatnonzero(kept)[np.argsort(times[kept], kind="stable")]
    return EventTimeline(times[order], (numbers[order] >> PIXEL_SHIFT).astype(np.int32), polarities[order])


def timeline_of_windows(windows: SortedEvents, most: int) -> EventTimeline:
    """Return at most ``most`` of the events that are kept for counting."""
    step = max(-(-len(windows.times) // most), 1)
    codes = windows.codes[::step]
    polarities = 1 - 2 * (codes & 1).astype(np.int8)
    return EventTimeline(windows.times[::step], (codes >> 1).astype(np.int32), polarities)
