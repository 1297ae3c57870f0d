"""Events in HDF5: the event file of the native dataset format."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventFile, EventStream

if TYPE_CHECKING:
    import h5py

_DTYPES = {"x": np.uint16, "y": np.uint16, "t": np.int64, "p": np.int8}
_NANOSECONDS = {"ns": 1, "us": 1_000, "ms": 1_000_000}
# Events read at once: 50 MB.
_CHUNK = 1 << 22
# Events collected before they are written: many small writes are slow.
_WRITE_CHUNK = 1 << 18


class Hdf5EventFile(EventFile):
    """/events/{x u16, y u16, t i64, p i8}, with the attributes ``time_unit`` ("ns", "us" or "ms") and ``time_offset``
    (an integer in that unit, added to every time) on /events.
    """

    def _open(self) -> h5py.File:
        # Late, for every command of every method would wait for it.
        import h5py

        with suppress(ImportError):
            # Registers Blosc and other compression filters, where the extra is installed.
            import hdf5plugin  # noqa: F401
        self.require()
        try:
            return h5py.File(self.path, "r")
        except OSError as error:
            raise DataError(self.path, f"not a readable HDF5 file ({error})", "write or copy it again") from None

    def _columns(self, file: h5py.File) -> tuple[dict[str, h5py.Dataset], int, int]:
        """The four columns, the nanoseconds of a tick, and the offset in nanoseconds."""
        columns = {name: file.get(f"events/{name}") for name in _DTYPES}
        for name, column in columns.items():
            if not hasattr(column, "dtype"):
                raise DataError(self.path, f"there is no dataset /events/{name}", "see the dataset format in the docs")
            if column.dtype != _DTYPES[name] or column.ndim != 1:
                raise DataError(
                    self.path,
                    f"/events/{name} has type {column.dtype} and {column.ndim} dimensions",
                    f"store one row of {np.dtype(_DTYPES[name]).name}",
                )
        lengths = {name: len(column) for name, column in columns.items()}
        if len(set(lengths.values())) > 1:
            raise DataError(self.path, f"its columns have lengths {lengths}", "store all four with the same length")
        attributes = file["events"].attrs
        unit, offset = (_scalar(attributes.get(*item)) for item in (("time_unit", "ns"), ("time_offset", 0)))
        unit = unit.decode() if isinstance(unit, bytes) else unit
        if not isinstance(unit, str) or unit not in _NANOSECONDS:
            raise DataError(self.path, f"its time unit is {unit!r}", f"use one of {', '.join(_NANOSECONDS)}")
        if not isinstance(offset, (int, np.integer)):
            raise DataError(self.path, f"its time offset is {offset!r}", "use an integer in the unit of the times")
        return columns, _NANOSECONDS[unit], int(offset) * _NANOSECONDS[unit]

    def _read(self, column: h5py.Dataset, index: slice | int) -> Any:
        try:
            return column[index]
        except OSError as error:
            raise DataError(
                self.path,
                f"{column.name} cannot be read ({error})",
                "where a compression filter is missing, pip install 'aenerf-ns[hdf5-filters]'; else copy it again",
            ) from None

    def read_chunks(self) -> Iterator[EventStream]:
        with self._open() as file:
            columns, tick, offset = self._columns(file)
            for begin in range(0, len(columns["t"]), _CHUNK):
                part = {name: self._read(column, slice(begin, begin + _CHUNK)) for name, column in columns.items()}
                part["t"] = part["t"] * tick + offset
                yield EventStream(**part, width=self.width, height=self.height, source=self.path)

    def time_span(self) -> tuple[int, int]:
        with self._open() as file:
            columns, tick, offset = self._columns(file)
            if len(columns["t"]) == 0:
                raise self.empty_error()
            first, last = (int(self._read(columns["t"], index)) for index in (0, -1))
            return first * tick + offset, last * tick + offset

    def count(self) -> int:
        with self._open() as file:
            return len(self._columns(file)[0]["t"])


def _scalar(attribute: Any) -> Any:
    """The one value of an attribute, which some writers store as an array of one."""
    return attribute.item() if isinstance(attribute, np.ndarray) and attribute.size == 1 else attribute


class Hdf5EventWriter:
    """Writes events piece by piece. Use it as a context manager.

    Args:
        path: the file to create.
    """

    def __init__(self, path: Path) -> None:
        import h5py

        self._file = h5py.File(path, "w")
        group = self._file.create_group("events")
        group.attrs["time_unit"] = "ns"
        group.attrs["time_offset"] = 0
        self._columns = {
            name: group.create_dataset(
                name,
                shape=(0,),
                maxshape=(None,),
                dtype=dtype,
                chunks=(1 << 16,),
                compression="gzip",
                compression_opts=1,
                shuffle=True,
                # Equal content makes equal files.
                track_times=False,
            )
            for name, dtype in _DTYPES.items()
        }
        self._waiting: list[EventStream] = []
        self._last_time: int | None = None

    def __enter__(self) -> Hdf5EventWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self._flush()
        self._file.close()

    def append(self, events: EventStream) -> None:
        """Appends events.

        Raises:
            DataError: they are earlier than those already written.
        """
        if len(events) == 0:
            return
        if self._last_time is not None and events.t[0] < self._last_time:
            raise DataError(
                events.source, f"{events.t[0]} ns is before {self._last_time} ns", "sort the events by time"
            )
        self._last_time = int(events.t[-1])
        self._waiting.append(events)
        if sum(map(len, self._waiting)) >= _WRITE_CHUNK:
            self._flush()

    def _flush(self) -> None:
        if not self._waiting:
            return
        for name, column in self._columns.items():
            values = np.concatenate([getattr(events, name) for events in self._waiting])
            column.resize(len(column) + len(values), axis=0)
            column[len(column) - len(values) :] = values
        self._waiting = []
