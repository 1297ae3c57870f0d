"""RAW files of Prophesee cameras, in the encodings EVT 2.0 and EVT 3.0.

https://docs.prophesee.ai/stable/data/file_formats/raw.html
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError, reading
from aenerf_ns.events.stream import EventFile, EventStream
from aenerf_ns.files.prophesee_header import PropheseeHeader, read_header
from aenerf_ns.files.sensor_size import sensor_size

if TYPE_CHECKING:
    from aenerf_ns.files.evt_words import Columns

# Words read at once.
_BLOCK = 1 << 20
# The kind of word that holds the upper bits of a time, in the upper 4 bits of a word in both encodings. Cameras send
# one at least every 5 ms, in which no camera sends so many words.
_TIME_HIGH, _MAX_TIMELESS = 0x8, 1 << 20


class PropheseeRawFile(EventFile):
    """Read a RAW file: a text header, then the words that the camera sent.

    Args:
        path: the file.
        width: pixel columns of the sensor; needed where the header does not tell them. With both sizes given, the file
            is not opened before its events are asked for.
        height: pixel rows of the sensor; needed where the header does not tell them.

    Raises:
        DataError: a size is not given, and the file is missing, or its header does not tell the size or names an
            encoding that is not read.
    """

    def __init__(self, path: Path, width: int | None = None, height: int | None = None) -> None:
        if width is None or height is None:
            header = read_header(path)
            _encoding_name(path, header)
            width, height = sensor_size(path, header.size, width, height)
        super().__init__(path, width, height)

    def _decoded(self) -> Iterator[Columns]:
        # Imported lazily: every command of every method imports this module, and numba is slow to import.
        from aenerf_ns.files.evt_words import EVT2, EVT3, decode_words, initial_state

        header = read_header(self.path)
        sensor_size(self.path, header.size, self.width, self.height)
        encoding = EVT2 if _encoding_name(self.path, header) == "EVT2" else EVT3
        yield from decode_words(self._blocks(header.end, encoding.dtype), encoding, initial_state(), self.path)

    def _blocks(self, begin: int, dtype: np.dtype) -> Iterator[NDArray]:
        if (self.path.stat().st_size - begin) % dtype.itemsize:
            raise DataError(self.path, f"it ends within a word of {dtype.itemsize} bytes", "copy it again")
        with reading(self.path), self.path.open("rb") as file:
            file.seek(begin)
            while len(block := np.fromfile(file, dtype, _BLOCK)):
                if len(block) >= _MAX_TIMELESS and not (block >> 8 * dtype.itemsize - 4 == _TIME_HIGH).any():
                    raise DataError(
                        self.path,
                        f"{len(block):,} words without the upper bits of a time end at byte {file.tell():,}",
                        "copy it again",
                    )
                yield block

    def read_chunks(self) -> Iterator[EventStream]:
        for x, y, t, p in self._decoded():
            yield EventStream(x, y, t, p, self.width, self.height, self.path)

    def time_span(self) -> tuple[int, int]:
        # The file holds only the lower bits of times. Only a pass through the whole file tells how often they wrap.
        start = end = None
        for _, _, t, _ in self._decoded():
            start = int(t[0]) if start is None else start
            end = int(t[-1])
        if start is None or end is None:
            raise self.empty_error()
        return start, end


def _encoding_name(path: Path, header: PropheseeHeader) -> str:
    """Return EVT2 or EVT3."""
    options = header.format_options
    version = header.fields.get("evt", "")
    name = options["name"] or {"2.0": "EVT2", "2.1": "EVT21", "3.0": "EVT3"}.get(version, version)
    if not name:
        raise DataError(
            path,
            "its header does not tell the encoding of the events",
            'add the line "% evt 2.0" or "% evt 3.0", or convert it with metavision_file_to_dat',
        )
    if name not in ("EVT2", "EVT3") or options.get("endianness", "little") != "little":
        raise DataError(
            path,
            f"its events are encoded as {header.fields.get('format', version)}; EVT2 and EVT3, little-endian, are read",
            "convert it with metavision_file_to_dat",
        )
    return name
