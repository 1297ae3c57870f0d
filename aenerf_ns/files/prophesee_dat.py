"""DAT files of Prophesee's tools and datasets.

https://docs.prophesee.ai/stable/data/file_formats/dat.html
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError, reading
from aenerf_ns.events.stream import EventFile, EventStream
from aenerf_ns.files.prophesee_header import read_header
from aenerf_ns.files.sensor_size import sensor_size

_CHUNK = 1 << 20
# Microseconds, then 14 bits of x, 14 of y and 4 of polarity.
_RECORD = np.dtype([("time", "<u4"), ("address", "<u4")])
# Records of Event2d and of EventCd have the same fields.
_EVENT_TYPES = (0x00, 0x0C)
_LAP = 1 << 32
# Number of times read to find how often the times wrapped. Between two of them less than half a lap, 36 min, may pass.
_MAX_SAMPLES = 10_000


class PropheseeDatFile(EventFile):
    """Read a DAT file of version 2: a text header, the type and size of a record, then records of 8 bytes.

    Args:
        path: the file.
        width: pixel columns of the sensor; needed where the header does not tell them. With both sizes given, the file
            is not opened before its events are asked for.
        height: pixel rows of the sensor; needed where the file does not tell them.

    Raises:
        DataError: a size is not given, and the file is missing or its header does not tell it.
    """

    def __init__(self, path: Path, width: int | None = None, height: int | None = None) -> None:
        if width is None or height is None:
            width, height = sensor_size(path, read_header(path).size, width, height)
        super().__init__(path, width, height)

    def _records(self) -> tuple[int, int]:
        """Return the position of the first record, and the number of records."""
        header = read_header(self.path)
        sensor_size(self.path, header.size, self.width, self.height)
        version = header.fields.get("version", "none")
        if version != "2":
            raise DataError(self.path, f"its version is {version}; version 2 is read", "convert it with Metavision")
        with reading(self.path), self.path.open("rb") as file:
            file.seek(header.end)
            kind = file.read(2)
        if len(kind) < 2 or kind[0] not in _EVENT_TYPES or kind[1] != _RECORD.itemsize:
            raise DataError(
                self.path, f"its records are of type and size {kind.hex(' ') or 'none'}, not events", "record it again"
            )
        begin = header.end + len(kind)
        count, rest = divmod(self.path.stat().st_size - begin, _RECORD.itemsize)
        if rest:
            raise DataError(self.path, f"it ends within a record of {_RECORD.itemsize} bytes", "copy it again")
        return begin, count

    def count(self) -> int:
        return self._records()[1]

    def read_chunks(self) -> Iterator[EventStream]:
        previous = None
        begin, count = self._records()
        with reading(self.path), self.path.open("rb") as file:
            file.seek(begin)
            for _ in range(0, count, _CHUNK):
                records = np.fromfile(file, _RECORD, _CHUNK)
                time = _unwrapped(records["time"], previous)
                previous = int(time[-1])
                address = records["address"]
                yield EventStream(
                    (address & 0x3FFF).astype(np.uint16),
                    ((address >> 14) & 0x3FFF).astype(np.uint16),
                    time * 1000,
                    2 * (address >> 28).astype(np.int8) - 1,
                    self.width,
                    self.height,
                    self.path,
                )

    def time_span(self) -> tuple[int, int]:
        begin, count = self._records()
        if count == 0:
            raise self.empty_error()
        samples = []
        with reading(self.path), self.path.open("rb") as file:
            for index in (*range(0, count, max(1, count // _MAX_SAMPLES)), count - 1):
                file.seek(begin + index * _RECORD.itemsize)
                samples.append(np.fromfile(file, _RECORD, 1)["time"])
        time = _unwrapped(np.concatenate(samples), None)
        return int(time[0]) * 1000, int(time[-1]) * 1000


def _unwrapped(time: NDArray[np.uint32], previous: int | None) -> NDArray[np.int64]:
    """Return the (N,) microseconds of times whose upper bits are cut off. Each time is the nearest to its predecessor.

    Args:
        time: (N,) lower 32 bits of times.
        previous: the whole time before the first one, or None at the beginning.
    """
    steps = np.diff(time.astype(np.int64), prepend=int(time[0]) if previous is None else previous)
    steps = (steps + _LAP // 2) % _LAP - _LAP // 2
    return (int(time[0]) if previous is None else previous) + np.cumsum(steps)
