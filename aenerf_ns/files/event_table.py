"""Events in columns of any numeric type, read piece by piece: the common part of the formats of other projects."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, KeysView, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import OUTSIDE_REMEDY, EventStream
from aenerf_ns.files.event_reader import CHUNK, Columns, EventFile
from aenerf_ns.files.limits import MAX_TIME
from aenerf_ns.files.text import NANOSECONDS, TimeUnit

FORMATS_REMEDY = "see the formats in the docs"
# Number of events that tell the unit of the times.
SAMPLE = 4096


@dataclass(frozen=True)
class EventLayout:
    """Where a file has the columns of its events.

    Attributes:
        columns: for x, y, t and p the name of an array and the part of it: None for an array of numbers, the index of a
            column for a matrix, or the name of a field for an array of records.
        time_unit: of the times, or None where the file states it or it is guessed: whole numbers are microseconds,
            which event cameras count, and decimals seconds.
        time_offset: name of a number that is added to all times, in their unit, where there is one.
    """

    columns: Mapping[str, tuple[str, int | str | None]]
    time_unit: TimeUnit | None = None
    time_offset: str | None = None

    @property
    def arrays(self) -> KeysView[str]:
        """Names of the arrays that hold columns, each once."""
        return dict.fromkeys(name for name, _ in self.columns.values()).keys()


class EventTableFile(EventFile):
    """Read a file whose arrays hold events as an :class:`EventLayout` says, or in another unit of the times.

    Formats implement :meth:`open_arrays`.
    """

    def __init__(
        self, path: Path, width: int, height: int, layout: EventLayout, time_unit: TimeUnit | None = None
    ) -> None:
        super().__init__(path, width, height)
        self._layout = layout
        self._given_unit = time_unit

    @abstractmethod
    def open_arrays(self) -> AbstractContextManager[Mapping[str, Any]]:
        """Open the arrays of the layout by name, to be sliced, and the time offset, an integer, as "time_offset".

        Raises:
            DataError: the file or an array is missing, or cannot be read.
        """

    def read_chunks(self) -> Iterator[EventStream]:
        with self.open_arrays() as arrays:
            length, tick = self._length(arrays), self._tick(arrays)
            for first in range(0, length, CHUNK):
                yield self._read(arrays, first, first + CHUNK, tick)

    def read_time_span(self) -> tuple[int, int] | None:
        with self.open_arrays() as arrays:
            length, tick = self._length(arrays), self._tick(arrays)
            if length == 0:
                return None
            first, last = (self._read(arrays, index, index + 1, tick) for index in (0, length - 1))
            return int(first.t[0]), int(last.t[0])

    def read_count(self) -> int:
        with self.open_arrays() as arrays:
            return self._length(arrays)

    def _length(self, arrays: Mapping[str, Any]) -> int:
        """Return the number of events. Check that the arrays have the form that the layout says."""
        lengths = {}
        for column, (name, part) in self._layout.columns.items():
            array, label = arrays[name], name or "the array"
            num_dimensions = 2 if isinstance(part, int) else 1
            if array.ndim != num_dimensions:
                remedy = f"it must have {num_dimensions} dimension(s), the first that of the events"
                raise DataError(self.path, f"{label} has shape {tuple(array.shape)}", remedy)
            if isinstance(part, int) and array.shape[1] <= part:
                problem = f"{label} has {array.shape[1]} columns"
                raise DataError(self.path, problem, f"column {part} must hold {column} of the events")
            if isinstance(part, str) and part not in (array.dtype.names or ()):
                raise DataError(self.path, f"the records of {label} have no field {part}", FORMATS_REMEDY)
            lengths[name] = len(array)
        if len(set(lengths.values())) > 1:
            raise DataError(self.path, f"its columns have lengths {lengths}", "store all with the same length")
        return next(iter(lengths.values()))

    def _columns(self, arrays: Mapping[str, Any], first: int, last: int | None) -> dict[str, NDArray]:
        pieces = {name: arrays[name][first:last] for name in self._layout.arrays}
        columns = {}
        for column, (name, part) in self._layout.columns.items():
            piece = pieces[name]
            columns[column] = piece if part is None else piece[part] if isinstance(part, str) else piece[:, part]
        return columns

    def read_assumed_unit(self) -> TimeUnit | None:
        with self.open_arrays() as arrays:
            return None if self._stated_unit(arrays) else self._unit_of_format(arrays)

    def _stated_unit(self, arrays: Mapping[str, Any]) -> TimeUnit | None:
        """Return the unit that the file states, if it does."""
        return None

    def _unit_of_format(self, arrays: Mapping[str, Any]) -> TimeUnit:
        """Return the unit that is given, or else the layout's, or the guessed one."""
        if unit := self._given_unit or self._layout.time_unit:
            return unit
        ends = ((0, SAMPLE), (max(self._length(arrays) - SAMPLE, 0), None))
        times = np.concatenate([self._columns(arrays, *end)["t"] for end in ends])
        return "s" if times.dtype.kind == "f" and (times > np.floor(times)).any() else "us"

    def _tick(self, arrays: Mapping[str, Any]) -> int:
        return NANOSECONDS[self._stated_unit(arrays) or self._unit_of_format(arrays)]

    def _read(self, arrays: Mapping[str, Any], first: int, last: int, tick: int) -> EventStream:
        columns, offset = self._columns(arrays, first, last), arrays.get("time_offset", 0)
        return self._stream(events_from_columns(self, columns, tick, lambda index: f"event {first + index}", offset))


