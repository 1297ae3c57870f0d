"""Text files with one event a line: the Event Camera Dataset's, and comma-separated values.

The numbers are parsed by a function that numba compiles. CSV libraries were measured against it on one core of a shared
machine, on lines of the Event Camera Dataset: pandas parses 2 to 3, polars 5 to 6, pyarrow 5 to 7 and this module 6 to
9 million lines/s. None of the libraries takes comments, runs of blanks and times with all their digits together, and
none comes with Nerfstudio.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventStream
from aenerf_ns.files.event_reader import EventFile, resolve_sensor_size
from aenerf_ns.files.event_table import events_from_columns
from aenerf_ns.files.limits import MAX_LINE
from aenerf_ns.files.text import LABEL, NANOSECONDS, TIME_NAME, TimeUnit, require_utf8

_COLUMNS = "xytp"
_ALIASES = {"polarity": "p", "pol": "p"}
# Of lines without names: the order of the Event Camera Dataset, that of Metavision's CSV, and that of arrays.
_ORDERS = ("txyp", "xypt", "xytp")
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
BLOCK = 1 << 22
"""Bytes that are read at once: about 150,000 events."""

# The beginning of a file, from which the order of its columns is known.
_SAMPLE_BYTES = 1 << 16
# Share of the events there that fit the order of the columns, where malformed events are left out.
_LEFT_OUT_FITS = 0.99
# The size of the sensor, as E2VID and Metavision write it.
_SIZE = re.compile(rb"\s*(\d{1,9})[\s,]+(\d{1,9})\s*(?:#.*)?$|%\s*geometry\W+(\d{1,9})\D+(\d{1,9})", re.IGNORECASE)
_NUMBER = re.compile(rb"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")

_MAX = np.iinfo(np.int64).max
# A number up to this one takes one more digit without overflow.
_TAKES_A_DIGIT = (_MAX - 9) // 10
# A larger power of ten changes nothing: the number is zero or too large.
_MAX_POWER = 1000
_TAB, _NEWLINE, _RETURN, _BLANK, _HASH, _COMMA, _DOT, _ZERO, _E = b"\t\n\r #,.0e"
_POWERS_OF_TEN = 10 ** np.arange(19)
# The parts of a number: 12.34e5.
_WHOLE, _DECIMALS, _POWER = range(3)


@dataclass(frozen=True)
class _Lines:
    """Parsed lines of a file: the (4, N) integer and fractional parts of x, y, t and p.

    ``num_before`` lines are ahead of them; None for the last line of a file.
    """

    text: bytes
    num_before: int | None
    whole: NDArray[np.int64]
    fraction: NDArray[np.float64]

    def line_of(self, row: int) -> str:
        """Name the line of an event, for messages."""
        rows = [i for i, line in enumerate(self.text.split(b"\n")) if _is_row(line)]
        return _line_name(rows[row], self.num_before)


def _is_row(line: bytes) -> bool:
    """Tell whether a line is neither empty nor a comment, such as Metavision's %geometry."""
    return bool(line.split(b"#", 1)[0].strip()) and not line.startswith(b"%")


def _parse_names(line: bytes) -> tuple[list[str], TimeUnit | None] | None:
    """Return the names of the columns and the unit of the times that a line states, or None if it does not name all."""
    text = line.decode("utf-8", "replace").lower().lstrip("#% ").replace(" [", "[").replace(" (", "(")
    text = re.sub(f"^{LABEL}", "", text)
    names = [name.strip().strip('"') for name in (text.split(",") if "," in text else text.split())]
    # Seconds may have their nanoseconds in another column.
    times = [name for name in names if TIME_NAME.fullmatch(name) and "sec" not in name]
    time = "t" if "t" in times else times[0] if len(times) == 1 else None
    match = time and TIME_NAME.fullmatch(time)
    names = ["t" if name == time else _ALIASES.get(name, name) for name in names]
    return (names, match[1]) if match and set(_COLUMNS) <= set(names) else None  # type: ignore[return-value]


def _size(line: bytes) -> tuple[int, int] | None:
    """Return the width and height of the sensor that a line states."""
    size = _SIZE.match(line)
    return (int(size[1] or size[3]), int(size[2] or size[4])) if size else None


def stated_size(beginning: bytes) -> tuple[int, int] | None:
    """Return the width and height of the sensor that lines ahead of the first event state, or None."""
    lines = beginning.removeprefix(_BYTE_ORDER_MARK).split(b"\n")
    return next((_size(line) for line in lines if _size(line) or _is_row(line)), None)


