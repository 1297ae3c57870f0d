"""The file beside a long recording that keeps its pairs of events from one run to the next."""

from __future__ import annotations

import errno
import fcntl
import io
import json
import os
import socket
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import fields
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.errors import DataError
from aenerf_ns.events.pair_store import BLOCK, EventPairs, map_rows
from aenerf_ns.files.event_reader import EventFile

# Counted up when the layout of the file, of the rows or of what is kept with them changes.
_VERSION = 6
# Attributes of a reader of events that are no options. The last four are read from the file when they are asked for.
_NOT_OPTIONS = ("path", "left_out", "_span", "_clock_offset", "_stated_unit", "_with_commas")
_STORED = tuple(field.name for field in fields(EventPairs) if field.name != "rows")


class PairFile:
    """Keep the pairs of an event file, or of a folder of event files, in a file beside it.

    The file holds the rows of :class:`~aenerf_ns.events.pair_store.EventPairs` as they are in memory, then an .npz
    archive of the rest and of what the pairs depend on besides the events (``made_from``). It is written under another
    name, and renamed when it is whole.
    """

    def __init__(self, events: EventFile, made_from: Mapping[str, Any]) -> None:
        self.path = events.path.with_name(events.path.name + ".pairs")
        options = {name: repr(value) for name, value in vars(events).items() if name not in _NOT_OPTIONS}
        stated = {"version": _VERSION, "files": _stamps(events.path), "reader": options, **made_from}
        self._made_from = json.dumps(stated, sort_keys=True)
        self._looked_at: list[tuple[str, int, int]] = []
        self._new: BinaryIO | None = None
        self._is_kept = False

    def find(self) -> EventPairs | None:
        """Find the pairs that were made since the last look. None, and a line why, if they must be made."""
        before, self._looked_at = self._looked_at, _stamps(self.path)
        if self._looked_at in ([], before):
            return None
        try:
            with self.path.open("rb") as file:
                found, problem = self._read(file), "is of other events or options"
        # The libraries raise whatever they stumble over in a damaged file.
        except Exception as error:
            found, problem = None, f"is not whole, or of an earlier version ({error})"
        if found is None:
            CONSOLE.print(f"{self.path} {problem}: it is made again.", style="yellow", markup=False)
        return found

    def _read(self, file: BinaryIO) -> EventPairs | None:
        """Read the pairs, None if they are of other events or options.

        Raises:
            Exception: the file is broken.
        """
        end_of_rows = zipfile.ZipFile(file).infolist()[0].header_offset
        file.seek(end_of_rows)
        with np.load(file) as stored:
            if str(stored["made_from"]) != self._made_from:
                return None
            values = {name: stored[name] for name in _STORED}
        num_rows = BLOCK * (len(values["block_ends"]) - 1)
        if end_of_rows != 16 * num_rows:
            raise ValueError("its rows are not as many as it says")
        values = {name: value if value.ndim else int(value) for name, value in values.items()}
        return EventPairs(rows=map_rows(file, num_rows), **values)

    def open(self) -> tuple[BinaryIO, Path]:
        """Open a new file for the rows. Return it with a folder for temporary files."""
        try:
            folder = self.path.parent
            self._new = self._part.open("w+b")
            self._is_kept = True
        except OSError as error:
            folder = Path(tempfile.gettempdir())
            problem = f"{self.path.parent} cannot be written to ({error.strerror})"
            warning = f"{problem}: the pairs are in {folder} until this process ends, and are made again by the next."
            CONSOLE.print(warning, style="yellow", markup=False)
            # The file has no name, and is gone when the process ends.
            self._new = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115
        return self._new, folder

    @property
    def _part(self) -> Path:
        # The lock keeps apart the processes of one host only. The next one there overwrites what a killed one left.
        return self.path.with_name(f"{self.path.name}.{socket.gethostname()}.part")

    def keep(self, pairs: EventPairs) -> None:
        """Keep pairs if their rows went to a file. Otherwise delete an older file of pairs."""
        if self._new is None:
            with suppress(OSError):
                self.path.unlink(missing_ok=True)
            return
        if not self._is_kept:
            return
        # Not into the file itself: where the disk is full, zipfile would fail and say so once more.
        archive = io.BytesIO()
        np.savez(archive, made_from=self._made_from, **{name: getattr(pairs, name) for name in _STORED})
        self._new.write(archive.getbuffer())
        self._new.flush()
        os.fsync(self._new.fileno())
        # Another host may have made it meanwhile: what that one maps would be gone from a network folder.
        if _stamps(self.path) == self._looked_at:
            self._part.rename(self.path)
        CONSOLE.print(f"The pairs are in {self.path}, for the next run. It may be deleted.", markup=False)

    @contextmanager
    def making(self, alone: bool) -> Iterator[None]:
        """Delete an unfinished file at the end, and raise one clear error where the disk is full.

        Args:
            alone: let one process at a time make the file.

        Raises:
            DataError: the disk is full.
        """
        try:
            with _locked(self.path.parent) if alone else nullcontext():
                yield
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                raise
            remedy = "free some of it: the pairs take 16 bytes an event, twice that at first"
            raise DataError(self.path, "the disk is full", remedy) from None
        finally:
            if self._new is not None:
                # Fails once more on a full disk.
                with suppress(OSError):
                    self._new.close()
                if self._is_kept:
                    self._part.unlink(missing_ok=True)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold a folder's lock. Some network folders have none.

    The events' own lock is HDF5's, and a lock file would stay behind in the dataset.
    """
    with ExitStack() as stack:
        # A folder that may be entered, but not listed, cannot be opened.
        with suppress(OSError):
            lock = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, lock)
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _stamps(path: Path) -> list[tuple[str, int, int]]:
    """List name, size and time of change of a file, or of all files in a folder."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    stats = [(file, file.stat()) for file in files if file.is_file()]
    return [(str(file.relative_to(path.parent)), stat.st_size, stat.st_mtime_ns) for file, stat in stats]
