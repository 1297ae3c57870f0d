"""The one error for bad input."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# A longer part of a message is cut in the middle: names and values from files may have any length.
_MAX_LENGTH = 300


class DataError(ValueError):
    """Input that cannot be used. The message is one line that names the file, the value and the remedy.

    Args:
        source: the file, folder or option the value came from.
        problem: what is wrong, with the offending value.
        remedy: how the user can mend it.
    """

    def __init__(self, source: str | Path, problem: str, remedy: str) -> None:
        self.source, self.problem, self.remedy = source, problem, remedy
        message = f"{_shortened(str(source))}: {_shortened(problem)}; {remedy}"
        # A value from a file may hold line breaks.
        super().__init__("".join(c if c.isprintable() else repr(c)[1:-1] for c in message))


@contextmanager
def errors_as_one_line() -> Iterator[None]:
    """Turn a :class:`DataError` into a :class:`SystemExit` with one clear line, within commands of the framework."""
    try:
        yield
    except DataError as error:
        raise SystemExit(f"Error: {error}") from None


def reason(error: OSError) -> str:
    """Return the system's few words for an error. HDF5's text has several lines."""
    return os.strerror(error.errno) if error.errno else str(error)


def _shortened(text: str) -> str:
    half = (_MAX_LENGTH - 3) // 2
    return text if len(text) <= _MAX_LENGTH else f"{text[:half]}...{text[-half:]}"


@contextmanager
def reading(source: str | Path) -> Iterator[None]:
    """Turn an error of the operating system within the context into a :class:`DataError`.

    A file may be missing, a name too long, a link circular or a right not given. The error names the file.

    Args:
        source: the file or folder that is read, for errors that name none.
    """
    try:
        yield
    except OSError as error:
        place, reason = error.filename or source, error.strerror or str(error)
        raise DataError(place, f"it cannot be read ({reason})", "check its name and its rights") from None


def require_file(path: Path, remedy: str = "check the path of the dataset") -> None:
    """Raise a DataError if a file of a dataset does not exist."""
    with reading(path):
        if not path.is_file():
            raise DataError(path, "there is no such file", remedy)


@contextmanager
def value_errors_as_data_error(source: str | Path, remedy: str = "correct it there") -> Iterator[None]:
    """Turn a ValueError within the context, such as that of an impossible camera, into a :class:`DataError`.

    Args:
        source: the file that the values were read from.
        remedy: how the user can mend it.
    """
    try:
        yield
    except DataError:
        raise
    except ValueError as error:
        raise DataError(source, str(error), remedy) from None
