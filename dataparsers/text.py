"""Tables of numbers in text files."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError


def read_rows(path: Path, columns: str) -> list[list[str]]:
    """Rows of white-space separated fields; empty lines and comments after # are left out.

    Args:
        path: the file.
        columns: names of the columns, for the check and the message.

    Raises:
        DataError: the file is missing, or a row has another number of fields.
    """
    if not path.is_file():
        raise DataError(path, "there is no such file", "check the path of the dataset")
    expected = len(columns.split())
    rows = []
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, start=1):
            fields = line.split("#", 1)[0].split()
            if not fields:
                continue
            if len(fields) != expected:
                raise DataError(
                    path, f"line {number} has {len(fields)} fields", f"each line must hold the {expected}: {columns}"
                )
            rows.append(fields)
    return rows


def parse_numbers(path: Path, rows: list[list[str]]) -> NDArray[np.float64]:
    """(N, M) float64 numbers of the rows' fields.

    Raises:
        DataError: a field is not a number.
    """
    try:
        return np.array(rows, dtype=np.float64)
    except ValueError as error:
        raise DataError(path, f"not a number ({error})", "write plain decimal numbers") from None


def parse_seconds(path: Path, fields: list[str]) -> NDArray[np.int64]:
    """Exact (N,) nanoseconds of decimal seconds: float64 cannot hold the nanoseconds of the Unix time.

    Raises:
        DataError: a field is not a finite number.
    """
    try:
        return np.array([int((Decimal(field) * 1_000_000_000).to_integral_value()) for field in fields], dtype=np.int64)
    except (InvalidOperation, ValueError, OverflowError):
        bad = next(field for field in fields if not _is_time(field))
        raise DataError(path, f"{bad} is not a time in seconds", "write plain decimal seconds") from None


def _is_time(field: str) -> bool:
    try:
        return abs(Decimal(field)) < 9_000_000_000
    except InvalidOperation:
        return False


def format_seconds(nanoseconds: int) -> str:
    """Decimal seconds of integer nanoseconds, exact."""
    sign, magnitude = ("-" if nanoseconds < 0 else ""), abs(nanoseconds)
    return f"{sign}{magnitude // 1_000_000_000}.{magnitude % 1_000_000_000:09d}"
