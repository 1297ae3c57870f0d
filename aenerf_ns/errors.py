"""The one error for bad input."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class DataError(ValueError):
    """Input that cannot be used. The message is one line that names the file, the value and the remedy.

    Args:
        source: the file, folder or option the value came from.
        problem: what is wrong, with the offending value.
        remedy: how the user can mend it.
    """

    def __init__(self, source: str | Path, problem: str, remedy: str) -> None:
        message = f"{source}: {problem}; {remedy}"
        # A value from a file may hold line breaks.
        super().__init__("".join(c if c.isprintable() else repr(c)[1:-1] for c in message))


@contextmanager
def errors_as_one_line() -> Iterator[None]:
    """Turn a :class:`DataError` into a :class:`SystemExit` with one clear line, within commands of the framework."""
    try:
        yield
    except DataError as error:
        raise SystemExit(f"Error: {error}") from None
