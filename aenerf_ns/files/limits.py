"""The limits on the files of a dataset, and the one way in which their readers keep to them.

A reader reads within :func:`bounded`: whatever a library raises there for a damaged file becomes one clear line, and
memory and temporary files cannot grow far beyond what the size of the file explains. What costs time and no memory,
such as a small file that unpacks to events without end, is held by :func:`require_unpacked_size`.
"""

from __future__ import annotations

import re
import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import TypeVar

from aenerf_ns.errors import DataError, reading, require_file

Item = TypeVar("Item")

MAX_TIME = 4 * 10**18
"""Nanoseconds, 126 years. The difference of two such times fits int64."""

MAX_ROWS = 1_000_000
"""Rows of a table that is read as a whole: poses at 1000 Hz for a quarter of an hour."""

MAX_TABLE_BYTES = 1 << 27
"""Bytes of such a table."""

MAX_LINE = 1 << 16
"""Bytes of a line of numbers."""

MAX_PIECE = 1 << 27
"""Bytes of a compressed piece of an event file, which have some megabytes."""

MAX_HEADER = 1 << 20
"""Bytes of a header of an event file, which have some kilobytes."""

# Memory that any file may take: enough to compile a parser, and for a million events in several types.
_FREE_BYTES = 1 << 28
# Real events are compressed by a factor of 2 to 10, and a bomb by 1000 and more.
_MAX_FACTOR = 100

_STATUS, _MEMORY = Path("/proc/self/statm"), Path("/proc/meminfo")
# Limits belong to the process: one thread reads at a time.
_lock = threading.RLock()


@contextmanager
def bounded(path: Path, kind: str, extra: str = "", size: int | None = None) -> Iterator[None]:
    """Read from a file or the folder of a bag within the context, in little memory.

    Args:
        path: the file or folder.
        kind: what it should be, such as "HDF5 file".
        extra: the optional dependencies that reading it may need.
        size: its bytes, where they are known.

    Raises:
        DataError: anything went wrong.
    """
    try:
        with _little_memory(path, size_on_disk(path) if size is None else size):
            yield
    except DataError:
        raise
    except FileNotFoundError as error:
        raise DataError(error.filename or path, "there is no such file", "check the path of the dataset") from error
    except ImportError as error:
        problem = f"a package is missing to read it ({error})"
        raise DataError(path, problem, f"pip install 'aenerf-ns[{extra}]'") from error
    # Libraries raise whatever they stumble over in a damaged file.
    except Exception as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        problem = f"not a readable {kind} ({str(reason) or type(error).__name__})"
        raise DataError(path, problem, "copy, record or write it again") from error


def bounded_items(items: Iterator[Item], path: Path, kind: str, extra: str = "") -> Iterator[Item]:
    """Yield items, each of which is read from a file within :func:`bounded`."""
    # Once, because a folder may hold thousands of files.
    with bounded(path, kind, extra):
        size = size_on_disk(path)
    while True:
        with bounded(path, kind, extra, size):
            item = next(items, None)
        if item is None:
            return
        yield item


@contextmanager
def _little_memory(path: Path, size: int) -> Iterator[None]:
    """Within the context, let the process take only as much more memory, and write only files as large, as the size
    of a file explains."""
    allowed = _max_unpacked(size)
    reason, remedy = "far more memory than its size explains", "it is damaged, or made to fill the memory"
    available = re.search(r"MemAvailable:\s*(\d+)", _MEMORY.read_text())
    if available and (free := int(available[1]) << 10) < allowed:
        allowed, reason, remedy = free, f"more memory than the {free:,} bytes that are free", "end other programs"
    # The sixth number is memory that is written to, in pages.
    in_use = int(_STATUS.read_text().split()[5]) * resource.getpagesize()
    try:
        with _lock, _limit(resource.RLIMIT_DATA, in_use + allowed), _limit(resource.RLIMIT_FSIZE, allowed):
            yield
    except MemoryError as error:
        raise DataError(path, f"it takes {reason}", remedy) from error


