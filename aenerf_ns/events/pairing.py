"""Pairs of consecutive events of a pixel: the unit of supervision."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import BinaryIO

import numba
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.errors import DataError
from aenerf_ns.events.pair_store import (
    BLOCK,
    COUNT_MASK,
    COUNT_UNIT,
    MAX_JOINED,
    MAX_MISSED,
    MAX_SPAN,
    NEGATIVE_SHIFT,
    PIXEL_SHIFT,
    SPAN_MASK,
    SPAN_SHIFT,
    EventPairs,
    is_pair,
    map_rows,
    pixel_index,
)
from aenerf_ns.events.stream import EventStream

_MAX_MERGED = 255

EVENTS_IN_MEMORY = 1 << 27
"""The most events that stay in memory, if there is a file for more: 16 bytes each, twice while they are sorted."""
_ROWS_AT_A_TIME = 1 << 22

_NEVER = np.iinfo(np.int64).min
_EVERYTHING = TimeWindow()


def pair_events(
    chunks: Iterable[EventStream],
    *,
    refractory_period: int = 0,
    window: TimeWindow = _EVERYTHING,
    usable: NDArray[np.bool_] | None = None,
    open_file: Callable[[], tuple[BinaryIO, Path]] | None = None,
    events_in_memory: int = EVENTS_IN_MEMORY,
) -> EventPairs:
    """Pair each event with the previous event of its pixel, in one pass over the stream.

    Memory holds one chunk, 16 bytes for each event, the same again while the events are sorted, and 32 bytes for each
    pixel. Events beyond ``events_in_memory`` go to a file, and as many are in memory at a time.

    Args:
        chunks: the stream in pieces, in the order of time, all of one sensor.
        refractory_period: τ in nanoseconds. An event at most τ after the previous event of its pixel gives no pair.
        window: events outside the window are left out, and no pair spans a gap.
        usable: (height, width) whether the events of a pixel are used. None: all are.
        open_file: called once if the events are too many for memory. Returns a new file, open for reading and writing,
            and a folder for temporary files. The rows are written to the file's start and mapped. None: all events
            stay in memory.
        events_in_memory: the most events that stay in memory, if there is a file.

    Returns:
        The pairs, with every event of the stream accounted for.

    Raises:
        DataError: the sensor and ``usable`` differ in size, no event lies in the time window or on a pixel that is
            used, more than 255 events of one polarity share a pixel and a time, or the sensor or its recording is
            larger than can be counted.
    """
    table: _Table | None = None
    pieces = window.pieces()
    piece = total = inside = 0
    source: str | Path = "events"
    for full_chunk in chunks:
        total += len(full_chunk)
        source = full_chunk.source
        if table is None:
            used = np.ones((full_chunk.height, full_chunk.width), bool) if usable is None else usable
            full_chunk.require_size_of(used)
            table = _Table(used, refractory_period, source)
        for index, chunk in enumerate(full_chunk.between(*times) for times in pieces):
            if len(chunk) == 0:
                continue
            inside += len(chunk)
            if index != piece:
                # After a gap every pixel begins anew.
                piece = index
                table.last_time.fill(_NEVER)
            if open_file is not None and table.size + len(chunk) > events_in_memory:
                if table.file is None:
                    table.file, table.folder = open_file()
                table.flush()
            table.add(chunk)
    if table is None or inside == 0:
        raise DataError(
            source,
            f"none of its {total} events lies between {window.start} and {window.end} ns, the span of the poses "
            "and the time window",
            "check that events and poses share one clock and one unit of time",
        )
    return table.pairs(total, total - inside)


class _Table:
    """Collect the events of a stream, and sort them by pixel.

    Attributes:
        last_time: (pixels,) int64, time of each pixel's last event.
        size: events in memory.
        file: where the rows go; None if they stay in memory.
        folder: of temporary files.
    """

    def __init__(self, usable: NDArray[np.bool_], refractory_period: int, source: str | Path) -> None:
        self._usable = usable.ravel()
        self._shape = usable.shape
        self._refractory_period = refractory_period
        self._source = source
        self._entries = np.empty((0, 2), np.int64)
        self._last_entry = np.full(usable.size, -1, np.int64)
        self._shortest_interval = np.iinfo(np.int64).max
        # Of unusable, first, merged and refractory events.
        self._counts = np.zeros(4, np.int64)
        # Events that went to a file, sorted by pixel, and where the events of each pixel begin there.
        self._runs: list[tuple[BinaryIO, NDArray[np.int64]]] = []
        self.last_time = np.full(usable.size, _NEVER, np.int64)
        self.size = 0
        self.file: BinaryIO | None = None
        self.folder = Path()

    def add(self, chunk: EventStream) -> None:
        """Add the events of a chunk."""
        if self.size + len(chunk) > len(self._entries):
            # numpy.empty only reserves addresses: memory is used as the events are written.
            capacity = max(self.size + len(chunk), 3 * len(self._entries) // 2)
            grown = np.empty((capacity, 2), np.int64)
            grown[: self.size] = self._entries[: self.size]
            self._entries = grown
        failed, self.size, self._shortest_interval = _add_chunk(
            (chunk.x, chunk.y, chunk.t, chunk.p),
            chunk.width,
            self._usable,
            self._refractory_period,
            self.last_time,
            self._last_entry,
            self._entries,
            self.size,
            self._shortest_interval,
            self._counts,
        )
        if failed >= 0:
            x, y, t = chunk.x[failed], chunk.y[failed], chunk.t[failed]
            problem = f"more than {_MAX_MERGED} events of one polarity at pixel ({x}, {y}) share the time {t} ns"
            raise DataError(chunk.source, problem, "check the unit of the times")

    def flush(self, everything: bool = False) -> None:
        """Write the events in memory to a temporary file, sorted by pixel.

        Args:
            everything: also the events of the latest time, which others may still be merged with.
        """
        times = self._entries[: self.size, 0]
        count = self.size if everything or not self.size else int(np.searchsorted(times, times[-1]))
        if count == 0:
            return
        run, begins = self._by_pixel(count, count)
        # It has no name, so it is gone when the process ends, however the process ends.
        file = tempfile.TemporaryFile(dir=self.folder)  # noqa: SIM115
        # The errors of NumPy's tofile do not say that the disk is full.
        file.write(run.data)
        self._runs.append((file, begins))
        left = self._entries[count : self.size].copy()
        self.size = len(left)
        self._entries[: self.size] = left
        self._last_entry[pixel_index(left[:, 1])] = np.where(is_pair(left[:, 1]), np.arange(len(left)), -1)

    def pairs(self, num_events: int, num_outside: int) -> EventPairs:
        """Return the pairs of all events that were added."""
        unusable, first, merged, refractory = self._counts.tolist()
        num_rows = num_events - num_outside - unusable - merged
        if num_rows == 0:
            raise DataError(self._source, "no event lies on a pixel with a direction", "check the lens's distortion")
        num_pairs = num_rows - first - refractory
        block_ends = np.zeros(-(-num_rows // BLOCK) + 1, np.int64)
        num_padded = BLOCK * (len(block_ends) - 1)
        if self.file is None:
            rows, _ = self._by_pixel(self.size, num_padded)
            self._entries = rows[:0]
            _finish(rows[:num_rows], 0, 0, self._refractory_period, block_ends)
        else:
            self.flush(everything=True)
            self._entries = self._entries[:0].copy()
            self._merge(self.file, block_ends)
            self.file.write(bytes(16 * (num_padded - num_rows)))
            self.file.flush()
            rows = map_rows(self.file, num_padded)
        if block_ends[-1] < 0:
            remedy = "check the unit of the times, or choose a shorter time window"
            raise DataError(self._source, "its intervals add up to more than 292 years", remedy)
        height, width = self._shape
        return EventPairs(
            rows=rows,
            replacement_rows=num_pairs + np.flatnonzero(is_pair(rows[num_pairs:num_rows, 1])),
            block_ends=block_ends,
            width=width,
            height=height,
            shortest_interval=self._shortest_interval,
            num_events=num_events,
            num_outside=num_outside,
            num_unusable=unusable,
            num_first=first,
            num_merged=merged,
            num_within_refractory_period=refractory,
        )

    def _by_pixel(self, count: int, length: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the first events in memory by pixel, then by time, with zeros behind, and where each pixel begins."""
        counts = np.bincount(pixel_index(self._entries[:count, 1]), minlength=len(self._usable))
        begins = np.concatenate([[0], np.cumsum(counts)])
        rows = np.empty((length, 2), np.int64)
        _sort_into(self._entries[:count], 0, begins[:-1].copy(), rows)
        rows[count:] = 0
        return rows, begins

    def _merge(self, file: BinaryIO, block_ends: NDArray[np.int64]) -> None:
        """Write the rows of all runs to a file, and fill in the ends of blocks."""
        begins = np.sum([begins for _, begins in self._runs], axis=0)
        first = num_chains = 0
        while first < len(begins) - 1:
            # As many pixels as fit, and at least one.
            last = max(int(np.searchsorted(begins, begins[first] + _ROWS_AT_A_TIME, side="right")) - 1, first + 1)
            rows = np.empty((begins[last] - begins[first], 2), np.int64)
            next_rows = begins[first:last] - begins[first]
            for run, run_begins in self._runs:
                begin, end = int(run_begins[first]), int(run_begins[last])
                run.seek(16 * begin)
                _sort_into(np.fromfile(run, np.int64, 2 * (end - begin)).reshape(-1, 2), first, next_rows, rows)
            num_chains = _finish(rows, begins[first], num_chains, self._refractory_period, block_ends)
            file.write(rows.data)
            first = last
        for run, _ in self._runs:
            run.close()


