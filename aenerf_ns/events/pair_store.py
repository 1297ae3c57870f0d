"""The table of all pairs of events: each event with the previous event of its pixel."""

from __future__ import annotations

import mmap
import sys
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

# Numba compiles these numbers into events/pairs.py and keeps the result until that file changes: change it too.
# The parts of a row's second number, from the highest bits: pixel, reach, sum of negative and of positive events.
PIXEL_SHIFT, REACH_SHIFT, NEGATIVE_SHIFT = 40, 32, 16
COUNT_MASK, REACH_MASK, NUMBER_MASK = 0xFFFF, 0xFF, 0xFFFFFFFF
# With this reach, and at most 255 events merged into one, a pair's counts fit in 16 bits.
MAX_REACH = 255
BLOCK = 16
"""EventPairs keeps one number for this many rows, to find moments."""


@dataclass(frozen=True)
class EventPairs:
    """Every event with the previous event of its pixel (paper, eq. 4), in the order of pixels, then of time.

    Events of one pixel with one time are one event here, with their polarities counted. Each event has a row. An event
    that gives no pair, such as the first of its pixel, is a *head*: its row only tells where the next pair begins. The
    row before a pair's row is that of the pair's earlier event.

    Attributes:
        rows: (R, 2) int64, in memory or mapped from a file. The first number is the event's time in nanoseconds. The
            second number holds, from the highest bits, the ``pixel`` (row * width + column, 24 bits), the ``reach``
            (8 bits) and two counts (16 bits each). The reach is how many consecutive pairs may be joined that end with
            this pair's, at most 255; 0 for a head. The counts are negative and positive events from the last head up to
            this row, modulo 65536. A head has its number among all heads in place of the counts. Rows behind the last
            event's fill the last block, and are not drawn.
        substitutes: (S,) int64, for each head among the first ``len(pairs)`` rows, a pair among the rows behind them.
            So a uniform row of the first ``len(pairs)``, or its substitute if it is a head, is a uniform pair.
        bounds: (B + 1,) int64, nanoseconds from the first interval's start to the end of each block of 16 rows, when
            the intervals of all pairs are laid end to end. Block b is the rows from 16 b to 16 b + 15.
        width: number of pixel columns of the sensor.
        height: number of pixel rows of the sensor.
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
    substitutes: NDArray[np.int64]
    bounds: NDArray[np.int64]
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

    def summary(self) -> str:
        """Return one line that accounts for every event of the stream."""
        return (
            f"{self.num_events:,} events gave {len(self):,} pairs; left out: {self.num_outside:,} outside the time "
            f"window or the poses, {self.num_unusable:,} at pixels without a direction, {self.num_first:,} first of "
            f"their pixel, {self.num_within_refractory_period:,} within the refractory period; {self.num_merged:,} "
            "merged with one of the same pixel and time"
        )


def map_rows(file: BinaryIO, num_rows: int) -> NDArray[np.int64]:
    """Map the (R, 2) rows at the start of a file into memory."""
    # Read-only, because the system charges a copy-on-write mapping as if all of it were memory.
    mapped = mmap.mmap(file.fileno(), 16 * num_rows, access=mmap.ACCESS_READ)
    # Pairs are drawn from anywhere: without this advice Linux would read 32 pages for each.
    if sys.platform == "linux":
        mapped.madvise(mmap.MADV_RANDOM)
    return np.frombuffer(mapped, np.int64).reshape(-1, 2)
