"""Files of events: what their formats have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError, require_file
from aenerf_ns.events.sensor import require_event_sensor_size
from aenerf_ns.events.stream import UNSORTED_REMEDY, EventStream, unsorted_error
from aenerf_ns.files.left_out import LeftOut
from aenerf_ns.files.limits import bounded, bounded_items
from aenerf_ns.files.text import TimeUnit
from aenerf_ns.progress import progress_bar

CHUNK = 1 << 20
"""Events that are read at once: 13 MB."""

TOPIC_OPTION = "--event-topic, or --format-options event-topic=... of aenerf"
"""How to choose one of the streams of events in a file."""

Columns = tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.int64], NDArray[np.int8]]
"""x, y, t in nanoseconds, and p = ±1, of equal length."""


class EventFile(ABC):
    """A file of events, opened only when its events are needed, and read within :mod:`aenerf_ns.files.limits`.

    Formats implement :meth:`read_chunks`, and the other methods ``read_...`` where the file tells more, or sooner. This
    class checks that the whole stream is in order.

    Args:
        path: the file.
        width, height: size of the sensor in pixels.

    Attributes:
        kind: what the file is, for messages.
        extra: the optional dependencies that reading it may need.
        drop_malformed: leave out, count and name events outside the sensor or out of order, in place of raising an
            error, as long as they are few.

    Raises:
        DataError: no event sensor has so many pixels.
    """

    kind = "event file"
    extra = ""
    drop_malformed = False
    _span: tuple[bool, tuple[int, int]] | None = None

    def __init__(self, path: Path, width: int, height: int) -> None:
        require_event_sensor_size(width, height, path)
        self.path = path
        self.width = width
        self.height = height
        self.left_out = LeftOut()

    @abstractmethod
    def read_chunks(self) -> Iterator[EventStream]:
        """Yield the events in pieces that fit in memory. Whatever it raises becomes a DataError."""

    def read_time_span(self) -> tuple[int, int] | None:
        """Return the times of the first and the last event in nanoseconds, or None without events."""
        ends = [(int(chunk.t[0]), int(chunk.t[-1])) for chunk in self.chunks()]
        return ends[0][0], ends[-1][1]

    def read_count(self) -> int | None:
        """Return the number of events, or None if the file must be read through to count them."""
        return None

    def read_assumed_unit(self) -> TimeUnit | None:
        """Return the unit of the times that the user gives or the format assumes, or None where the file states it."""
        return None

    def time_span(self) -> tuple[int, int]:
        """Return the times of the first and the last event in nanoseconds. Some formats must be read through.

        Raises:
            DataError: the file is missing or empty, or the last event is before the first.
        """
        # Kept, because some formats are read through to find it, and commands ask for it several times.
        if self._span is not None and self._span[0] == self.drop_malformed:
            return self._span[1]
        with bounded(self.path, self.kind, self.extra):
            # Only what is read as a whole tells which events are well-formed, and whether the others are few.
            span = EventFile.read_time_span(self) if self.drop_malformed else self.read_time_span()
        if span is None:
            raise self.empty_error()
        if span[1] < span[0]:
            problem = f"its last event, at {span[1]} ns, is before its first, at {span[0]} ns"
            raise DataError(self.path, problem, UNSORTED_REMEDY)
        self._span = self.drop_malformed, span
        return span

    def count(self) -> int | None:
        """Return what :meth:`read_count` returns, or raise a DataError."""
        with bounded(self.path, self.kind, self.extra):
            return self.read_count()

    def assumed_unit(self) -> TimeUnit | None:
        """Return what :meth:`read_assumed_unit` returns, or raise a DataError."""
        with bounded(self.path, self.kind, self.extra):
            return self.read_assumed_unit()

    def require(self) -> None:
        """Raise a DataError if the file, or the folder that holds the events, does not exist."""
        if not self.path.is_dir():
            require_file(self.path)

    def empty_error(self) -> DataError:
        """Return the error for a file without events."""
        return DataError(self.path, "the file holds no events", "record or convert it again")

    def chunks(self) -> Iterator[EventStream]:
        """Yield all events in pieces that fit in memory, in the order of their times.

        Raises:
            DataError: the file is missing, empty or out of order, or an event is malformed.
        """
        self.require()
        self.left_out.restart()
        total, last_time = 0, None
        for chunk in bounded_items(self._pieces(), self.path, self.kind, self.extra):
            if len(chunk) == 0:
                continue
            if last_time is not None and chunk.t[0] < last_time:
                raise unsorted_error(self.path, total, int(chunk.t[0]), last_time)
            last_time = int(chunk.t[-1])
            total += len(chunk)
            yield chunk
        if self.drop_malformed:
            self.left_out.require_few(self.path, total)
        self.left_out.print_once(self.path)
        if total == 0:
            raise self.empty_error()

    def tracked(self, description: str = "") -> Iterator[EventStream]:
        """Yield :meth:`chunks`, with a progress bar towards the number of events, if that is known."""
        total = self.count()
        with progress_bar() as progress:
            task = progress.add_task(description or f"Reading {self.path.name}", total=total)
            for chunk in self.chunks():
                yield chunk
                progress.advance(task, len(chunk))

    def _pieces(self) -> Iterator[EventStream]:
        """Yield what :meth:`read_chunks` yields, then the events that wait for a piece behind it."""
        yield from self.read_chunks()
        if self.left_out.waiting:
            x, y, t, p = self.left_out.waiting
            yield EventStream(x, y, t, p, self.width, self.height, self.path)

    def _stream(self, columns: Columns) -> EventStream:
        """Return the events of columns, without malformed ones where these are left out."""
        if self.drop_malformed:
            x, y, t, _ = columns
            inside = (x < self.width) & (y < self.height)
            self.left_out.add("outside the sensor", ~inside, lambda i: f"at x = {x[i]}, y = {y[i]}, {t[i]} ns")
            columns = self.left_out.in_order([column[inside] for column in columns])  # type: ignore[assignment]
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
        problem = f"its sensor has {stated[0]} x {stated[1]} pixels, but {width} x {height} were given"
        raise DataError(path, problem, "give the calibration of this camera")
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