@numba.njit(cache=True)
def _add_chunk(columns, width, usable, refractory_period, last_time, last_entry, entries, n, shortest, counts):
    """Continue with one chunk.

    Returns:
        −1 or the index of the event that cannot be counted, the new number of entries and the shortest interval.
    """
    x, y, t, p = columns
    for i in range(t.shape[0]):
        pixel = np.int64(y[i]) * width + x[i]
        if not usable[pixel]:
            counts[0] += 1
            continue
        previous = last_time[pixel]
        if t[i] == previous:
            counts[2] += 1
            entry = last_entry[pixel]
            if entry >= 0:
                shift = 0 if p[i] > 0 else NEGATIVE_SHIFT
                if (entries[entry, 1] >> shift) & COUNT_MASK == _MAX_MERGED:
                    return i, n, shortest
                entries[entry, 1] += 1 << shift
            continue
        last_time[pixel] = t[i]
        last_entry[pixel] = -1
        entries[n, 0] = t[i]
        entries[n, 1] = pixel << PIXEL_SHIFT
        if previous == _NEVER:
            counts[1] += 1
        elif t[i] - previous <= refractory_period:
            counts[3] += 1
        else:
            shortest = min(shortest, t[i] - previous)
            entries[n, 1] |= 1 << SPAN_SHIFT | 1 << (0 if p[i] > 0 else NEGATIVE_SHIFT)
            last_entry[pixel] = n
        n += 1
    return -1, n, shortest


