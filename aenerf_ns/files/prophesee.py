"""RAW and DAT files of Prophesee's cameras, tools and datasets.

https://docs.prophesee.ai/stable/data/file_formats/raw.html and dat.html

The package faery was tried and is not used: where a camera pauses it loses laps of the times of EVT 3.0, and it reads
files that are cut or damaged without a word.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventStream
from aenerf_ns.files.event_reader import CHUNK, EventFile, resolve_sensor_size

if TYPE_CHECKING:
    from aenerf_ns.files.evt_words import Encoding

HEADER_BYTES = 1 << 16
"""Far more bytes than any header has."""

BLOCK = 1 << 20
"""Words of a RAW file that are read at once."""

# Cameras send the upper bits of a time at least every 5 ms, in which no camera sends this many words.
_MAX_TIMELESS = 1 << 20

# A record of a DAT file: microseconds, then 14 bits of x, 14 of y and 4 of polarity.
_RECORD = np.dtype([("time", "<u4"), ("address", "<u4")])
# Records of Event2d and of EventCd have the same fields.
_EVENT_TYPES = (0x00, 0x0C)
# Only the lower 32 bits of a time are known: each time is the nearest to its predecessor.
_LAP = 1 << 32
# Times that are read to count how often they wrapped. Two neighbors must be less than half a lap, 36 min, apart.
_MAX_SAMPLES = 10_000


@dataclass(frozen=True)
class PropheseeHeader:
    """The values by lower-case keyword of the lines ``% keyword value`` that begin a RAW or DAT file, and their end."""

    fields: dict[str, str]
    end: int

    @classmethod
    def parse(cls, path: Path, beginning: bytes) -> PropheseeHeader:
        """Parse the first :data:`HEADER_BYTES` of a file.

        Raises:
            DataError: a line does not end.
        """
        fields: dict[str, str] = {}
        end = 0
        # The keyword "end" is optional. Without it, the header ends at the first line that does not begin with "% ".
        # Empty ones have no blank.
        while beginning.startswith((b"% ", b"%\n", b"%\r\n"), end):
            line_end = beginning.find(b"\n", end) + 1
            if line_end == 0:
                raise DataError(path, f"line {len(fields) + 1} of its header does not end", "record or copy it again")
            keyword, _, value = beginning[end + 2 : line_end].decode("ascii", "replace").strip().partition(" ")
            end = line_end
            if keyword.lower() == "end":
                break
            fields[keyword.lower()] = value.strip()
        return cls(fields, end)

    @property
    def format_options(self) -> dict[str, str]:
        """The options of ``% format NAME;option=value;…``, and its name in capitals as the option "name"."""
        name, *options = self.fields.get("format", "").split(";")
        pairs = (option.partition("=") for option in options)
        return {"name": name.strip().upper(), **{key.strip().lower(): value.strip() for key, _, value in pairs}}

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height of the sensor in pixels, or None where the header does not state them."""
        geometry = re.fullmatch(r"(\d{1,9})\s*x\s*(\d{1,9})", self.fields.get("geometry", ""))
        if geometry:
            return int(geometry[1]), int(geometry[2])
        for source in (self.format_options, self.fields):
            sizes = [source.get(name, "") for name in ("width", "height")]
            if all(re.fullmatch(r"\d{1,9}", size) for size in sizes):
                return int(sizes[0]), int(sizes[1])
        return None


