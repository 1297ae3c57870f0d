"""Writing a file or a folder whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def atomic_write(path: Path, partial: Path | None = None) -> Iterator[Path]:
    """Yield a path to write a file or a new folder to. It gets its final name when the context ends without an error.

    After a kill or a crash of the machine, the name of a file stands for the old or the new contents, never for a part
    of them. What is in a folder may be lost in a crash.

    Args:
        path: the final name. Its folder is made if it does not exist.
        partial: where to write first, on the same file system; by default beside the final name.

    Raises:
        OSError: the disk is full or fails.
    """
    partial = partial or path.with_name(f"{path.name}.partial")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield partial
        if partial.is_file():
            _sync(partial)
        partial.replace(path)
        # Some file systems cannot, and the file is whole.
        with suppress(OSError):
            _sync(path.parent)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        partial.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