def events_from_columns(
    file: EventFile,
    columns: Mapping[str, NDArray],
    tick: int,
    describe_event: Callable[[int], str],
    offset: int = 0,
    fraction: NDArray[np.float64] | None = None,
) -> Columns:
    """Return x, y, t in nanoseconds and p = ±1 of events in columns of any numeric type.

    Args:
        file: from which the columns are. Where it drops malformed events, its ``left_out`` takes those with an
            impossible value.
        columns: x, y, t and p, (N,) each. Polarities are 0 and 1, or −1 and 1.
        tick: nanoseconds of the unit of the times.
        describe_event: says which event one is in the file, for messages.
        offset: added to the times, in their unit.
        fraction: (N,) added to the times, in their unit, where the times are integers; between −1 and 1.

    Raises:
        DataError: a value is not one that an event can have, and these are not to be dropped.
    """
    for name in "xytp":
        if columns[name].dtype.kind not in "iufb":
            raise DataError(file.path, f"column {name} has type {columns[name].dtype}", "store numbers")

    kept = np.ones(len(columns["t"]), bool)

    def require(name: str, good: NDArray[np.bool_], remedy: str) -> None:
        if good.all():
            return
        if not file.drop_malformed:
            index = int(np.argmin(good))
            raise DataError(file.path, f"{describe_event(index)} has {name} = {columns[name][index]:g}", remedy)
        file.left_out.add(
            f"with an impossible {name}", kept & ~good, lambda i: f"{describe_event(i)}, {columns[name][i]:g}"
        )
        kept[~good] = False

    for name, size in (("x", file.width), ("y", file.height)):
        values = columns[name]
        good = (values >= 0) & (values < size)
        if values.dtype.kind == "f":
            good &= values == np.floor(values)
        require(name, good, f"it must be a whole number below {size}: {OUTSIDE_REMEDY}")

    times, polarities = columns["t"], columns["p"]
    limit = MAX_TIME // tick - abs(offset)
    # NaN compares as false, and no time is good where the offset alone is beyond the limit.
    good = (times >= -limit) & (times <= limit)
    unit = "the unit of the times (--event-time-unit of event-recording-data)"
    require("t", good, f"check {unit} and the order of the columns")

    # Written with care for booleans and unsigned integers.
    positive, zero = polarities == 1, polarities == 0
    good = positive | zero | (polarities == -1)
    require("p", good, "polarities are 0 and 1, or -1 and 1: check the order of the columns")
    zero &= kept
    if zero.any() and (kept & ~positive & ~zero).any():
        index = int(np.argmax(zero))
        remedy = "there are events of polarity -1 beside it: use 0 and 1, or -1 and 1"
        raise DataError(file.path, f"{describe_event(index)} has p = 0", remedy)

    if not kept.all():
        columns = {name: column[kept] for name, column in columns.items()}
        fraction = None if fraction is None else fraction[kept]
        times, positive = times[kept], positive[kept]
    if times.dtype.kind == "f":
        # The fraction apart, because nanoseconds since 1970 would be rounded.
        fraction = times.astype(np.float64) % 1
        times = np.floor(times)
    nanoseconds = (times.astype(np.int64) + offset) * tick
    if fraction is not None:
        nanoseconds += np.rint(fraction * tick).astype(np.int64)
    x, y = (columns[name].astype(np.uint16) for name in "xy")
    return x, y, nanoseconds, np.where(positive, np.int8(1), np.int8(-1))
