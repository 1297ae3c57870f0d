"""Events in NumPy's files."""

from __future__ import annotations

import math
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Literal

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError, reading
from aenerf_ns.events.stream import EventFile, require_event_file
from aenerf_ns.files.event_table import EventLayout, EventTableFile
from aenerf_ns.files.limits import require_file, require_unpacked_size
from aenerf_ns.files.text import TimeUnit

# Robust e-NeRF.
POSITION_TIMESTAMP_POLARITY = EventLayout(
    {"x": ("position", 0), "y": ("position", 1), "t": ("timestamp", None), "p": ("polarity", None)}, time_unit="ns"
)
# EventNeRF, and files that people write by themselves.
XYTP_MEMBERS = EventLayout({name: (name, None) for name in "xytp"}, time_unit=None)
# E-NeRF's ESIM, and files that people write by themselves.
XYTP_MATRIX = EventLayout({name: ("", index) for index, name in enumerate("xytp")}, time_unit=None)
_XYTP_RECORDS = EventLayout({name: ("", name) for name in "xytp"}, time_unit=None)


class NpzEventFile(EventTableFile):
    """Read an .npz file. Members that are not compressed are mapped into memory, others are read as a whole."""

    @contextmanager
    def open_arrays(self) -> Iterator[dict[str, NDArray]]:
        self.require()
        yield {name: read_npz_member(self.path, name) for name in self._layout.arrays}


class NpyEventFile(EventTableFile):
    """Read an .npy file: a matrix or an array of records, mapped into memory."""

    @contextmanager
    def open_arrays(self) -> Iterator[dict[str, NDArray]]:
        self.require()
        yield {"": load_npy(self.path)}


def open_array_events(path: Path, width: int, height: int, time_unit: TimeUnit | None = None) -> EventFile:
    """Open an .npz or .npy file of events. The names of its arrays tell the layout.

    An .npz file holds x, y, t and p, or position, timestamp and polarity as Robust e-NeRF has them. An .npy file holds
    a matrix whose first four columns are x, y, t and p, or records with fields of these names.

    Args:
        path: the file.
        width: number of pixel columns of the sensor.
        height: number of pixel rows of the sensor.
        time_unit: of the times. By default whole numbers are microseconds and decimals seconds.

    Raises:
        DataError: the file is missing or malformed, or holds no events in a known layout.
    """
    suffix = path.suffix.lower()
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
    """Return the names of the arrays in an .npz file.

    Raises:
        DataError: the file is missing or not an .npz file.
    """
    with _open_npz(path) as archive:
        return {name.removesuffix(".npy") for name in archive.namelist()}


def read_npz_member(path: Path, name: str) -> NDArray:
    """Return an array of an .npz file, mapped into memory where it is not compressed.

    Raises:
        DataError: the file is missing or malformed, or has no such array, or the array holds Python objects or is
            larger than the file can explain.
    """
    with open_npz_member(path, name) as (member, entry):
        header = _read_npy_header(member, entry.file_size)
        if header.dtype.hasobject:
            raise ValueError("it holds Python objects")
        if entry.compress_type == zipfile.ZIP_STORED and header.num_bytes and header.shape:
            with path.open("rb") as file:
                # The local header has a name and an extra field of other lengths (PKZIP's APPNOTE, 4.3.7).
                file.seek(entry.header_offset + 26)
                start = entry.header_offset + 30 + sum(struct.unpack("<HH", file.read(4))) + header.end
            return np.memmap(path, header.dtype, "r", start, header.shape, header.order)
        values = np.frombuffer(member.read(header.num_bytes), np.uint8)
        if len(values) < header.num_bytes:
            raise ValueError("it ends too early")
        return np.ndarray(header.shape, header.dtype, values, order=header.order)


@contextmanager
def open_npz_member(path: Path, name: str) -> Iterator[tuple[IO[bytes], zipfile.ZipInfo]]:
    """Open the .npy file of an array in an .npz file. Errors of reading it within the context become a DataError.

    Raises:
        DataError: the file is missing or malformed, or has no such array, or the array is unpacked to a size that the
            file cannot explain.
    """
    with _open_npz(path) as archive:
        try:
            entry = archive.getinfo(f"{name}.npy")
        except KeyError:
            raise DataError(path, f"it has no array {name}", "see the formats in the docs") from None
        require_unpacked_size(path, f"its array {name}", entry.file_size, min(entry.compress_size, path.stat().st_size))
        with _errors_as(path, f"its array {name} cannot be read"), archive.open(entry) as member:
            yield member, entry


@contextmanager
def _open_npz(path: Path) -> Iterator[zipfile.ZipFile]:
    with reading(path):
        require_file(path)
        try:
            archive = zipfile.ZipFile(path)
        except (zipfile.BadZipFile, ValueError, NotImplementedError, struct.error) as error:
            raise DataError(path, f"not a readable .npz file ({error})", "write or copy it again") from None
    with archive:
        yield archive


@contextmanager
def _errors_as(path: Path, problem: str) -> Iterator[None]:
    """Turn the errors of zipfile and NumPy within the context, for damaged or other files, into a DataError."""
    try:
        yield
    except DataError:
        raise
    # zipfile, zlib, NumPy and the tokenizer it reads headers with raise whatever they stumble over.
    except Exception as error:
        raise DataError(path, f"{problem} ({error})", "write or copy it again") from None


@dataclass(frozen=True)
class _NpyHeader:
    """The form of an array in an .npy file, and where its values begin in bytes."""

    shape: tuple[int, ...]
    dtype: np.dtype
    order: Literal["C", "F"]
    end: int

    @property
    def num_bytes(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize


def _read_npy_header(file: IO[bytes], num_bytes: int) -> _NpyHeader:
    """Read the header of an .npy file of a number of bytes, and check that its array is as small as the file.

    Raises:
        ValueError, or another error: the header is malformed or the array larger.
    """
    shape, is_fortran, dtype = read_npy_header(file)
    if not all(type(side) is int and side >= 0 for side in shape):
        raise ValueError(f"its shape is {shape}")
    header = _NpyHeader(shape, dtype, "F" if is_fortran else "C", file.tell())
    # NumPy's size of an item overflows.
    if not dtype.hasobject and not 0 <= header.num_bytes <= num_bytes - header.end:
        raise ValueError(f"its shape is {shape}, but it has {num_bytes:,} bytes")
    return header


def read_npy_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return shape, whether the order is Fortran's, and type of the array in an .npy file."""
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(file)
    return np.lib.format.read_array_header_2_0(file)


def load_npy(path: Path) -> NDArray:
    """Return the array of an .npy file, mapped into memory.

    Raises:
        DataError: the file is missing or malformed, or its array holds Python objects.
    """
    with reading(path):
        require_file(path)
        with path.open("rb") as file, _errors_as(path, "not a readable .npy file"):
            if file.read(2) == b"PK":
                raise DataError(path, "it is an archive of several arrays", "name it .npz")
            file.seek(0)
            header = _read_npy_header(file, path.stat().st_size)
            if header.dtype.hasobject:
                raise ValueError("it holds Python objects")
            if not header.num_bytes or not header.shape:
                return np.zeros(header.shape, header.dtype)
            return np.memmap(path, header.dtype, "r", header.end, header.shape, header.order)
