"""Pairs of consecutive events of a pixel: the unit of supervision."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventStream
from aenerf_ns.events.time_window import TimeWindow

_NEVER = np.iinfo(np.int64).min
_MAX_MERGED = 255
# PairsInTime keeps one number for this many pairs, and looks through this many pairs for each draw.
_BLOCK = 64

_EVERYTHING = TimeWindow()


@dataclass(frozen=True)
class EventPairs:
    """Every event with the previous event of its pixel (paper, eq. 4), in the order of the later event.

    Events of one pixel with one time are one event here, with their polarities counted.

    Attributes:
        x: (N,) uint16 pixel columns.
        y: (N,) uint16 pixel rows.
        previous_time: (N,) int64, time of the pixel's previous event in nanoseconds.
        time: (N,) int64, time of the event in nanoseconds.
        num_positive: (N,) uint8, positive events at ``time``.
        num_negative: (N,) uint8, negative events at ``time``.
        num_events: events in the stream.
        num_outside: events outside the time window or in a gap, which are left out.
        num_first: events left out because they are the first of their pixel.
        num_merged: events merged into another of the same pixel and time.
        num_within_refractory_period: events that follow the previous one of their pixel by no more than the
            refractory period, and give no pair.
    """

    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    previous_time: NDArray[np.int64]
    time: NDArray[np.int64]
    num_positive: NDArray[np.uint8]
    num_negative: NDArray[np.uint8]
    num_events: int
    num_outside: int
    num_first: int
    num_merged: int
    num_within_refractory_period: int

    def __len__(self) -> int:
        return len(self.time)

    def predecessors(self, shortest_interval: int = 0) -> NDArray[np.int32] | NDArray[np.int64]:
        """Return for each pair the index (N,) of the pair of its pixel that ends where it begins, −1 if there is none.

        A pixel's first pair has none, and neither has a pair after a gap or after an event that gave no pair.

        Args:
            shortest_interval: pairs whose events are fewer nanoseconds apart neither have nor are predecessors.
        """
        indices: NDArray = np.empty(len(self), np.int32 if len(self) <= np.iinfo(np.int32).max else np.int64)
        width, height = (int(pixels.max(initial=0)) + 1 for pixels in (self.x, self.y))
        _link(self.x, self.y, self.previous_time, self.time, width, height, shortest_interval, indices)
        return indices

    @property
    def shortest_interval(self) -> int:
        """Nanoseconds between the two events of the closest pair."""
        return int((self.time - self.previous_time).min())

    def summary(self) -> str:
        """Return one line that accounts for every event of the stream."""
        return (
            f"{self.num_events:,} events gave {len(self):,} pairs; left out: {self.num_outside:,} outside the time "
            f"window or the poses, {self.num_first:,} first of their pixel, {self.num_within_refractory_period:,} "
            f"within the refractory period; {self.num_merged:,} merged with one of the same pixel and time"
        )


class PairsInTime:
    """Find the pair whose interval contains a moment at a pixel, with one number in memory for 64 pairs.

    Args:
        pairs: the pairs to choose from.
        usable: (height, width) whether a pixel may be chosen. At least one usable pixel must have a pair.
    """

    def __init__(self, pairs: EventPairs, usable: NDArray[np.bool_]) -> None:
        self._columns = (pairs.x, pairs.y, pairs.previous_time, pairs.time, usable)
        self._ends = np.zeros(-(-len(pairs) // _BLOCK))
        _add_up(*self._columns, self._ends)

    def at(self, places: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the (N,) indices of the pairs at (N,) places along the intervals of all pairs, laid end to end.

        Places go from 0 to 1. Uniform places are uniform moments at uniform pixels, among the moments between two
        events of a pixel.
        """
        found = np.empty(len(places), np.int64)
        _find(*self._columns, self._ends, np.minimum(places * self._ends[-1], np.nextafter(self._ends[-1], 0)), found)
        return found