@numba.njit(cache=True)
def _sort_into(entries, first_pixel, next_rows, rows):
    """Put events into the rows of their pixels, and move the next rows of the pixels on."""
    for i in range(entries.shape[0]):
        pixel = (entries[i, 1] >> PIXEL_SHIFT) - first_pixel
        row = next_rows[pixel]
        rows[row, 0] = entries[i, 0]
        rows[row, 1] = entries[i, 1]
        next_rows[pixel] = row + 1


@numba.njit(cache=True)
def _finish(rows, row, num_chains, refractory_period, block_ends):
    """Put maximum span and sums into the next rows, which hold each event's own counts, and add up the ends of blocks.

    Returns the number of chain starts so far. The rows are all those of some pixels, and ``row`` is the number of rows
    before them.

    For the change that a blind pixel misses see :func:`aenerf_ns.events.pair_store.event_counts`.
    """
    span = positive = negative = last_interval = 0
    rest = last_rate = 0.0
    for i in range(rows.shape[0]):
        block = (row + i) // BLOCK
        if (row + i) % BLOCK == 0:
            block_ends[block + 1] = block_ends[block]
        own = rows[i, 1]
        pixel = own >> PIXEL_SHIFT
        if (own >> SPAN_SHIFT) & SPAN_MASK == 0:
            rows[i, 1] = pixel << PIXEL_SHIFT | num_chains
            num_chains += 1
            span = positive = negative = last_interval = 0
            rest = last_rate = 0.0
            continue
        own &= (1 << SPAN_SHIFT) - 1
        interval = rows[i, 0] - rows[i - 1, 0]
        # A sum that has overflowed once stays negative, which tells of it.
        if block_ends[block + 1] >= 0:
            block_ends[block + 1] += interval
        rate = 0.0
        if own == 1 or own == 1 << NEGATIVE_SHIFT:
            rate = (1 if own == 1 else -1) / (interval - refractory_period)
        if refractory_period > 0 and rate * last_rate != 0:
            # Both are mean rates, of the time without the blindness. In the middle of the blindness between them, a
            # line through them is as far from each as the other's interval is long.
            missed = (last_rate * interval + rate * last_interval) / (last_interval + interval) * refractory_period
            # Rounding leaves a rest, which is added at the next event.
            rest += COUNT_UNIT * min(max(missed, -MAX_MISSED), MAX_MISSED)
            eighths = int(rest)
            # Whole thresholds would pass for events.
            if eighths % COUNT_UNIT == 0:
                eighths -= np.sign(eighths)
            rest -= eighths
            positive = (positive + max(eighths, 0)) & COUNT_MASK
            negative = (negative - min(eighths, 0)) & COUNT_MASK
            rows[i - 1, 1] = rows[i - 1, 1] >> SPAN_SHIFT << SPAN_SHIFT | negative << NEGATIVE_SHIFT | positive
        last_rate, last_interval = rate, interval
        is_few = max(own & COUNT_MASK, own >> NEGATIVE_SHIFT) <= MAX_JOINED
        span = min(span + 1, MAX_SPAN) if is_few else 0
        positive = (positive + COUNT_UNIT * (own & COUNT_MASK)) & COUNT_MASK
        negative = (negative + COUNT_UNIT * (own >> NEGATIVE_SHIFT)) & COUNT_MASK
        rows[i, 1] = pixel << PIXEL_SHIFT | max(span, 1) << SPAN_SHIFT | negative << NEGATIVE_SHIFT | positive
    return num_chains


