"""Tables of numbers in text files."""

from __future__ import annotations

import codecs
import re
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError
from aenerf_ns.files.limits import MAX_ROWS, MAX_TABLE_BYTES, MAX_TIME, bounded, require_at_most

TimeUnit = Literal["ns", "us", "ms", "s"]
NANOSECONDS: dict[TimeUnit, int] = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000}
UNIT_NAMES = {"ns": "nanoseconds", "us": "microseconds", "ms": "milliseconds", "s": "seconds"}

LABEL = r"(?:(?:columns|data|events|fields|format|header|order|poses)\s*:\s*)?"
"""What may stand ahead of the names of columns, as in # format: t x y p."""

TIME_NAME = re.compile(
    rf"\W*{LABEL}(?:t|ts|time\w*?|stamp\w*?|secs?|seconds)(?:(?:\s*(?:\[|\((?=\w+\)))|_)(ns|us|ms|s)\b[])]?)?(?!\w)",
    re.IGNORECASE,
)
"""The name of the column of times. It may state their unit, as timestamp [ns], t (us) and time_us do."""

POSE_COLUMNS = "t tx ty tz qx qy qz qw"
"""The columns of a trajectory in the format of the TUM RGB-D benchmark."""


def require_utf8(path: Path, beginning: bytes) -> None:
    """Raise a DataError if the first bytes of a file are those of text in UTF-16, as Windows' programs write it."""
    if beginning.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) or b"\0" in beginning[:64]:
        raise DataError(path, "it is text in UTF-16, or no text", "save it as UTF-8, or give a file of text")


def read_rows(path: Path, columns: str) -> tuple[list[list[str]], list[str], TimeUnit | None]:
    """Read rows of fields between white space or commas. Leave out empty lines, comments after #, and a first line of
    names.

    Returns:
        The rows, the lines ahead of them in lower case, and the unit that these state of the times.

    Raises:
        DataError: the file is missing, cannot be read or has too many rows, or a row does not have the fields that
            ``columns`` names.
    """
    expected = len(columns.split())
    rows: list[list[str]] = []
    header: list[str] = []
    with bounded(path, "table of numbers"), path.open(encoding="utf-8-sig", errors="replace") as file:
        require_at_most(path, MAX_TABLE_BYTES)
        require_utf8(path, bytes(file.buffer.read(64)))
        file.seek(0)
        for number, line in enumerate(file, start=1):
            text = line.split("#", 1)[0]
            fields = text.split()
            # The comma of 0,5 is left, so that it is named as no number.
            if "," in text and (len(fields) != expected or re.search(r",(?!\d+$)", fields[0])):
                fields = [field.strip() for field in text.rstrip().split(",")]
            if not fields or (not rows and len(fields) == expected and TIME_NAME.match(fields[0])):
                if not rows:
                    header.append(line.lower())
                continue
            if len(fields) != expected:
                remedy = f"each line must hold the {expected}, between blanks or commas: {columns}"
                raise DataError(path, f"line {number} has {len(fields)} fields: {text.rstrip()[:60]!r}", remedy)
            if len(rows) == MAX_ROWS:
                raise DataError(path, f"it has more than {MAX_ROWS:,} rows", "cut the recording, or leave rows out")
            rows.append(fields)
    stated = next((name[1] for name in map(TIME_NAME.match, header) if name and name[1]), None)
    return rows, header, stated  # type: ignore[return-value]


def parse_numbers(path: Path, rows: list[list[str]]) -> NDArray[np.float64]:
    """Return the (N, M) float64 numbers of the fields of rows.

    Raises:
        DataError: a field is not a number.
    """
    try:
        # Python reads 1_0 as 10.
        if any("_" in field for row in rows for field in row):
            raise ValueError("a number with an underscore")
        return np.array(rows, dtype=np.float64)
    except ValueError as error:
        raise DataError(path, f"not a number ({error})", "write plain decimal numbers") from None


def parse_times(path: Path, fields: Sequence[str], unit: TimeUnit = "s") -> NDArray[np.int64]:
    """Return the exact (N,) nanoseconds of decimal times. float64 cannot hold the nanoseconds of the Unix time.

    Raises:
        DataError: a field is not a finite number.
    """
    times = np.empty(len(fields), dtype=np.int64)
    for index, field in enumerate(fields):
        try:
            time = Decimal(field) * NANOSECONDS[unit]
            good = abs(time) < MAX_TIME and "_" not in field
        except ArithmeticError:
            good = False
        if not good:
            name = UNIT_NAMES[unit]
            problem = f"{field[:40]} is not a time in {name}"
            raise DataError(path, problem, f"write plain decimal {name}, not another unit")
        times[index] = int(time.to_integral_value())
    return times


def format_seconds(nanoseconds: int) -> str:
    """Format integer nanoseconds as decimal seconds, exactly."""
    sign, magnitude = ("-" if nanoseconds < 0 else ""), abs(nanoseconds)
    return f"{sign}{magnitude // 1_000_000_000}.{magnitude % 1_000_000_000:09d}"