@numba.njit(cache=True)
def _add_up(x, y, previous_time, time, usable, ends):
    """Fill in where each block of pairs ends along the line of usable intervals, in nanoseconds."""
    end = 0.0
    for i in range(time.shape[0]):
        if usable[y[i], x[i]]:
            end += time[i] - previous_time[i]
        ends[i // _BLOCK] = end


@numba.njit(cache=True)
def _find(x, y, previous_time, time, usable, ends, places, found):
    """Fill in the pairs at places along the line of usable intervals."""
    for k in range(places.shape[0]):
        # The first block that ends behind the place. It has a usable pair.
        block = np.searchsorted(ends, places[k], side="right")
        left = places[k] - (ends[block - 1] if block > 0 else 0.0)
        for i in range(block * _BLOCK, min((block + 1) * _BLOCK, time.shape[0])):
            if usable[y[i], x[i]]:
                found[k] = i
                left -= time[i] - previous_time[i]
                if left < 0:
                    break


@numba.njit(cache=True)
def _pair_chunk(columns, width, refractory_period, last_time, last_record, records, n):
    """Continue the pairing with one chunk.

    Returns:
        The new number of records and the chunk's counts of first, merged and refractory events; or −1, and in place of
        the first count the index of the event that cannot be counted.
    """
    x, y, t, p = columns
    out_x, out_y, out_previous, out_time, out_pos, out_neg = records
    first = merged = refractory = 0
    for i in range(t.shape[0]):
        pixel = np.int64(y[i]) * width + x[i]
        if t[i] == last_time[pixel]:
            merged += 1
            record = last_record[pixel]
            if record >= 0:
                counts = out_pos if p[i] > 0 else out_neg
                if counts[record] == _MAX_MERGED:
                    return -1, i, merged, refractory
                counts[record] += 1
            continue
        previous = last_time[pixel]
        last_time[pixel] = t[i]
        last_record[pixel] = -1
        if previous == _NEVER:
            first += 1
        elif t[i] - previous <= refractory_period:
            refractory += 1
        else:
            out_x[n] = x[i]
            out_y[n] = y[i]
            out_previous[n] = previous
            out_time[n] = t[i]
            out_pos[n] = p[i] > 0
            out_neg[n] = p[i] < 0
            last_record[pixel] = n
            n += 1
    return n, first, merged, refractory


@numba.njit(cache=True)
def _link(x, y, previous_time, time, width, height, shortest_interval, indices):
    """Fill in the index of each pair's predecessor."""
    latest = np.full(width * height, -1, dtype=np.int64)
    for i in range(time.shape[0]):
        pixel = np.int64(y[i]) * width + x[i]
        before = latest[pixel]
        latest[pixel] = i if time[i] - previous_time[i] >= shortest_interval else -1
        linked = before >= 0 and latest[pixel] >= 0 and time[before] == previous_time[i]
        indices[i] = before if linked else -1


def pair_events(
    chunks: Iterable[EventStream],
    *,
    refractory_period: int = 0,
    window: TimeWindow = _EVERYTHING,
    expected_events: int | None = None,
) -> EventPairs:
    """Pair each event with the previous event of its pixel, in one pass over the stream.

    Memory holds one chunk, the pairs (22 bytes each) and 16 bytes for each pixel.

    Args:
        chunks: the stream in pieces, in the order of time, all of one sensor.
        refractory_period: τ in nanoseconds. An event at most τ after the previous event of its pixel gives no pair.
        window: events outside the window are left out, and no pair spans a gap.
        expected_events: the number of events, if known. It saves growing the arrays.

    Returns:
        The pairs, with every event of the stream accounted for.

    Raises:
        DataError: no event lies in the time window, or more than 255 events of one polarity share a pixel and a time.
    """
    dtypes = (np.uint16, np.uint16, np.int64, np.int64, np.uint8, np.uint8)
    # numpy.empty only reserves addresses: memory is used as the pairs are written.
    records: list[NDArray] = [np.empty(expected_events or 0, dtype) for dtype in dtypes]
    pieces = window.pieces()
    piece = size = total = outside = first = merged = refractory = 0
    last_time = last_record = None
    source: object = "events"
    for full_chunk in chunks:
        total += len(full_chunk)
        outside += len(full_chunk)
        source = full_chunk.source
        if last_time is None or last_record is None:
            last_time = np.full(full_chunk.width * full_chunk.height, _NEVER, dtype=np.int64)
            last_record = np.full(full_chunk.width * full_chunk.height, -1, dtype=np.int64)
        for index, chunk in enumerate(full_chunk.between(*times) for times in pieces):
            if len(chunk) == 0:
                continue
            outside -= len(chunk)
            if index != piece:
                # After a gap every pixel begins anew.
                piece = index
                last_time.fill(_NEVER)
            if size + len(chunk) > len(records[0]):
                capacity = max(size + len(chunk), 3 * len(records[0]) // 2)
                # One column at a time, to hold only one twice in memory.
                for column, record in enumerate(records):
                    records[column] = np.concatenate([record[:size], np.empty(capacity - size, record.dtype)])
            new_size, chunk_first, chunk_merged, chunk_refractory = _pair_chunk(
                (chunk.x, chunk.y, chunk.t, chunk.p),
                chunk.width,
                refractory_period,
                last_time,
                last_record,
                tuple(records),
                size,
            )
            if new_size < 0:
                raise DataError(
                    chunk.source,
                    f"more than {_MAX_MERGED} events of one polarity at pixel ({chunk.x[chunk_first]}, "
                    f"{chunk.y[chunk_first]}) share the time {chunk.t[chunk_first]} ns",
                    "check the unit of the times",
                )
            size = new_size
            first, merged, refractory = first + chunk_first, merged + chunk_merged, refractory + chunk_refractory
    if total == outside:
        raise DataError(
            str(source),
            f"none of its {total} events lies between {window.start} and {window.end} ns, the span of the poses "
            "and the time window",
            "check that events and poses share one clock and one unit of time",
        )
    x, y, previous_time, time, num_positive, num_negative = (record[:size] for record in records)
    return EventPairs(
        x=x,
        y=y,
        previous_time=previous_time,
        time=time,
        num_positive=num_positive,
        num_negative=num_negative,
        num_events=total,
        num_outside=outside,
        num_first=first,
        num_merged=merged,
        num_within_refractory_period=refractory,
    )
