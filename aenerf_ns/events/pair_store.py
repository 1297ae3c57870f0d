"""The table of all pairs of events: each event with the previous event of its pixel.

A row of the table is two int64: a time, and a packed number. Only this module and the kernels in
:mod:`aenerf_ns.events.pairing` know which bits of that number mean what.
"""

from __future__ import annotations

import mmap
import sys
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.events.stream import EventStream

# Numba compiles these numbers into events/pairing.py and keeps the result until that file changes: change it too.
# The parts of a packed number, from the highest bits: pixel, span, sum of negative and of positive events.
PIXEL_SHIFT, SPAN_SHIFT, NEGATIVE_SHIFT = 40, 32, 16
COUNT_MASK, SPAN_MASK, INDEX_MASK = 0xFFFF, 0xFF, 0xFFFFFFFF
MAX_SPAN = 255
"""The most consecutive pairs that are joined."""
COUNT_UNIT = 8
"""Counts are kept in eighths of an event, for changes that no event tells of."""
MAX_MISSED = 4
"""The most thresholds that a pixel is taken to miss after an event."""
MAX_JOINED = 31
"""The most events merged into one that others are joined with. Counts of :data:`MAX_SPAN` pairs then fit in 16 bits."""
BLOCK = 16
"""Rows for which :class:`EventPairs` keeps one end, to find moments."""


@dataclass(frozen=True)
class EventPairs:
    """Every event with the previous event of its pixel (paper, eq. 4), in the order of pixels, then of time.

    Events of one pixel with one time are one event here, with their polarities counted. Each event has a row. The row
    before a pair's row is that of the pair's earlier event. An event that gives no pair, such as the first of its
    pixel, is a *chain start*: its row only tells where the next pair begins.

    Attributes:
        rows: (R, 2) int64, in memory or mapped from a file: the event's time in nanoseconds, and a packed number. The
            packed number holds, from the highest bits, the pixel (row * width + column, 24 bits), the maximum span (8
            bits) and two counts (16 bits each). The maximum span is how many consecutive pairs may be joined that end
            with this pair, at most 255; 0 for a chain start. The counts are negative and positive events from the last
            chain start up to this row, and the change that the pixel is blind to after each of them, in eighths of an
            event, modulo 65536. A chain start has its index among all chain starts in place of the counts. Rows behind
            the last event's fill the last block, and are not drawn.
        replacement_rows: (S,) int64, for each chain start among the first ``len(pairs)`` rows, a pair among the rows
            behind them. So a uniform row of the first ``len(pairs)``, or its replacement if it is a chain start, is a
            uniform pair.
        block_ends: (B + 1,) int64, nanoseconds from the first interval's start to the end of each block of 16 rows,
            when the intervals of all pairs are laid end to end. Block b is the rows from 16 b to 16 b + 15, and ends at
            ``block_ends[b + 1]``.
        width, height: size of the sensor in pixels.
        shortest_interval: nanoseconds between the two events of the closest pair.
        num_events: events in the stream.
        num_outside: events outside the time window or in a gap, which are left out.
        num_unusable: events left out because their pixel is not used.
        num_first: events without a pair because they are the first of their pixel.
        num_merged: events merged into another of the same pixel and time.
        num_within_refractory_period: events that follow the previous one of their pixel by no more than the
            refractory period, and give no pair.
    """

    rows: NDArray[np.int64]
    replacement_rows: NDArray[np.int64]
    block_ends: NDArray[np.int64]
    width: int
    height: int
    shortest_interval: int
    num_events: int
    num_outside: int
    num_unusable: int
    num_first: int
    num_merged: int
    num_within_refractory_period: int

    def __len__(self) -> int:
        used = self.num_events - self.num_outside - self.num_unusable - self.num_merged
        return used - self.num_first - self.num_within_refractory_period

    def events(self, rows: slice = slice(None)) -> EventStream:
        """Return the later events of pairs, in the order of time.

        Args:
            rows: of the table. They are in the order of pixels, so consecutive rows are events of neighboring pixels,
                and every n-th row is an even sample of all pixels and times.

        Returns:
            One event for each pixel and time, with the polarity that prevails there. Events whose polarities cancel are
            left out.
        """
        start, stop, step = rows.indices(len(self.rows))
        # Row 0 is no pair, and every other row has one before it.
        later = self.rows[max(start, 1) : stop : step]
        earlier = self.rows[max(start, 1) - 1 : stop - 1 : step, 1]
        times, packed = later.T
        positive, negative = own_counts(packed, earlier)
        kept = is_pair(packed) & (positive != negative)
        order = np.flatnonzero(kept)[np.argsort(times[kept], kind="stable")]
        is_positive = (positive > negative)[order]
        return EventStream.at_pixels(pixel_index(packed[order]), times[order], is_positive, self.width, self.height)

    def summary(self) -> str:
        """Return one line that accounts for every event of the stream."""
        return (
            f"{self.num_events:,} events gave {len(self):,} pairs; left out: {self.num_outside:,} outside the time "
            f"window or the poses, {self.num_unusable:,} at pixels without a direction, {self.num_first:,} first of "
            f"their pixel, {self.num_within_refractory_period:,} within the refractory period; {self.num_merged:,} "
            "merged with one of the same pixel and time"
        )