def _line_name(line: int, num_before: int | None) -> str:
    return "the last line" if num_before is None else f"line {num_before + line + 1}"


class TextEventFile(EventFile):
    """Read lines of t, x, y and p, with polarity 0 or 1, or -1 or 1 (Mueggler et al. 2017). Commas may separate them.

    The first line may hold the width and the height of the sensor, as E2VID's has. It, or a comment ahead of the
    events, may name the columns, which may then have any order, and state the unit of the times: t[ns] or time_us.
    Without names, x, y, p, t or x, y, t, p are read where nothing else fits.

    Args:
        path, width, height: see :class:`EventFile`.
        time_unit: of the times, where the file states none. By default whole numbers are microseconds and decimals
            seconds.
    """

    _with_commas = False
    _stated_unit: TimeUnit | None = None

    def __init__(self, path: Path, width: int, height: int, time_unit: TimeUnit | None = None) -> None:
        super().__init__(path, width, height)
        self._time_unit = time_unit

    def _names(self, file: BinaryIO) -> list[str]:
        """Return the names of the columns, x, y, t and p among them. Read the header, if there is one."""
        beginning = file.read(_SAMPLE_BYTES)
        require_utf8(self.path, beginning)
        first_row = next((line for line in beginning.split(b"\n") if _is_row(line)), b"")
        self._with_commas = b"," in first_row.split(b"#", 1)[0]
        begin = len(_BYTE_ORDER_MARK) if beginning.startswith(_BYTE_ORDER_MARK) else 0
        file.seek(begin)
        named = None
        while line := self._line(file):
            if size := _size(line):
                resolve_sensor_size(self.path, size, self.width, self.height)
            elif _is_row(line):
                break
            else:
                named = _parse_names(line) or named
            begin = file.tell()
        if re.match(rb"[\s,]*[A-Za-z_\"]", line):
            named = _parse_names(line)
            if named is None:
                raise self._unnamed(line)
            begin = file.tell()
        # Other comments may hold the same words.
        elif named is not None and len(named[0]) != len(self._fields(line)):
            named = None
        file.seek(begin)
        names, self._stated_unit = named or (self._order(file), None)
        if self._stated_unit and self._time_unit not in (None, self._stated_unit):
            problem = f"it states its time unit, {self._stated_unit!r}, but {self._time_unit} was given"
            raise DataError(self.path, problem, "leave it out")
        file.seek(begin)
        return names

    def _order(self, file: BinaryIO) -> list[str]:
        """Return the columns of lines without names, the order of the Event Camera Dataset unless another one fits."""
        text = file.read(_SAMPLE_BYTES)
        text = text[: text.rfind(b"\n") + 1] or text + b"\n"
        whole, fraction, _ = parse_lines(text, self._with_commas, [0, 1, 2, 3])
        fitting = []
        for order in _ORDERS:
            x, y, t, p = (order.index(name) for name in _COLUMNS)
            time = whole[t] + fraction[t]
            good = (
                (fraction[[x, y, p]] == 0).all(0)
                & ((whole[[x, y]] >= 0) & (whole[[x, y]] < [[self.width], [self.height]])).all(0)
                & np.isin(whole[p], (-1, 0, 1))
                & (np.diff(time, prepend=time[:1]) >= 0)
            )
            if good.sum() >= (_LEFT_OUT_FITS if self.drop_malformed else 1) * len(good):
                fitting.append(order)
        if self._with_commas and whole.shape[1] > 0 and len(fitting) != 1:
            raise self._unnamed(text.split(b"\n")[0])
        return list((fitting or _ORDERS)[0])

    def _unnamed(self, line: bytes) -> DataError:
        remedy = "it must name the columns, x, y, t and p among them, separated by commas or blanks"
        return DataError(self.path, f"its first line is {line.decode('utf-8', 'replace').strip()[:60]!r}", remedy)

    def read_assumed_unit(self) -> TimeUnit | None:
        unit = self._unit_of(self._ends())
        return None if self._stated_unit else unit

    def _ends(self) -> list[_Lines]:
        """Parse the beginning of the file and its last line; none of them without events."""
        with self.path.open("rb") as file:
            names = self._names(file)
            beginning = next(self._lines(file, names), None)
            return [] if beginning is None else [beginning, self._last_line(file, names)]

    def _unit_of(self, ends: list[_Lines]) -> TimeUnit:
        """Return the unit that is stated or given, or assumed of the times at the ends of the file."""
        return self._stated_unit or self._time_unit or ("s" if any(lines.fraction[2].any() for lines in ends) else "us")

    def read_chunks(self) -> Iterator[EventStream]:
        tick = NANOSECONDS[self._unit_of(self._ends())]
        # The ends may already have counted the line that the file ends within.
        self.left_out.restart()
        with self.path.open("rb") as file:
            for lines in self._lines(file, self._names(file)):
                yield self._events(lines, tick)

    def read_time_span(self) -> tuple[int, int] | None:
        ends = self._ends()
        if not ends:
            return None
        beginning, last = ends
        tick = NANOSECONDS[self._unit_of(ends)]
        first = replace(beginning, whole=beginning.whole[:, :1], fraction=beginning.fraction[:, :1])
        start, end = (int(self._events(lines, tick).t[0]) for lines in (first, last))
        return start, end

    def _last_line(self, file: BinaryIO, names: list[str]) -> _Lines:
        """Parse the last event, which many comments and empty lines may follow."""
        end, row = self.path.stat().st_size, b""
        while end > 0 and not row:
            begin = max(end - MAX_LINE, 0)
            file.seek(begin)
            # A line that begins ahead of this piece of the file is looked at with the piece before.
            begin += len(self._line(file)) if begin > 0 else 0
            lines = file.read(end - begin).removeprefix(_BYTE_ORDER_MARK).splitlines(keepends=True)
            row, end = next((line for line in reversed(lines) if _is_row(line)), b""), begin
        return self._parse_block(row, None, names)

    def _lines(self, file: BinaryIO, names: list[str]) -> Iterator[_Lines]:
        """Parse a file after its header, in pieces of at least one event."""
        header_end = file.tell()
        file.seek(0)
        num_before = file.read(header_end).count(b"\n")
        while text := file.read(BLOCK):
            text += self._line(file)
            lines = self._parse_block(text, num_before, names)
            if lines.whole.shape[1]:
                yield lines
            num_before += text.count(b"\n")

    def _line(self, file: BinaryIO) -> bytes:
        """Read the rest of a line."""
        line = file.readline(MAX_LINE)
        if len(line) == MAX_LINE:
            problem = f"a line has more than {MAX_LINE:,} bytes"
            raise DataError(self.path, problem, "write one event a line, as plain text")
        return line

    def _parse_block(self, text: bytes, num_before: int | None, names: list[str]) -> _Lines:
        # A name that comes twice means its first column.
        slots = [_COLUMNS.find(name) if names.index(name) == i else -1 for i, name in enumerate(names)]
        is_whole = text.endswith(b"\n")
        text += b"" if is_whole else b"\n"
        whole, fraction, fault = parse_lines(text, self._with_commas, slots)
        if fault is not None:
            end = text.index(b"\n", fault)
            # An interrupted recording ends within a line. One line alone, without a header, tells of another format.
            if not is_whole and end == len(text) - 1 and (fault > 0 or num_before != 0):
                self._leave_out_end("a line", self.path.stat().st_size - (end - fault))
            else:
                line = _line_name(text.count(b"\n", 0, fault), num_before)
                raise self._malformed(line, text[fault:end], names)
        return _Lines(text, num_before, whole, fraction)

    def _fields(self, line: bytes) -> list[bytes]:
        return [field.strip() for field in line.split(b"#")[0].split(b"," if self._with_commas else None)]

    def _malformed(self, line_name: str, line: bytes, names: list[str]) -> DataError:
        fields = self._fields(line)
        if len(fields) != len(names):
            remedy = f"each line must hold the {len(names)}, between commas or blanks: {' '.join(names)}"
            beginning = line[:60].decode("utf-8", "replace")
            return DataError(self.path, f"{line_name} has {len(fields)} fields: {beginning!r}", remedy)
        bad = next(i for i, field in enumerate(fields) if not _NUMBER.fullmatch(field))
        value = fields[bad][:40].decode("ascii", "replace") or "nothing"
        return DataError(self.path, f"{line_name} has {names[bad]} = {value}", "write plain decimal numbers")

    def _events(self, lines: _Lines, tick: int) -> EventStream:
        columns = {}
        for name, whole, fraction in zip(_COLUMNS, lines.whole, lines.fraction, strict=True):
            columns[name] = whole + fraction if name != "t" and fraction.any() else whole
        return self._stream(events_from_columns(self, columns, tick, lines.line_of, fraction=lines.fraction[2]))


