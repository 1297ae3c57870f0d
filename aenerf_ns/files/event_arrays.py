"""Events in NumPy's files and in CSV."""

from __future__ import annotations

import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventFile, EventStream, require_event_file
from aenerf_ns.files.event_table import (
    SAMPLE,
    EventLayout,
    EventTableFile,
    events_from_columns,
    guess_time_unit,
)
from aenerf_ns.files.text import NANOSECONDS, TimeUnit, first_and_last_row, is_row

# Robust e-NeRF.
POSITION_TIMESTAMP_POLARITY = EventLayout(
    {"x": ("position", 0), "y": ("position", 1), "t": ("timestamp", None), "p": ("polarity", None)}, time_unit="ns"
)
# EventNeRF, and what people write by themselves.
XYTP_MEMBERS = EventLayout({name: (name, None) for name in "xytp"}, time_unit=None)
# E-NeRF's ESIM, and what people write by themselves.
XYTP_MATRIX = EventLayout({name: ("", index) for index, name in enumerate("xytp")}, time_unit=None)
_XYTP_RECORDS = EventLayout({name: ("", name) for name in "xytp"}, time_unit=None)

_CHUNK_LINES = 1_000_000
# What zipfile and NumPy raise for files that are damaged or not theirs.
NPZ_ERRORS = (
    ValueError,
    OSError,
    EOFError,
    NotImplementedError,
    RuntimeError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
)


class NpzEventFile(EventTableFile):
    """An .npz file. Members that are not compressed are mapped into memory, others are read as a whole."""

    @contextmanager
    def open_arrays(self) -> Iterator[dict[str, NDArray]]:
        self.require()
        yield {name: read_npz_member(self.path, name) for name in self._layout.arrays}


class NpyEventFile(EventTableFile):
    """An .npy file: a matrix or an array of records, mapped into memory."""

    @contextmanager
    def open_arrays(self) -> Iterator[dict[str, NDArray]]:
        self.require()
        yield {"": load_npy(self.path)}


class CsvEventFile(EventFile):
    """Comma-separated values; the first line names the columns, x, y, t and p among them, in any order.

    Args:
        path: the file.
        width: number of pixel columns of the sensor.
        height: number of pixel rows of the sensor.
        time_unit: of the times, or None for the rule of :func:`guess_time_unit`.
    """

    def __init__(self, path: Path, width: int, height: int, time_unit: TimeUnit | None = None) -> None:
        super().__init__(path, width, height)
        self._time_unit = time_unit

    def read_chunks(self) -> Iterator[EventStream]:
        with self.path.open(encoding="utf-8", errors="replace") as file:
            names = self._names(next((line for line in file if is_row(line.encode())), ""))
            tick, done = None, 0
            while block := list(islice(file, _CHUNK_LINES)):
                columns = self._parse(block, names)
                if tick is None and len(columns["t"]):
                    tick = NANOSECONDS[self._time_unit or guess_time_unit(columns["t"][:SAMPLE])]
                if tick is not None:
                    yield self._events(columns, tick, done)
                    done += len(columns["t"])

    def time_span(self) -> tuple[int, int]:
        self.require()
        header, last = first_and_last_row(self.path)
        names = self._names(header)
        if last.strip() == header.strip():
            raise self.empty_error()
        with self.path.open(encoding="utf-8", errors="replace") as file:
            rows = (line for line in file if is_row(line.encode()))
            next(rows)
            sample = self._parse(list(islice(rows, SAMPLE)), names)
        tick = NANOSECONDS[self._time_unit or guess_time_unit(sample["t"])]
        first = {name: column[:1] for name, column in sample.items()}
        start, end = (int(self._events(row, tick, 0).t[0]) for row in (first, self._parse([last], names)))
        return start, end

    def _names(self, header: str) -> list[str]:
        names = [name.strip().strip('"').lower() for name in header.split(",")]
        if not set("xytp") <= set(names):
            raise DataError(
                self.path,
                f"its first line is {header.strip()[:60]!r}",
                "it must name the columns, x, y, t and p among them, separated by commas",
            )
        return names

    def _parse(self, block: list[str], names: list[str]) -> dict[str, NDArray]:
        first = next((line for line in block if is_row(line.encode())), "")
        # Integers are exact, also where float64 is not.
        whole = all(field.strip().lstrip("+-").isdigit() for field in first.split("#")[0].split(","))
        for dtype in (np.int64, np.float64) if whole else (np.float64,):
            try:
                with warnings.catch_warnings():
                    # What NumPy says when it cuts the decimals off a later line.
                    warnings.simplefilter("error", DeprecationWarning)
                    table = np.loadtxt(block, dtype=dtype, delimiter=",", ndmin=2)
                break
            except (ValueError, OverflowError, DeprecationWarning) as failure:
                error = failure
        else:
            raise DataError(self.path, f"it holds what is not a number ({error})", "write numbers only")
        if table.size == 0:
            table = table.reshape(0, len(names))
        if table.shape[1] != len(names):
            raise DataError(
                self.path,
                f"its lines have {table.shape[1]} fields, its header {len(names)}",
                "give every line a field for each name",
            )
        return {name: table[:, names.index(name)] for name in "xytp"}

    def _events(self, columns: dict[str, NDArray], tick: int, first: int) -> EventStream:
        return events_from_columns(
            columns, width=self.width, height=self.height, tick=tick, source=self.path, first=first
        )


