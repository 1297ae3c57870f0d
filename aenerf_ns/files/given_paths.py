"""The paths that a user gives to a command.

They are judged twice: before the command imports the framework, which takes long, and where they are opened.
"""

from __future__ import annotations

from pathlib import Path

from aenerf_ns.errors import DataError, reading


def require_dataset(data: Path) -> None:
    """Raise a DataError if a dataset's folder does not exist or may not be looked at."""
    with reading(data):
        if not data.exists():
            raise DataError(data, "there is no such folder", "give the folder of a dataset as --data")


def require_run(config: Path) -> None:
    """Raise a DataError if a run's config.yml is no file."""
    if not config.is_file():
        raise DataError(config, "there is no such file", "give the config.yml of a trained run")


def require_new(output: Path) -> None:
    """Raise a DataError if the folder that a command will write exists."""
    if output.exists():
        raise DataError(output, "the folder exists already", "remove it or choose another --output")
