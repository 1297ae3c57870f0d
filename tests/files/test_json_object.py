"""Numbers of JSON files."""

from __future__ import annotations

from pathlib import Path

import pytest

from aenerf_ns.errors import DataError
from aenerf_ns.files.json_object import JsonObject


def read_number(path: Path, text: str) -> int:
    path.write_text(f'{{"start_ns": {text}}}', "utf8")
    number: int = JsonObject.read(path).get("start_ns", int)
    return number


def test_whole_numbers_hold_nanoseconds_since_1970_and_no_more_than_int64(tmp_path: Path) -> None:
    path = tmp_path / "numbers.json"
    for number in (1_763_945_940_123_456_789, -(2**63 - 1)):
        assert read_number(path, str(number)) == number
    for text in (str(2**63), "9" * 400, "-" + "9" * 5000):
        with pytest.raises(DataError, match="is too large"):
            read_number(path, text)
