"""The error for bad input."""

from __future__ import annotations

from aenerf_ns.errors import DataError


def test_the_message_is_one_line_whatever_the_value() -> None:
    error = DataError("a folder/ä.json", "x is 'a\nb\r\u2028c\0'", "write “1”")
    assert str(error) == "a folder/ä.json: x is 'a\\nb\\r\\u2028c\\x00'; write “1”"
    assert str(error).splitlines() == [str(error)]
