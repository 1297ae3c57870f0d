"""The paths that a user gives to a command.

They are judged twice: before the command imports the framework, which takes long, and where they are opened.
"""

from __future__ import annotations

from pathlib import Path

from aenerf_ns.errors import DataError, reading, reason


def require_dataset(data: Path) -> None:
    """Raise a DataError if a dataset's folder does not exist or may not be looked at."""
    with reading(data):
        if not data.exists():
            raise DataError(data, "there is no such folder", "give the folder of a dataset as --data")


def require_run(run: Path) -> Path:
    """Return the config.yml of a run, which is given by this file or by its folder.

    Raises:
        DataError: there is none, or it may not be looked at.
    """
    with reading(run):
        config = run / "config.yml" if run.is_dir() else run
        if not config.is_file():
            raise DataError(config, "there is no such file", "give the config.yml of a trained run, or its folder")
    return config


def require_new(output: Path) -> None:
    """Raise a DataError if the folder that a command will write exists, or cannot have this name."""
    try:
        exists = output.exists()
    except OSError as error:
        raise cannot_be_created(output, error) from None
    if exists:
        raise DataError(output, "the folder exists already", "remove it or choose another --output")


def cannot_be_created(output: Path, error: OSError) -> DataError:
    """Return the error for a folder that a command cannot create."""
    return DataError(output, f"it cannot be created ({reason(error)})", "choose another --output")