@numba.njit(cache=True)
def _fit_lines(rows):
    """Return for rows of one pixel the slope of :func:`surplus_slopes`, and the sum of squares.

    Each chain has a line with a constant of its own.
    """
    squares = products = number = surplus = 0.0
    # Of the points of a line: their number, sums of events and of surplus, and of their products.
    n = x = y = xx = xy = 0.0
    for row in range(rows.shape[0] + 1):
        # Zero is a chain start: it ends the last line.
        packed = rows[row, 1] if row < rows.shape[0] else 0
        if (packed >> SPAN_SHIFT) & SPAN_MASK == 0:
            if n > 0:
                squares += xx - x * x / n
                products += xy - x * y / n
            n = x = y = xx = xy = 0.0
        elif row > 0:
            before = rows[row - 1, 1]
            if (before >> SPAN_SHIFT) & SPAN_MASK == 0:
                before = 0
            positive = (packed - before) & COUNT_MASK
            negative = ((packed >> NEGATIVE_SHIFT) - (before >> NEGATIVE_SHIFT)) & COUNT_MASK
            number += (positive + negative) / COUNT_UNIT
            surplus += (positive - negative) / COUNT_UNIT
        n += 1
        x += number
        y += surplus
        xx += number * number
        xy += number * surplus
    return products / squares if squares > 0 else 0.0, squares


@numba.njit(cache=True)
def surplus_slopes(rows, num_pixels):
    """Fit lines to the surplus of positive events over the number of events of a pixel.

    Args:
        rows: see :class:`EventPairs`, without those behind the last event.
        num_pixels: of the sensor.

    Returns:
        (3, pixels) float64 slopes, over all events of a pixel and over each half of them, 0 where there are too few,
        and sums of squares of the numbers of events around their means, which tell how well the slopes are known.
    """
    slopes, squares = np.zeros((2, 3, num_pixels))
    begin = 0
    while begin < rows.shape[0]:
        pixel, end = rows[begin, 1] >> PIXEL_SHIFT, begin + 1
        while end < rows.shape[0] and rows[end, 1] >> PIXEL_SHIFT == pixel:
            end += 1
        middle = begin + (end - begin) // 2
        for part, (first, last) in enumerate(((begin, end), (begin, middle), (middle, end))):
            slopes[part, pixel], squares[part, pixel] = _fit_lines(rows[first:last])
        begin = end
    return slopes, squares
