"""The error for bad input."""

from aenerf_ns.errors import DataError


def test_message_is_one_line() -> None:
    error = DataError("a folder/ä.json", "x is 'a\nb\r\u2028c\0'", "write “1”")
    assert str(error) == "a folder/ä.json: x is 'a\\nb\\r\\u2028c\\x00'; write “1”"
    assert str(error).splitlines() == [str(error)]