@contextmanager
def _limit(kind: int, value: int) -> Iterator[None]:
    before = resource.getrlimit(kind)
    tighter = [limit for limit in (value, *before) if limit != resource.RLIM_INFINITY]
    resource.setrlimit(kind, (min(tighter), before[1]))
    try:
        yield
    finally:
        resource.setrlimit(kind, before)


def size_on_disk(path: Path) -> int:
    """Return the bytes of a file, or of all files in a folder."""
    files = path.iterdir() if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def _max_unpacked(packed: int) -> int:
    return _FREE_BYTES + _MAX_FACTOR * packed


def require_unpacked_size(path: Path, name: str, unpacked: int, packed: int) -> None:
    """Raise a DataError for data of a size in bytes that its size in the file, packed, does not explain.

    ``name`` is what the message calls the data.
    """
    if unpacked > _max_unpacked(packed):
        problem = f"{name} unpacks to {unpacked:,} bytes or more, from {packed:,} in the file"
        raise DataError(path, problem, "it is damaged, or made to fill the memory: copy it again")


def visible_files(folder: Path, pattern: str) -> list[Path]:
    """List the files and folders in a folder that match a pattern, in the order of their names.

    Numbers in the names count as such: 2 is ahead of 10, and 0.15 ahead of 0.2.

    Hidden files do not count, because macOS puts one beside each file that it copies to other disks.
    """

    def order(file: Path) -> tuple[list[str | float], str]:
        parts = re.split(r"(\d+(?:\.\d+)?)", file.name)
        # As floats, two numbers of many digits may be equal. Then the names decide.
        return [float(part) if index % 2 else part for index, part in enumerate(parts)], file.name

    return sorted((file for file in folder.glob(pattern) if not file.name.startswith(".")), key=order)


def list_files(folder: Path, pattern: str) -> list[Path]:
    """List the :func:`visible_files` of a dataset's folder that match a pattern.

    Raises:
        DataError: there is none.
    """
    files = visible_files(folder, pattern)
    if not files:
        raise DataError(folder, f"it holds no {pattern}", "copy all files of the dataset")
    return files


def require_one(paths: list[Path], source: Path, what: str, remedy: str) -> Path:
    """Return the only one of the paths that were found in a folder.

    Args:
        what: names the paths, in the plural.
        remedy: how to choose one of several.

    Raises:
        DataError: there is none, or there are several.
    """
    if len(paths) != 1:
        example = f", such as {paths[0]}" if paths else ""
        raise DataError(source, f"it holds {len(paths)} {what}", f"{remedy}{example}")
    return paths[0]


def read_text(path: Path, max_bytes: int) -> str:
    """Read a file of text.

    Raises:
        DataError: the file is missing, cannot be read, has more than ``max_bytes``, or is not UTF-8.
    """
    require_file(path)
    with reading(path):
        require_at_most(path, max_bytes)
        content = path.read_bytes()
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(path, f"not text in UTF-8 ({error.reason} at byte {error.start})", "save it as UTF-8") from None


def require_at_most(path: Path, max_bytes: int) -> None:
    """Raise a DataError if a file is larger than a file of its kind can be."""
    size = path.stat().st_size
    if size > max_bytes:
        raise DataError(path, f"file is too large ({size:,} bytes, limit {max_bytes:,})", "is it the right file?")


def file_inside(folder: Path, name: str, source: Path) -> Path:
    """Return the path of a file that another file (``source``) of a dataset names, relative to a folder.

    A link in the folder may lead anywhere: the user made it or unpacked it.

    Raises:
        DataError: the name is empty, holds a null, or leads out of the folder.
    """
    path = PurePath(name)
    if not path.parts or "\0" in name:
        raise DataError(source, f"{name!r} is not a file name", "name the file")
    if path.is_absolute() or ".." in path.parts:
        problem = f"it names {name}, outside the folder {folder}"
        raise DataError(source, problem, "put the file, or a link to it, into the folder")
    return folder / path