def parse_lines(
    text: bytes, with_commas: bool, slots: list[int]
) -> tuple[NDArray[np.int64], NDArray[np.float64], int | None]:
    """Parse lines of numbers. Each line ends with a newline. Skip empty lines, and comments after ``#``.

    Args:
        text: the lines.
        with_commas: whether commas separate the numbers, with or without blanks around them, or blanks and tabs alone.
        slots: for each number of a line its row in the result, or −1 for a number that is not kept.

    Returns:
        The (max(slots) + 1, N) integer parts of the numbers of N lines, the fractional parts with the same shape and
        signs, and the position of the first line that does not hold ``len(slots)`` numbers, at which parsing stops, or
        None. An integer part that int64 cannot hold becomes the largest int64.
    """
    shape = max(slots) + 1, text.count(b"\n")
    whole, fraction = np.empty(shape, np.int64), np.empty(shape, np.float64)
    # Signed, because numba's arithmetic makes floats of unsigned and signed integers.
    lines, fault = _compiled()(np.frombuffer(text, np.int8), with_commas, np.array(slots), whole, fraction)
    return whole[:, :lines], fraction[:, :lines], None if fault < 0 else fault


@cache
def _compiled() -> Callable:
    # Imported lazily: every command of every method imports this module, and numba is slow to import.
    import numba

    return numba.njit(cache=True)(_parse)


