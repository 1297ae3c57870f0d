"""Validated event streams."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError

UNSORTED_REMEDY = (
    "a few such events can be left out (--drop-malformed); many such events mean that times overflowed or that your "
    "table is not sorted by time"
)
"""How to mend events that are out of order."""

OUTSIDE_REMEDY = (
    "check the sensor size and the order of the columns; a few such events can be left out (--drop-malformed)"
)
"""How to mend events outside the sensor."""


def unsorted_error(source: str | Path, index: int, time: int, previous: int) -> DataError:
    """Return the error for an event that is before the one ahead of it, in nanoseconds."""
    problem = f"event {index} is at {time} ns, before the event ahead of it at {previous} ns"
    return DataError(source, problem, UNSORTED_REMEDY)


_COLUMNS = {"x": np.uint16, "y": np.uint16, "t": np.int64, "p": np.int8}


@dataclass(frozen=True)
class EventStream:
    """Events of one sensor in the order of their times.

    Attributes:
        x: (N,) uint16 pixel columns, 0 at the left.
        y: (N,) uint16 pixel rows, 0 at the top.
        t: (N,) int64 times in nanoseconds, never decreasing.
        p: (N,) int8 polarities, +1 or −1.
        width, height: size of the sensor in pixels.
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
                problem = f"column {name} has type {column.dtype} and shape {column.shape}"
                raise DataError(self.source, problem, f"store it as one row of {np.dtype(dtype).name}")
            if len(column) != len(self.t):
                problem = f"column {name} has {len(column)} entries but column t has {len(self.t)}"
                raise DataError(self.source, problem, "store all four columns with the same length")
        if len(self.t) == 0:
            return
        for name, limit, size in (("x", self.width, "width"), ("y", self.height, "height")):
            column = getattr(self, name)
            if column.max() >= limit:
                index = int(np.argmax(column >= limit))
                problem = f"event {index} has {name} = {column[index]} on a sensor of {size} {limit}"
                raise DataError(self.source, problem, OUTSIDE_REMEDY)
        if (self.t[1:] < self.t[:-1]).any():
            index = int(np.argmax(self.t[1:] < self.t[:-1])) + 1
            raise unsorted_error(self.source, index, int(self.t[index]), int(self.t[index - 1]))
        if (np.abs(self.p) != 1).any():
            index = int(np.argmax(np.abs(self.p) != 1))
            problem = f"event {index} has polarity {self.p[index]}"
            raise DataError(self.source, problem, "store polarities as -1 and +1 (from 0 and 1: 2 * p - 1)")

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

    @staticmethod
    def at_pixels(
        pixels: NDArray[np.integer], t: NDArray[np.int64], is_positive: NDArray[np.bool_], width: int, height: int
    ) -> EventStream:
        """Return the events at (N,) pixels, counted row by row over the sensor, and times in nanoseconds."""
        y, x = np.divmod(pixels, width)
        p = np.where(is_positive, 1, -1)
        return EventStream(x.astype(np.uint16), y.astype(np.uint16), t, p.astype(np.int8), width, height)

    def require_size_of(self, usable: NDArray[np.bool_]) -> None:
        """Raise a DataError if the sensor does not have the size of (height, width) pixels of a lens model."""
        height, width = usable.shape
        if (self.height, self.width) != (height, width):
            problem = f"its sensor has {self.width} x {self.height} pixels, its lens model {width} x {height}"
            raise DataError(self.source, problem, "state one size")

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