def open_array_events(path: Path, width: int, height: int, time_unit: TimeUnit | None = None) -> EventFile:
    """An .npz, .npy or .csv file of events, told from its content.

    .npz: x, y, t and p, or position, timestamp and polarity as Robust e-NeRF has them. .npy: a matrix whose first four
    columns are x, y, t and p, or records with fields of these names.

    Args:
        path: the file.
        width: number of pixel columns of the sensor.
        height: number of pixel rows of the sensor.
        time_unit: of its times. By default whole numbers are microseconds and decimals seconds.

    Raises:
        DataError: the file is missing or malformed, or holds no events in a known layout.
    """
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return CsvEventFile(path, width, height, time_unit)
    require_event_file(path)
    if suffix == ".npy":
        layout = XYTP_MATRIX if load_npy(path).dtype.names is None else _XYTP_RECORDS
        return NpyEventFile(path, width, height, layout, time_unit)
    names = npz_members(path)
    for layout in (XYTP_MEMBERS, POSITION_TIMESTAMP_POLARITY):
        if layout.arrays <= names:
            return NpzEventFile(path, width, height, layout, time_unit)
    raise DataError(
        path,
        f"its arrays are {', '.join(sorted(names)) or 'none'}",
        "it must hold x, y, t and p, or position, timestamp and polarity",
    )


def npz_members(path: Path) -> set[str]:
    """The names of the arrays in an .npz file.

    Raises:
        DataError: the file is missing or not an .npz file.
    """
    with _open_npz(path) as archive:
        return {name.removesuffix(".npy") for name in archive.namelist()}


def read_npz_member(path: Path, name: str) -> NDArray:
    """An array of an .npz file, mapped into memory where it is not compressed.

    Raises:
        DataError: the file is missing or malformed, or has no such array, or one of Python objects.
    """
    with _open_npz(path) as archive:
        try:
            entry = archive.getinfo(f"{name}.npy")
        except KeyError:
            raise DataError(path, f"it has no array {name}", "see the formats in the docs") from None
        try:
            with archive.open(entry) as member:
                if entry.compress_type != zipfile.ZIP_STORED:
                    return np.lib.format.read_array(member, allow_pickle=False)
                shape, fortran, dtype = read_npy_header(member)
                header = member.tell()
            if dtype.hasobject or 0 in shape or shape == ():
                with archive.open(entry) as member:
                    return np.lib.format.read_array(member, allow_pickle=False)
            with path.open("rb") as file:
                # The local header repeats name and extra field, of lengths of its own (PKZIP's APPNOTE, 4.3.7).
                file.seek(entry.header_offset + 26)
                start = entry.header_offset + 30 + sum(struct.unpack("<HH", file.read(4))) + header
            return np.memmap(path, dtype, "r", start, shape, "F" if fortran else "C")
        except NPZ_ERRORS as error:
            raise DataError(path, f"its array {name} cannot be read ({error})", "write or copy it again") from None


def _open_npz(path: Path) -> zipfile.ZipFile:
    if not path.is_file():
        raise DataError(path, "there is no such file", "check the path of the dataset")
    try:
        return zipfile.ZipFile(path)
    except (zipfile.BadZipFile, OSError) as error:
        raise DataError(path, f"not a readable .npz file ({error})", "write or copy it again") from None


def read_npy_header(file: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(file)
    return np.lib.format.read_array_header_2_0(file)


def load_npy(path: Path) -> NDArray:
    """The array of an .npy file, mapped into memory.

    Raises:
        DataError: the file is malformed, or an array of Python objects.
    """
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise DataError(path, f"not a readable .npy file ({error})", "write or copy it again") from None
    if not isinstance(array, np.ndarray):
        raise DataError(path, "it is an archive of several arrays", "name it .npz")
    return array
