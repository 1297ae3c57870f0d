"""What the readers of event files have in common."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventFile, EventStream
from aenerf_ns.files.limits import bounded, bounded_items
from aenerf_ns.files.text import TimeUnit

CHUNK = 1 << 20
"""Events that are read at once: 13 MB."""

Columns = tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.int64], NDArray[np.int8]]
"""x, y, t in nanoseconds, and p = ±1, of equal length."""


class EventReader(EventFile):
    """An event file that is read within the limits of :mod:`aenerf_ns.files.limits`.

    Formats implement :meth:`_chunks`, and :meth:`_time_span` and :meth:`_count` where the file tells them sooner.

    Attributes:
        kind: what the file is, for messages.
        extra: the optional dependencies that reading it may need.
    """

    kind = "event file"
    extra = ""
    _span: tuple[bool, tuple[int, int]] | None = None

    def read_chunks(self) -> Iterator[EventStream]:
        yield from bounded_items(self._chunks(), self.path, self.kind, self.extra)

    def time_span(self) -> tuple[int, int]:
        # Kept, because some formats are read through to find it, and commands ask for it several times.
        if self._span is not None and self._span[0] == self.drop_malformed:
            return self._span[1]
        with bounded(self.path, self.kind, self.extra):
            # Only what is read as a whole tells which events are well-formed, and whether the others are few.
            span = EventReader._time_span(self) if self.drop_malformed else self._time_span()
        if span is None:
            raise self.empty_error()
        self._span = self.drop_malformed, span
        return span

    def count(self) -> int | None:
        with bounded(self.path, self.kind, self.extra):
            return self._count()

    def assumed_unit(self) -> TimeUnit | None:
        with bounded(self.path, self.kind, self.extra):
            return self._assumed_unit()

    @abstractmethod
    def _chunks(self) -> Iterator[EventStream]:
        """Yield the events in pieces that fit in memory."""

    def _time_span(self) -> tuple[int, int] | None:
        """Return the times of the first and the last event in nanoseconds, or None without events."""
        ends = [(int(chunk.t[0]), int(chunk.t[-1])) for chunk in self.chunks()]
        return ends[0][0], ends[-1][1]

    def _assumed_unit(self) -> TimeUnit | None:
        """Return the unit of the times that is assumed or that the user states, or None where the file or its format
        states it."""
        return None

    def _count(self) -> int | None:
        """Return the number of events, or None if the file must be read through to count them."""
        return None

    def _stream(self, columns: Columns) -> EventStream:
        """Return the events of columns, without malformed ones where these are left out."""
        if self.drop_malformed:
            x, y, t, _ = columns
            inside = (x < self.width) & (y < self.height)
            self.left_out.add("outside the sensor", ~inside, lambda i: f"at x = {x[i]}, y = {y[i]}, {t[i]} ns")
            inside[inside] = self.left_out.add_out_of_order(t[inside])
            columns = tuple(column[inside] for column in columns)  # type: ignore[assignment]
        return EventStream(*columns, self.width, self.height, self.path)

    def _leave_out_end(self, piece: str, position: int) -> None:
        """Count a piece that an interrupted recording ends within, or raise a DataError unless it is to be left out."""
        if not self.drop_malformed:
            remedy = "copy it again, or leave the end of an interrupted recording out (--drop-malformed)"
            raise DataError(self.path, f"it ends within {piece} at byte {position:,}", remedy)
        size = self.path.stat().st_size
        self.left_out.add_number("cut off at its end", 1, f"{piece} at byte {position:,} of {size:,}")


def resolve_sensor_size(
    path: Path, stated: tuple[int, int] | None, width: int | None, height: int | None
) -> tuple[int, int]:
    """Return the width and height in pixels that a file states, or else the given ones.

    Raises:
        DataError: neither is known, the two differ, or no sensor has such a size.
    """
    given = (width, height)
    width, height = (own if size is None else size for size, own in zip(given, stated or (None, None), strict=True))
    if width is None or height is None:
        remedy = "give its width and height in pixels, for a recording of your own in calibration.json"
        raise DataError(path, "the file does not state the size of its sensor", remedy)
    if stated is not None and (width, height) != stated:
        raise DataError(
            path,
            f"its sensor has {stated[0]} x {stated[1]} pixels, but {width} x {height} were given",
            "give the calibration of this camera",
        )
    if width <= 0 or height <= 0:
        raise DataError(path, f"a sensor of {width} x {height} pixels cannot be", "give its width and height in pixels")
    return width, height


def batches(arrays: Iterable[NDArray]) -> Iterator[NDArray]:
    """Join arrays of events to batches of at least :data:`CHUNK` events, all but the last."""
    waiting: list[NDArray] = []
    count = 0
    for array in arrays:
        waiting.append(array)
        count += len(array)
        if count >= CHUNK:
            yield np.concatenate(waiting)
            waiting, count = [], 0
    if count:
        yield np.concatenate(waiting)
