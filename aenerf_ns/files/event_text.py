"""Text files with one event a line: the Event Camera Dataset's, and comma-separated values."""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError, reading
from aenerf_ns.events.stream import EventFile, EventStream
from aenerf_ns.files.event_table import CHECK_SIZE, SAMPLE, events_from_columns
from aenerf_ns.files.text import NANOSECONDS, TimeUnit, is_row, last_row

_COLUMNS = "xytp"
# Bytes read at once: about 150,000 events.
_BLOCK = 1 << 22
# Longer than any line of numbers.
_MAX_LINE = 1 << 16
_NUMBER = re.compile(rb"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


@dataclass(frozen=True)
class _Lines:
    """Parsed lines of a file.

    Attributes:
        text: the lines.
        num_before: number of lines ahead of them, or None for the last line of a file.
        whole: (4, N) integer parts of x, y, t and p.
        fraction: (4, N) fractional parts.
    """

    text: bytes
    num_before: int | None
    whole: NDArray[np.int64]
    fraction: NDArray[np.float64]

    def place(self, row: int) -> str:
        """Name the line of an event, for messages."""
        rows = [i for i, line in enumerate(self.text.split(b"\n")) if is_row(line)]
        return _line_name(rows[row], self.num_before)


def _line_name(line: int, num_before: int | None) -> str:
    return "the last line" if num_before is None else f"line {num_before + line + 1}"


class _EventLines(EventFile):
    """A text file with one event a line. Formats implement :meth:`_names` and :meth:`_tick`."""

    with_commas = False
    _size_remedy = CHECK_SIZE

    @abstractmethod
    def _names(self, file: BinaryIO) -> list[str]:
        """Return the names of the columns, x, y, t and p among them. Read the header, if the format has one."""

    @abstractmethod
    def _tick(self, time_fractions: NDArray[np.float64]) -> int:
        """Return the nanoseconds of the unit of the times.

        Args:
            time_fractions: (N,) fractional parts of the first times.
        """

    def read_chunks(self) -> Iterator[EventStream]:
        tick = None
        with reading(self.path), self.path.open("rb") as file:
            for lines in self._lines(file, self._names(file)):
                tick = tick or self._tick(lines.fraction[2, :SAMPLE])
                yield self._events(lines, tick)

    def time_span(self) -> tuple[int, int]:
        self.require()
        with reading(self.path), self.path.open("rb") as file:
            names = self._names(file)
            beginning = next(self._lines(file, names), None)
        if beginning is None:
            raise self.empty_error()
        tick = self._tick(beginning.fraction[2, :SAMPLE])
        first = replace(beginning, whole=beginning.whole[:, :1], fraction=beginning.fraction[:, :1])
        last = self._parse(last_row(self.path) + b"\n", None, names)
        start, end = (int(self._events(lines, tick).t[0]) for lines in (first, last))
        return start, end

    def _lines(self, file: BinaryIO, names: list[str]) -> Iterator[_Lines]:
        """Parse a file after its header, in pieces of at least one event."""
        header_end = file.tell()
        file.seek(0)
        num_before = file.read(header_end).count(b"\n")
        while text := file.read(_BLOCK):
            text += self._line(file)
            text += b"" if text.endswith(b"\n") else b"\n"
            lines = self._parse(text, num_before, names)
            if lines.whole.shape[1]:
                yield lines
            num_before += text.count(b"\n")

    def _line(self, file: BinaryIO) -> bytes:
        """Read the rest of a line."""
        line = file.readline(_MAX_LINE)
        if len(line) == _MAX_LINE:
            raise DataError(
                self.path, f"a line has more than {_MAX_LINE:,} bytes", "write one event a line, as plain text"
            )
        return line

    def _parse(self, text: bytes, num_before: int | None, names: list[str]) -> _Lines:
        # Imported lazily: every command of every method imports this module, and numba is slow to import.
        from aenerf_ns.files.number_lines import parse_lines

        # A name that comes twice means its first column.
        slots = [_COLUMNS.find(name) if names.index(name) == i else -1 for i, name in enumerate(names)]
        whole, fraction, fault = parse_lines(text, self.with_commas, slots)
        if fault is not None:
            line = _line_name(text.count(b"\n", 0, fault), num_before)
            raise self._malformed(line, text[fault : text.index(b"\n", fault)], names)
        return _Lines(text, num_before, whole, fraction)

    def _malformed(self, place: str, line: bytes, names: list[str]) -> DataError:
        fields = [field.strip() for field in line.split(b"#")[0].split(b"," if self.with_commas else None)]
        if len(fields) != len(names):
            remedy = f"each line must hold the {len(names)}: {' '.join(names)}"
            return DataError(self.path, f"{place} has {len(fields)} fields", remedy)
        bad = next(i for i, field in enumerate(fields) if not _NUMBER.fullmatch(field))
        value = fields[bad][:40].decode("ascii", "replace") or "nothing"
        return DataError(self.path, f"{place} has {names[bad]} = {value}", "write plain decimal numbers")

    def _events(self, lines: _Lines, tick: int) -> EventStream:
        columns = {}
        for name, whole, fraction in zip(_COLUMNS, lines.whole, lines.fraction, strict=True):
            columns[name] = whole + fraction if name != "t" and fraction.any() else whole
        return events_from_columns(
            columns,
            width=self.width,
            height=self.height,
            tick=tick,
            fraction=lines.fraction[2],
            source=self.path,
            place=lines.place,
            size_remedy=self._size_remedy,
        )


class TextEventFile(_EventLines):
    """Read events.txt: lines of t in seconds, x, y and p, with polarity 0 or 1 (Mueggler et al. 2017).

    Args:
        path: the file.
        width: number of pixel columns of the sensor.
        height: number of pixel rows of the sensor.
        size_remedy: what to do about a pixel outside the sensor.
    """

    def __init__(self, path: Path, width: int, height: int, size_remedy: str = CHECK_SIZE) -> None:
        super().__init__(path, width, height)
        self._size_remedy = size_remedy

    def _names(self, file: BinaryIO) -> list[str]:
        return ["t", "x", "y", "p"]

    def _tick(self, time_fractions: NDArray[np.float64]) -> int:
        return NANOSECONDS["s"]

    def _events(self, lines: _Lines, tick: int) -> EventStream:
        negative = lines.whole[3] < 0
        if negative.any():
            row = int(np.argmax(negative))
            raise DataError(
                self.path,
                f"{lines.place(row)} has p = {lines.whole[3, row]}",
                "polarities are 0 or 1 in this format",
            )
        return super()._events(lines, tick)


class CsvEventFile(_EventLines):
    """Read comma-separated values. The first line names the columns in any order, x, y, t and p among them.

    Args:
        path: the file.
        width: number of pixel columns of the sensor.
        height: number of pixel rows of the sensor.
        time_unit: of the times. By default whole numbers are microseconds and decimals seconds.
    """

    with_commas = True

    def __init__(self, path: Path, width: int, height: int, time_unit: TimeUnit | None = None) -> None:
        super().__init__(path, width, height)
        self._time_unit = time_unit

    def _names(self, file: BinaryIO) -> list[str]:
        header = next((line for line in iter(lambda: self._line(file), b"") if is_row(line)), b"").decode(
            "utf-8", "replace"
        )
        names = [name.strip().strip('"').lower() for name in header.split(",")]
        if not set(_COLUMNS) <= set(names):
            raise DataError(
                self.path,
                f"its first line is {header.strip()[:60]!r}",
                "it must name the columns, x, y, t and p among them, separated by commas",
            )
        return names

    def _tick(self, time_fractions: NDArray[np.float64]) -> int:
        return NANOSECONDS[self._time_unit or ("s" if time_fractions.any() else "us")]