class PropheseeRawFile(EventFile):
    """Read a RAW file: a header, then the words that the camera sent, in EVT 2.0 or EVT 3.0.

    The size of the sensor is None where the header states it.

    Raises:
        DataError: the encoding is not one that is read, or a size is not known.
    """

    kind = "RAW file"

    def __init__(self, path: Path, header: PropheseeHeader, width: int | None, height: int | None) -> None:
        super().__init__(path, *resolve_sensor_size(path, header.size, width, height))
        self._encoding, self._begin = _encoding_name(path, header), header.end

    def read_chunks(self) -> Iterator[EventStream]:
        # Imported lazily: every command of every method imports this module, and numba is slow to import.
        from aenerf_ns.files.evt_words import EVT2, EVT3, decode_words, initial_state, without_damaged_times

        encoding = EVT2 if self._encoding == "EVT2" else EVT3
        blocks = without_damaged_times(self._blocks(encoding), encoding, self.left_out)
        for columns in decode_words(blocks, encoding, initial_state(), self.path):
            yield self._stream(columns)

    def _blocks(self, encoding: Encoding) -> Iterator[NDArray]:
        from aenerf_ns.files.evt_words import TIME_HIGH

        dtype = encoding.dtype
        size = self.path.stat().st_size
        if rest := (size - self._begin) % dtype.itemsize:
            self._leave_out_end(f"a word of {dtype.itemsize} bytes", size - rest)
        with self.path.open("rb") as file:
            file.seek(self._begin)
            while len(block := np.fromfile(file, dtype, BLOCK)):
                if len(block) >= _MAX_TIMELESS and not (encoding.kinds(block) == TIME_HIGH).any():
                    problem = f"{len(block):,} words without the upper bits of a time end at byte {file.tell():,}"
                    raise DataError(self.path, problem, "copy it again")
                yield block


def _encoding_name(path: Path, header: PropheseeHeader) -> str:
    """Return EVT2 or EVT3."""
    options = header.format_options
    version = header.fields.get("evt", "")
    name = options["name"] or {"2.0": "EVT2", "2.1": "EVT21", "3.0": "EVT3"}.get(version, version)
    if not name:
        remedy = 'add the line "% evt 2.0" or "% evt 3.0", or convert it with metavision_file_to_dat'
        raise DataError(path, "its header does not state the encoding of the events", remedy)
    if name not in ("EVT2", "EVT3") or options.get("endianness", "little") != "little":
        raise DataError(
            path,
            f"its events are encoded as {header.fields.get('format', version)}; EVT2 and EVT3, little-endian, are read",
            "convert it with metavision_file_to_dat",
        )
    return name


class PropheseeDatFile(EventFile):
    """Read a DAT file of version 2: a header, the type and size of a record, then records of 8 bytes.

    The size of the sensor is None where the header states it.

    Raises:
        DataError: the version or the records are not those that are read, or a size is not known.
    """

    kind = "DAT file"

    def __init__(self, path: Path, header: PropheseeHeader, width: int | None, height: int | None) -> None:
        super().__init__(path, *resolve_sensor_size(path, header.size, width, height))
        version = header.fields.get("version", "none")
        if version != "2":
            raise DataError(path, f"its version is {version}; version 2 is read", "convert it with Metavision")
        with path.open("rb") as file:
            file.seek(header.end)
            kind = file.read(2)
        if len(kind) < 2 or kind[0] not in _EVENT_TYPES or kind[1] != _RECORD.itemsize:
            problem = f"its records are of type and size {kind.hex(' ') or 'none'}, not events"
            raise DataError(path, problem, "record it again")
        self._begin = header.end + len(kind)
        self._num_events, self._rest = divmod(path.stat().st_size - self._begin, _RECORD.itemsize)

    def read_count(self) -> int:
        return self._num_events

    def _require_end(self) -> None:
        if self._rest:
            end = self._begin + self._num_events * _RECORD.itemsize
            self._leave_out_end(f"a record of {_RECORD.itemsize} bytes", end)

    def read_chunks(self) -> Iterator[EventStream]:
        self._require_end()
        last = np.zeros(0, np.int64)
        with self.path.open("rb") as file:
            file.seek(self._begin)
            while len(records := np.fromfile(file, _RECORD, CHUNK)):
                time = np.unwrap(np.append(last, records["time"]), period=_LAP)[len(last) :]
                last = time[-1:]
                address = records["address"]
                x, y = ((address >> shift & 0x3FFF).astype(np.uint16) for shift in (0, 14))
                yield self._stream((x, y, time * 1000, 2 * (address >> 28).astype(np.int8) - 1))

    def read_time_span(self) -> tuple[int, int] | None:
        self._require_end()
        if self._num_events == 0:
            return None
        times = np.memmap(self.path, _RECORD, "r", self._begin, (self._num_events,))["time"]
        samples = np.append(times[:: max(1, len(times) // _MAX_SAMPLES)], times[-1]).astype(np.int64)
        return int(times[0]) * 1000, int(np.unwrap(samples, period=_LAP)[-1]) * 1000