def _parse(text, with_commas, slots, whole, fraction):
    """Fill the result. Return the number of its lines, and the position of a malformed line or −1."""
    lines = line_begin = column = commas = 0
    comment = False
    # The number that is being read; num_digits counts those of its last part.
    part, sign, digits, exponent, power, power_sign, num_digits = _WHOLE, 0, 0, 0, 0, 0, 0
    for i in range(text.shape[0]):
        c = text[i]
        if comment and c != _NEWLINE:
            continue
        digit = c - _ZERO
        if 0 <= digit <= 9:
            num_digits += 1
            if part == _POWER:
                power = min(10 * power + digit, _MAX_POWER)
            elif digits <= _TAKES_A_DIGIT:
                digits = 10 * digits + digit
                exponent -= part
            else:
                exponent += 1 - part
        elif c == _DOT and part == _WHOLE:
            part = _DECIMALS
        elif c | 0x20 == _E and part != _POWER and num_digits > 0:
            part, num_digits = _POWER, 0
        # The comma stands between plus and minus in ASCII.
        elif abs(c - _COMMA) == 1 and part == _POWER and num_digits == 0 and power_sign == 0:
            power_sign = _COMMA - c
        elif abs(c - _COMMA) == 1 and part == _WHOLE and num_digits == 0 and sign == 0:
            sign = _COMMA - c
        else:
            if num_digits > 0 or part != _WHOLE or sign != 0:
                if num_digits == 0 or column == slots.shape[0] or (with_commas and column != commas):
                    return lines, line_begin
                if slots[column] >= 0:
                    exponent += -power if power_sign < 0 else power
                    rest = 0.0
                    if exponent < -18:
                        rest = digits / 10.0**-exponent
                        digits = 0
                    elif exponent < 0:
                        unit = _POWERS_OF_TEN[-exponent]
                        rest = (digits % unit) / unit
                        digits //= unit
                    while exponent > 0 and 0 < digits < _MAX:
                        digits = 10 * digits if digits <= _TAKES_A_DIGIT else _MAX
                        exponent -= 1
                    whole[slots[column], lines] = -digits if sign < 0 else digits
                    fraction[slots[column], lines] = -rest if sign < 0 else rest
                column += 1
                part, sign, digits, exponent, power, power_sign, num_digits = _WHOLE, 0, 0, 0, 0, 0, 0
            if c == _NEWLINE:
                if column > 0 or commas > 0:
                    if column != slots.shape[0] or (with_commas and commas != column - 1):
                        return lines, line_begin
                    lines += 1
                line_begin = i + 1
                column = commas = 0
                comment = False
            elif c == _HASH:
                comment = True
            elif c == _COMMA and with_commas:
                commas += 1
                if commas != column:
                    return lines, line_begin
            elif c != _BLANK and not _TAB <= c <= _RETURN:
                return lines, line_begin
    return lines, -1
