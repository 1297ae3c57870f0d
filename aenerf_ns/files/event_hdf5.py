"""Events in HDF5: the event file of the native dataset format, and the files of other projects."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventStream
from aenerf_ns.files.event_reader import EventFile, resolve_sensor_size
from aenerf_ns.files.event_table import FORMATS_REMEDY, EventLayout, EventTableFile
from aenerf_ns.files.limits import bounded, require_unpacked_size
from aenerf_ns.files.prophesee import PropheseeHeader
from aenerf_ns.files.text import NANOSECONDS, TimeUnit

if TYPE_CHECKING:
    import h5py

_DTYPES = {"x": np.uint16, "y": np.uint16, "t": np.int64, "p": np.int8}
# The number of the HDF5 filter of Prophesee's compression of events.
_ECF = 0x8ECF
# Events collected before they are written: many small writes are slow.
_WRITE_CHUNK = 1 << 18
# Bytes that HDF5 may hold back: pieces of four columns that are not full, and its tables.
_HELD_BYTES = 1 << 22


def _columns_of(group: str) -> dict[str, tuple[str, None]]:
    return {name: (f"{group}{name}", None) for name in _DTYPES}


_NATIVE = EventLayout(_columns_of("events/"), "ns")
# DSEC, and TUM-VIE, which has no offset.
COLUMNS_IN_GROUP = EventLayout(_columns_of("events/"), time_offset="t_offset")
# event_utils, in which many datasets with frames are published.
_PLURAL_COLUMNS = EventLayout({name: (f"events/{name}s", None) for name in _DTYPES})
# EDS.
COLUMNS_AT_TOP = EventLayout(_columns_of(""), time_offset="t_offset")
# PAEv3D.
TXYP_MATRIX = EventLayout({name: ("events", index) for index, name in enumerate("txyp")})
# Prophesee's Metavision.
PROPHESEE_RECORDS = EventLayout({name: ("CD/events", name) for name in _DTYPES})

_LAYOUTS = (PROPHESEE_RECORDS, COLUMNS_IN_GROUP, _PLURAL_COLUMNS, COLUMNS_AT_TOP, TXYP_MATRIX)


class Hdf5TableFile(EventTableFile):
    """Read an HDF5 file.

    The group of the times may have the attributes ``time_unit`` ("ns", "us", "ms" or "s") and ``time_offset`` (an
    integer in that unit, added to every time).
    """

    kind = "HDF5 file"

    @contextmanager
    def open_arrays(self) -> Iterator[dict[str, Any]]:
        with _open(self.path) as file:
            arrays: dict[str, Any] = {name: _require_dataset(self.path, file, name) for name in self._layout.arrays}
            # NumPy's sizes overflow.
            size = sum(math.prod(array.shape) * array.dtype.itemsize for array in arrays.values())
            packed = sum(array.id.get_storage_size() for array in arrays.values())
            require_unpacked_size(self.path, "its events", size, packed)
            offset = _scalar(self._time_offset(file))
            # NumPy and MATLAB make a float64 of it, which is exact up to there.
            is_whole = isinstance(offset, float) and abs(offset) < 1 << 53 and offset.is_integer()
            if not is_whole and not isinstance(offset, (int, np.integer)):
                name = self._layout.time_offset or "time_offset"
                raise DataError(self.path, f"its {name} is {offset!r}", "store an integer")
            yield {**arrays, "time_offset": int(offset)}

    def _time_offset(self, file: h5py.File) -> Any:
        name = self._layout.time_offset
        if name is None or name not in file:
            return self._attributes(file).get("time_offset", 0)
        offset = _dataset(self.path, file, name)
        return None if offset is None else offset[()]

    def _attributes(self, arrays: Mapping[str, Any]) -> Mapping[str, Any]:
        return arrays[self._layout.columns["t"][0]].parent.attrs

    def _stated_unit(self, arrays: Mapping[str, Any]) -> TimeUnit | None:
        unit = _scalar(self._attributes(arrays).get("time_unit"))
        if unit is not None and not (isinstance(unit, str) and unit in NANOSECONDS):
            raise DataError(self.path, f"its time unit is {unit!r}", f"use one of {', '.join(NANOSECONDS)}")
        if unit and self._given_unit not in (None, unit):
            problem = f"it states its time unit, {unit!r}, but {self._given_unit} was given"
            raise DataError(self.path, problem, "leave it out")
        return unit


class Hdf5EventFile(Hdf5TableFile):
    """Read the native file: /events/{x u16, y u16, t i64, p i8}, with p = ±1.

    Where it does not state a unit of the times, it is the nanosecond.
    """

    def __init__(self, path: Path, width: int, height: int) -> None:
        super().__init__(path, width, height, _NATIVE)

    def _length(self, arrays: Mapping[str, Any]) -> int:
        for name, dtype in _DTYPES.items():
            column = arrays[f"events/{name}"]
            if column.dtype != dtype:
                problem = f"/events/{name} has type {column.dtype}"
                raise DataError(self.path, problem, f"store one row of {np.dtype(dtype).name}")
        return super()._length(arrays)

    def _columns(self, arrays: Mapping[str, Any], first: int, last: int | None) -> dict[str, NDArray]:
        columns = super()._columns(arrays, first, last)
        if not columns["p"].all():
            raise DataError(self.path, "an event has polarity 0", "store polarities as -1 and +1")
        return columns


def open_hdf5_events(path: Path, width: int | None, height: int | None, time_unit: TimeUnit | None = None) -> EventFile:
    """Open an HDF5 file of events. The names in it tell the layout.

    Args:
        path: the file.
        width, height: size of the sensor in pixels; needed where the file has no ``geometry``, as Metavision's have.
        time_unit: of the times, where the file states none. By default whole numbers are microseconds and decimals
            seconds.

    Raises:
        DataError: the file is missing or not HDF5, or holds no events in a known layout, or a size is not known.
    """
    with bounded(path, "HDF5 file"), _open(path) as file:
        stated = PropheseeHeader({"geometry": str(_scalar(file.attrs.get("geometry")))}, 0).size
        for layout in _LAYOUTS:
            if all(_dataset(path, file, name) is not None for name in layout.arrays):
                return Hdf5TableFile(path, *resolve_sensor_size(path, stated, width, height), layout, time_unit)
        remedy = "events must be in /events/{x,y,t,p} or {xs,ys,ts,ps}, /x, /y, /t, /p, /CD/events, or a matrix /events"
        raise DataError(path, f"it holds {', '.join(sorted(file)) or 'nothing'}", remedy)


def _open(path: Path) -> h5py.File:
    # Imported lazily: every command of every method imports this module.
    import h5py

    with suppress(ImportError):
        # The import registers Blosc and other compression filters, where the extra is installed.
        import hdf5plugin  # noqa: F401
    # h5py's messages for a missing file and a missing right do not name them.
    path.open("rb").close()
    return h5py.File(path, "r")


def _dataset(path: Path, file: h5py.File, name: str) -> h5py.Dataset | None:
    """Return a dataset of a file, or None where there is none of this name.

    Raises:
        DataError: it has no values, or has them in another file.
    """
    import h5py

    dataset = file.get(name)
    if not isinstance(dataset, h5py.Dataset):
        return None
    if dataset.file.filename != file.filename or dataset.external or dataset.is_virtual:
        raise DataError(path, f"{dataset.name} is a link to another file", "copy its values into this file")
    if dataset.shape is None:
        raise DataError(path, f"{dataset.name} has no values", "write it again")
    return dataset


def _require_dataset(path: Path, file: h5py.File, name: str) -> h5py.Dataset:
    """Return a dataset of a file.

    Raises:
        DataError: it is missing, has no values here, or is compressed by a filter that is not installed.
    """
    import h5py

    dataset = _dataset(path, file, name)
    if dataset is None:
        raise DataError(path, f"there is no dataset /{name}", FORMATS_REMEDY)
    settings = dataset.id.get_create_plist()
    filters = {settings.get_filter(index)[0] for index in range(settings.get_nfilters())}
    missing = {code for code in filters if not h5py.h5z.filter_avail(code)}
    if missing:
        remedy = "pip install 'aenerf-ns[hdf5-filters]' for its compression filter"
        if _ECF in missing:
            remedy = (
                "it is compressed by Prophesee's ECF filter: install that plugin of HDF5 "
                "(github.com/prophesee-ai/hdf5_ecf) and set HDF5_PLUGIN_PATH to its folder, or record or export to RAW"
            )
        raise DataError(path, f"{dataset.name} cannot be read without filter {min(missing)} of HDF5", remedy)
    return dataset


def _scalar(value: Any) -> Any:
    """Return a number or text. Some writers store it as an array of one value."""
    value = value.item() if isinstance(value, np.ndarray) and value.size == 1 else value
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value


class Hdf5EventWriter:
    """Write events piece by piece. Use it as a context manager.

    Args:
        path: the file to create.

    Raises:
        OSError: the file cannot be written, such as on a full disk.

    Attributes:
        num_events: events that were appended.
    """

    def __init__(self, path: Path) -> None:
        import h5py

        self._path = path
        self._file = h5py.File(path, "w")
        self._reserved = 0
        self._waiting: list[EventStream] = []
        self.num_events = 0
        self._last_time: int | None = None
        try:
            self._reserve(0)
            group = self._file.create_group("events")
            group.attrs["time_unit"] = "ns"
            group.attrs["time_offset"] = 0
            layout: dict[str, Any] = {"shape": (0,), "maxshape": (None,), "chunks": (1 << 16,), "shuffle": True}
            layout |= {"compression": "gzip", "compression_opts": 1}
            self._columns = {name: group.create_dataset(name, dtype=dtype, **layout) for name, dtype in _DTYPES.items()}
        except OSError:
            self._file.close()
            raise

    def _reserve(self, num_bytes: int) -> None:
        """Take room on the disk for what HDF5 is about to write, and for all that it holds until the file is closed.

        HDF5 can neither go on nor close a file after a write that failed, and the process ends with a segmentation
        fault. So a full disk is found here.

        Raises:
            OSError: there is no such room.
        """
        end = self._file.id.get_filesize() + num_bytes + _HELD_BYTES
        if end > self._reserved:
            os.posix_fallocate(self._file.id.get_vfd_handle(), self._reserved, end - self._reserved)
            self._reserved = end

    def __enter__(self) -> Hdf5EventWriter:
        return self

    def __exit__(self, error_type: type[BaseException] | None = None, *_: object) -> None:
        try:
            if error_type is None:
                self._flush()
        finally:
            self._file.flush()
            size = self._file.id.get_filesize()
            self._file.close()
            # Gives back what was reserved and not used.
            os.truncate(self._path, size)

    def append(self, events: EventStream) -> None:
        """Append events.

        Raises:
            DataError: the events are earlier than the last event written.
        """
        if len(events) == 0:
            return
        if self._last_time is not None and events.t[0] < self._last_time:
            problem = f"{events.t[0]} ns is before {self._last_time} ns"
            raise DataError(events.source, problem, "sort the events by time")
        self._last_time = int(events.t[-1])
        self._waiting.append(events)
        self.num_events += len(events)
        if self.num_events - len(self._columns["t"]) >= _WRITE_CHUNK:
            self._flush()

    def _flush(self) -> None:
        if not self._waiting:
            return
        num_written = len(self._columns["t"])
        self._reserve((self.num_events - num_written) * sum(np.dtype(dtype).itemsize for dtype in _DTYPES.values()))
        for name, column in self._columns.items():
            column.resize(self.num_events, axis=0)
            column[num_written:] = np.concatenate([getattr(events, name) for events in self._waiting])
        self._waiting = []
