"""Validated event streams, in memory and in files."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError, require_file
from aenerf_ns.events.left_out import LeftOut
from aenerf_ns.events.sensor import require_event_sensor_size

UNSORTED_REMEDY = (
    "a few such events can be left out (--drop-malformed); many such events mean that times overflowed or that your "
    "table is not sorted by time"
)
"""How to mend events that are out of order."""

OUTSIDE_REMEDY = (
    "check the sensor size and the order of the columns; a few such events can be left out (--drop-malformed)"
)
"""How to mend events outside the sensor."""

_COLUMNS = {"x": np.uint16, "y": np.uint16, "t": np.int64, "p": np.int8}


@dataclass(frozen=True)
class EventStream:
    """Events of one sensor in the order of their times.

    Attributes:
        x: (N,) uint16 pixel columns, 0 at the left.
        y: (N,) uint16 pixel rows, 0 at the top.
        t: (N,) int64 times in nanoseconds, never decreasing.
        p: (N,) int8 polarities, +1 or −1.
        width: number of pixel columns of the sensor.
        height: number of pixel rows of the sensor.
        source: the file of the events, for messages.

    Raises:
        DataError: an array has the wrong type or length, a time decreases, a polarity is not ±1, or a pixel lies
            outside the sensor.
    """

    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    t: NDArray[np.int64]
    p: NDArray[np.int8]
    width: int
    height: int
    source: str | Path = "events"

    def __post_init__(self) -> None:
        for name, dtype in _COLUMNS.items():
            column = getattr(self, name)
            if column.dtype != dtype or column.ndim != 1:
                raise DataError(
                    self.source,
                    f"column {name} has type {column.dtype} and shape {column.shape}",
                    f"store it as one row of {np.dtype(dtype).name}",
                )
            if len(column) != len(self.t):
                raise DataError(
                    self.source,
                    f"column {name} has {len(column)} entries but column t has {len(self.t)}",
                    "store all four columns with the same length",
                )
        if len(self.t) == 0:
            return
        for name, limit, size in (("x", self.width, "width"), ("y", self.height, "height")):
            column = getattr(self, name)
            if column.max() >= limit:
                index = int(np.argmax(column >= limit))
                raise DataError(
                    self.source,
                    f"event {index} has {name} = {column[index]} on a sensor of {size} {limit}",
                    OUTSIDE_REMEDY,
                )
        if (self.t[1:] < self.t[:-1]).any():
            index = int(np.argmax(self.t[1:] < self.t[:-1])) + 1
            raise _unsorted(self.source, index, int(self.t[index]), int(self.t[index - 1]))
        if (np.abs(self.p) != 1).any():
            index = int(np.argmax(np.abs(self.p) != 1))
            raise DataError(
                self.source,
                f"event {index} has polarity {self.p[index]}",
                "store polarities as -1 and +1 (from 0 and 1: 2 * p - 1)",
            )

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, index: slice | NDArray) -> EventStream:
        """Return the events of a slice (as views) or of an array of indices or booleans (as copies)."""
        columns = {name: getattr(self, name)[index] for name in _COLUMNS}
        return EventStream(**columns, width=self.width, height=self.height, source=self.source)

    @staticmethod
    def concatenate(parts: Sequence[EventStream]) -> EventStream:
        """Return the events of one or more streams of a sensor, one stream after the other, as a copy."""
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS}
        return replace(parts[0], **columns)

    def between(self, start: int, end: int) -> EventStream:
        """Return the events with start <= t <= end, in nanoseconds."""
        return self[np.searchsorted(self.t, start) : np.searchsorted(self.t, end, "right")]

    def nearest(self, time: int, count: int) -> EventStream:
        """Return about ``count`` events around a time in nanoseconds, half of them before it.

        Example:
            >>> pixels = np.zeros(10, np.uint16)
            >>> stream = EventStream(pixels, pixels, np.arange(0, 100, 10), np.ones(10, np.int8), width=1, height=1)
            >>> stream.nearest(45, 4).t.tolist()
            [30, 40, 50, 60]
            >>> stream.nearest(0, 4).t.tolist()
            [0, 10]
        """
        middle = int(np.searchsorted(self.t, time))
        return self[max(middle - count // 2, 0) : middle + count // 2]

    def subsample(self, count: int) -> EventStream:
        """Return at most ``count`` of the events, evenly spread over them."""
        if len(self) <= count:
            return self
        return self[np.linspace(0, len(self) - 1, count).astype(np.int64)]


def _unsorted(source: str | Path, index: int, time: int, previous: int) -> DataError:
    return DataError(
        source,
        f"event {index} is at {time} ns, before the event ahead of it at {previous} ns",
        UNSORTED_REMEDY,
    )


class EventFile(ABC):
    """A file of events, opened only when its events are needed.

    Readers of a format implement :meth:`read_chunks` and :meth:`time_span`. This class checks that the whole stream is
    in order.

    Args:
        path: the file.
        width: number of pixel columns of the sensor.
        height: number of pixel rows of the sensor.

    Attributes:
        drop_malformed: leave out, count and name events outside the sensor or out of order, in place of raising an
            error, as long as they are few.

    Raises:
        DataError: no event sensor has so many pixels.
    """

    drop_malformed = False

    def __init__(self, path: Path, width: int, height: int) -> None:
        require_event_sensor_size(width, height, path)
        self.path = path
        self.width = width
        self.height = height
        self.left_out = LeftOut()

    @abstractmethod
    def read_chunks(self) -> Iterator[EventStream]:
        """Yield the events in pieces that fit in memory. Each piece is checked by itself.

        Raises:
            DataError: the file is missing or its content cannot be used.
        """

    @abstractmethod
    def time_span(self) -> tuple[int, int]:
        """Return the times of the first and the last event in nanoseconds. Some formats must be read through.

        Raises:
            DataError: the file is missing or empty.
        """

    def ordered_time_span(self) -> tuple[int, int]:
        """Return the times of the first and the last event in nanoseconds, checked to be in order.

        Raises:
            DataError: the file is missing or empty, or the last event is before the first.
        """
        first, last = self.time_span()
        if last < first:
            raise DataError(
                self.path,
                f"its last event, at {last} ns, is before its first, at {first} ns",
                UNSORTED_REMEDY,
            )
        return first, last

    def count(self) -> int | None:
        """Return the number of events, or None if the file must be read through to count them."""
        return None

    def assumed_unit(self) -> str | None:
        """Return the unit of the times ("ns", "us", "ms" or "s") that is assumed or that the user states, or None
        where the file or its format states it."""
        return None

    def require(self) -> None:
        """Raise a DataError if the file does not exist."""
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
        for chunk in self.read_chunks():
            if len(chunk) == 0:
                continue
            if last_time is not None and chunk.t[0] < last_time:
                raise _unsorted(self.path, total, int(chunk.t[0]), last_time)
            last_time = int(chunk.t[-1])
            total += len(chunk)
            yield chunk
        if self.drop_malformed:
            self.left_out.require_few(self.path, total)
        self.left_out.print_once(self.path)
        if total == 0:
            raise self.empty_error()
