"""Events in NumPy's files."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventFile, require_event_file
from aenerf_ns.files.event_table import EventLayout, EventTableFile
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

# The exceptions of zipfile and NumPy for files that are damaged or in another format.
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
        DataError: the file is missing or malformed, or has no such array, or the array holds Python objects.
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
                # The local header has a name and an extra field of other lengths (PKZIP's APPNOTE, 4.3.7).
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
    """Return the array of an .npy file, mapped into memory.

    Raises:
        DataError: the file is malformed, or its array holds Python objects.
    """
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise DataError(path, f"not a readable .npy file ({error})", "write or copy it again") from None
    if not isinstance(array, np.ndarray):
        raise DataError(path, "it is an archive of several arrays", "name it .npz")
    return array
