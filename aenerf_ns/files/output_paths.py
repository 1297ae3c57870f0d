"""The paths that a user gives to a command, which looks at them before it begins."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from aenerf_ns.atomic_write import atomic_write
from aenerf_ns.errors import DataError, reading, reason


def require_dataset(data: Path) -> None:
    """Raise a DataError if a dataset's folder does not exist or may not be read."""
    with reading(data):
        if not data.exists():
            remedy = "give the folder of a dataset; one that was moved may be linked to this place"
            raise DataError(data, "there is no such folder", remedy)


def require_run(run: Path) -> Path:
    """Find the config.yml of a run, which is given by this file or by its folder.

    Raises:
        DataError: there is none, or it may not be read.
    """
    with reading(run):
        config = run / "config.yml" if run.is_dir() else run
        if not config.is_file():
            raise DataError(config, "there is no such file", "give the config.yml of a trained run, or its folder")
    return config


def require_absent(output: Path, option: str = "--output") -> None:
    """Raise a DataError if the folder that a command will write, and an option names, exists or cannot be created."""
    try:
        # A link to nothing is in the way, too.
        exists = output.exists() or output.is_symlink()
    except (OSError, ValueError) as error:
        raise output_error(output, error, option) from None
    if exists:
        raise DataError(output, "the folder exists already", f"remove it or choose another {option}")


def require_writable(output: Path, option: str = "--output") -> None:
    """Raise a DataError if a file that a command will write, and an option names, cannot be created.

    A file that exists is replaced, and folders that are missing are made.
    """
    try:
        if output.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        # A device would be replaced by a file.
        if output.exists() and not output.is_file():
            raise OSError(errno.EEXIST, os.strerror(errno.EEXIST))
        parent = next(folder for folder in Path(os.path.realpath(output)).parents if folder.exists())
        if not parent.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
        if not all(os.access(path, os.W_OK) for path in (parent, output) if path.exists()):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except (OSError, ValueError) as error:
        raise output_error(output, error, option) from None


@contextmanager
def creating(output: Path, option: str = "--output") -> Iterator[Path]:
    """Yield where to write a file or a new folder, which gets its name when the context ends without an error.

    Its folder is made, and errors of the system become a DataError. If an error or Ctrl-C ends the context, an older
    file stays, and nothing new.
    """
    # A link stays one. Writers choose the format by the suffix.
    final = Path(os.path.realpath(output))
    partial = final.with_name(f".{final.stem[:99]}.partial{final.suffix}")
    # Of a command that was killed.
    shutil.rmtree(partial, ignore_errors=True)
    try:
        with atomic_write(final, partial):
            yield partial
    except OSError as error:
        raise output_error(output, error, option) from None


def output_error(output: Path, error: OSError | ValueError, option: str = "--output") -> DataError:
    """Make the error for a file or folder that a command cannot create."""
    text = reason(error) if isinstance(error, OSError) else str(error)
    return DataError(output, f"it cannot be created ({text})", f"choose another {option}")
