"""Limits on the memory that the files of a dataset may take, and on the other files that they may name.

Every reader of untrusted files checks sizes here before it allocates anything.
"""

from __future__ import annotations

from pathlib import Path, PurePath

from aenerf_ns.errors import DataError, reading

# Data of at most this size may be compressed by any factor.
_FREE_BYTES = 1 << 28
# Real events are compressed by a factor of 2 to 10, and a bomb by 1000 and more.
_MAX_FACTOR = 100


def require_file(path: Path) -> None:
    """Raise a DataError if a file of a dataset does not exist."""
    with reading(path):
        if not path.is_file():
            raise DataError(path, "there is no such file", "check the path of the dataset")


def read_text(path: Path, max_bytes: int) -> str:
    """Return the text of a small file.

    Args:
        path: the file.
        max_bytes: the most bytes that such a file can have.

    Raises:
        DataError: the file is missing, cannot be read, is larger, or is not UTF-8.
    """
    with reading(path):
        require_at_most(path, max_bytes)
        content = path.read_bytes()
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DataError(path, f"not text in UTF-8 ({error.reason} at byte {error.start})", "save it as UTF-8") from None


def require_at_most(path: Path, max_bytes: int) -> None:
    """Raise a DataError if a file is larger than a file of its kind can be."""
    size = path.stat().st_size
    if size > max_bytes:
        raise DataError(
            path, f"it has {size:,} bytes, and such a file at most {max_bytes:,}", "check what kind of file it is"
        )


def require_unpacked_size(path: Path, name: str, unpacked: int, packed: int) -> None:
    """Raise a DataError for data that says to be much larger than the bytes that hold it explain.

    Args:
        path: the file.
        name: names the data in the file, for the message.
        unpacked: size of the data in bytes.
        packed: size of the compressed data in the file in bytes.
    """
    if unpacked > max(_FREE_BYTES, _MAX_FACTOR * packed):
        raise DataError(
            path,
            f"{name} has {unpacked:,} bytes when it is unpacked, but only {packed:,} in the file",
            "write it again: it is damaged, or made to fill the memory",
        )


def file_inside(folder: Path, name: str, source: Path) -> Path:
    """Return the path of a file that a dataset names, which must lie in the dataset's folder.

    A link in the folder may lead anywhere: the user made it or unpacked it.

    Args:
        folder: the folder that the name is relative to.
        name: the name in the dataset.
        source: the file that holds the name, for the message.

    Raises:
        DataError: the name is empty, holds a null, or leads out of the folder.
    """
    path = PurePath(name)
    if not path.parts or "\0" in name:
        raise DataError(source, f"it names the file {name!r}", "give the name of a file")
    if path.is_absolute() or ".." in path.parts:
        raise DataError(
            source, f"it names {name}, outside the folder {folder}", "put the file, or a link to it, into the folder"
        )
    return folder / path
