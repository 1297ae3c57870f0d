"""Events in NumPy's files."""

from __future__ import annotations

import math
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Literal

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError
from aenerf_ns.files.event_reader import EventFile
from aenerf_ns.files.event_table import FORMATS_REMEDY, EventLayout, EventTableFile
from aenerf_ns.files.limits import bounded, require_unpacked_size
from aenerf_ns.files.text import TimeUnit

# Robust e-NeRF.
POSITION_TIMESTAMP_POLARITY = EventLayout(
    {"x": ("position", 0), "y": ("position", 1), "t": ("timestamp", None), "p": ("polarity", None)}, time_unit="ns"
)
# EventNeRF, and files that people write by themselves.
XYTP_MEMBERS = EventLayout({name: (name, None) for name in "xytp"})
# E-NeRF's ESIM, and files that people write by themselves.
XYTP_MATRIX = EventLayout({name: ("", index) for index, name in enumerate("xytp")})
_XYTP_RECORDS = EventLayout({name: ("", name) for name in "xytp"})


class ArrayEventFile(EventTableFile):
    """Read the members of an .npz file, or the one array of an .npy file, whose name is empty.

    Arrays are mapped into memory, but for compressed members, which are read as a whole.
    """

    kind = "NumPy file"

    @contextmanager
    def open_arrays(self) -> Iterator[dict[str, NDArray]]:
        names = self._layout.arrays
        yield {name: read_npz_member(self.path, name) if name else load_npy(self.path) for name in names}


def open_array_events(path: Path, width: int, height: int, time_unit: TimeUnit | None = None) -> EventFile:
    """Open an .npz or .npy file of events.

    An .npz file holds x, y, t and p, or position, timestamp and polarity as Robust e-NeRF has them. An .npy file holds
    a matrix whose first four columns are x, y, t and p, or records with fields of these names.

    Args:
        path, width, height: see :class:`EventFile`.
        time_unit: of the times. By default whole numbers are microseconds and decimals seconds.

    Raises:
        DataError: the file is missing or malformed, or holds no events in a known layout.
    """
    if path.suffix.lower() == ".npy":
        layout = XYTP_MATRIX if load_npy(path).dtype.names is None else _XYTP_RECORDS
        return ArrayEventFile(path, width, height, layout, time_unit)
    with bounded(path, ".npz file"), zipfile.ZipFile(path) as archive:
        names = {name.removesuffix(".npy") for name in archive.namelist()}
    for layout in (XYTP_MEMBERS, POSITION_TIMESTAMP_POLARITY):
        if layout.arrays <= names:
            return ArrayEventFile(path, width, height, layout, time_unit)
    problem = f"its arrays are {', '.join(sorted(names)) or 'none'}"
    raise DataError(path, problem, "it must hold x, y, t and p, or position, timestamp and polarity")


def read_npz_member(path: Path, name: str) -> NDArray:
    """Read an array of an .npz file, mapped into memory where it is not compressed.

    Raises:
        DataError: the file is missing or malformed, or has no such array, or the array holds Python objects or is
            larger than the file can explain.
    """
    with open_npz_member(path, name) as (member, entry):
        shape, order, dtype = _read_plain_header(member, entry.file_size)
        if entry.compress_type == zipfile.ZIP_STORED:
            with path.open("rb") as file:
                # The local header has a name and an extra field of other lengths (PKZIP's APPNOTE, 4.3.7).
                file.seek(entry.header_offset + 26)
                begin = entry.header_offset + 30 + sum(struct.unpack("<HH", file.read(4)))
            return np.memmap(path, dtype, "r", begin + member.tell(), shape, order)
        return np.ndarray(shape, dtype, member.read(math.prod(shape) * dtype.itemsize), order=order)


@contextmanager
def open_npz_member(path: Path, name: str) -> Iterator[tuple[IO[bytes], zipfile.ZipInfo]]:
    """Open the .npy file of an array in an .npz file. Errors of reading it within the context become a DataError.

    Raises:
        DataError: the file is missing or malformed, or has no such array, or the array is unpacked to a size that the
            file cannot explain.
    """
    with bounded(path, ".npz file"), zipfile.ZipFile(path) as archive:
        if f"{name}.npy" not in archive.namelist():
            raise DataError(path, f"it has no array {name}", FORMATS_REMEDY)
        entry = archive.getinfo(f"{name}.npy")
        require_unpacked_size(path, f"its array {name}", entry.file_size, min(entry.compress_size, path.stat().st_size))
        with bounded(path, f"array {name}"), archive.open(entry) as member:
            yield member, entry


def load_npy(path: Path) -> NDArray:
    """Map the array of an .npy file into memory.

    Raises:
        DataError: the file is missing or malformed, or its array holds Python objects.
    """
    with bounded(path, ".npy file"), path.open("rb") as file:
        shape, order, dtype = _read_plain_header(file, path.stat().st_size)
        return np.memmap(path, dtype, "r", file.tell(), shape, order)


def read_npy_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Read the shape of an array in an .npy file, whether its order is Fortran's, and its type."""
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(file)
    return np.lib.format.read_array_header_2_0(file)


def _read_plain_header(file: IO[bytes], size: int) -> tuple[tuple[int, ...], Literal["C", "F"], np.dtype]:
    """Read the header of an array, and check that it holds plain values and is as small as the file."""
    shape, is_fortran, dtype = read_npy_header(file)
    if dtype.hasobject:
        raise ValueError("it holds Python objects")
    # NumPy's size of an item overflows.
    is_valid = all(type(side) is int and side >= 0 for side in shape)
    if not is_valid or not 0 <= math.prod(shape) * dtype.itemsize <= size - file.tell():
        raise ValueError(f"its shape is {shape}, but it has {size:,} bytes")
    return shape, "F" if is_fortran else "C", dtype