# The parts of packed numbers, which may be an array or a tensor on any device.


def is_pair(packed: Any) -> Any:
    """Return whether rows are pairs, and no chain starts."""
    return max_span(packed) > 0


def max_span(packed: Any) -> Any:
    """Return how many consecutive pairs may be joined that end with each row's pair, 0 for a chain start."""
    return packed >> SPAN_SHIFT & SPAN_MASK


def pixel_index(packed: Any) -> Any:
    """Return the pixels of rows, counted row by row over the sensor."""
    return packed >> PIXEL_SHIFT


def chain_index(packed: Any) -> Any:
    """Return the indices of chain starts among all chain starts."""
    return packed & INDEX_MASK


def event_counts(later: Any, earlier: Any) -> tuple[Any, Any]:
    """Count the events of a pixel after an earlier row, up to and including a later one, and what it misses after each.

    A pixel is blind for the refractory period τ after an event. In an interval dt between two single events,
    log-radiance changes by 1 / (dt − τ) thresholds per nanosecond on average. Between the middles of the two intervals
    around an event this rate is taken to change steadily. What the pixel misses is τ times the rate in the middle of
    its blindness, at most 4 thresholds. It counts for the event that made the pixel blind, with the sign of the rate.

    Args:
        later: packed numbers of rows.
        earlier: packed numbers of rows of the same pixels, at most the maximum span of a pair before these.

    Returns:
        Numbers of positive and of negative events, with those missed after each.
    """
    # A chain start has an index in place of its counts, which are 0.
    later, earlier = later * is_pair(later), earlier * is_pair(earlier)
    positive = (later - earlier) & COUNT_MASK
    negative = ((later >> NEGATIVE_SHIFT) - (earlier >> NEGATIVE_SHIFT)) & COUNT_MASK
    return positive / COUNT_UNIT, negative / COUNT_UNIT


def own_counts(later: Any, before: Any) -> tuple[Any, Any]:
    """Count the events of each row, given the row before it, without what their pixel misses after them.

    Only a single event has something missed after it, of one polarity and never a whole number. So a whole count is of
    events. A count that is not whole has the event if the other polarity has none.

    Returns:
        Numbers of positive and of negative events.
    """
    positive, negative = event_counts(later, before)
    return _own(positive, negative), _own(negative, positive)


def _own(count: Any, other: Any) -> Any:
    is_whole = count % 1 == 0
    return count * is_whole + (other == 0) * ~is_whole


def map_rows(file: BinaryIO, num_rows: int) -> NDArray[np.int64]:
    """Map the (R, 2) rows at the start of a file into memory."""
    # Read-only, because the system charges a copy-on-write mapping as if all of it were memory.
    mapped = mmap.mmap(file.fileno(), 16 * num_rows, access=mmap.ACCESS_READ)
    # Pairs are drawn from anywhere: without this advice Linux would read 32 pages for each.
    if sys.platform == "linux":
        mapped.madvise(mmap.MADV_RANDOM)
    return np.frombuffer(mapped, np.int64).reshape(-1, 2)
