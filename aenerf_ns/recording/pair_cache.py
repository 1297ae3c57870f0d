"""The file beside a long recording that keeps its pairs of events from one run to the next."""

from __future__ import annotations

import errno
import fcntl
import json
import math
import os
import socket
import tempfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import fields
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.errors import DataError
from aenerf_ns.events.pair_store import EventPairs, map_rows
from aenerf_ns.files.event_reader import EventFile

# Counted up when the layout of the file, of the rows or of what is kept with them changes.
_VERSION = 4
# The end of the file: length of the description as JSON in front of it, and this word.
_WORD = b"aenerf-pairs"
# Attributes of a reader of events that are no options. The last four are read from the file when they are asked for.
_NOT_OPTIONS = ("path", "left_out", "_span", "_clock_offset", "_stated_unit", "_with_commas")
_NUMBERS = tuple(field.name for field in fields(EventPairs) if field.type == "int")


class PairFile:
    """Keep the pairs of an event file, or of a folder of event files, in a file beside it.

    The file holds the rows of :class:`~aenerf_ns.events.pair_store.EventPairs`, then ``replacement_rows`` and
    ``block_ends``, all as they are in memory, then a description as JSON, with what the pairs depend on besides the
    events (``made_from``). It is written under another name, and renamed when it is whole.
    """

    def __init__(self, events: EventFile, made_from: Mapping[str, Any]) -> None:
        self.path = events.path.with_name(events.path.name + ".pairs")
        options = {name: repr(value) for name, value in vars(events).items() if name not in _NOT_OPTIONS}
        stated = {"version": _VERSION, "files": _stamps(events.path), "reader": options, **made_from}
        # JSON turns tuples into lists: compare what reading the file gives.
        self._made_from = json.loads(json.dumps(stated))
        self._new: BinaryIO | None = None
        self._is_kept = False

    def find(self) -> EventPairs | None:
        """Find the pairs of an earlier run. None, and a line why, if they must be made."""
        self._looked_at = _stamps(self.path)
        if not self._looked_at:
            return None
        try:
            with self.path.open("rb") as file:
                found, problem = self._read(file), "is of other events or options"
        except (OSError, ValueError, KeyError, TypeError) as error:
            found, problem = None, f"is not whole ({error})"
        if found is None:
            CONSOLE.print(f"{self.path} {problem}: it is made again.", style="yellow", markup=False)
        return found

    def find_newer(self) -> EventPairs | None:
        """Find the pairs that another process has made since the last look."""
        return None if _stamps(self.path) == self._looked_at else self.find()

    def _read(self, file: BinaryIO) -> EventPairs | None:
        """Read the pairs, None if they are of other events or options.

        Raises:
            ValueError, KeyError or TypeError: the file is broken.
        """
        size = os.fstat(file.fileno()).st_size
        file.seek(max(size - 8 - len(_WORD), 0))
        length = int.from_bytes(file.read(8), "little")
        if file.read() != _WORD:
            raise ValueError("its last bytes are missing")
        end = size - 8 - len(_WORD) - length
        file.seek(max(end, 0))
        about = json.loads(file.read(length))
        if about["made_from"] != self._made_from:
            return None
        num_rows = about["num_rows"]
        file.seek(16 * num_rows)
        checksum, arrays = 0, []
        for dtype, shape in about["arrays"]:
            array = np.fromfile(file, dtype, math.prod(shape)).reshape(shape)
            checksum = zlib.crc32(array.data, checksum)
            arrays.append(array)
        if file.tell() != end or checksum != about["checksum"]:
            raise ValueError("its parts have other sizes or bytes than it says")
        replacement_rows, block_ends = arrays
        numbers = {name: int(about["numbers"][name]) for name in _NUMBERS}
        return EventPairs(
            rows=map_rows(file, num_rows), replacement_rows=replacement_rows, block_ends=block_ends, **numbers
        )

    def open(self) -> tuple[BinaryIO, Path]:
        """Open a new file for the rows. Return it with a folder for temporary files."""
        try:
            folder = self.path.parent
            self._new = self._part.open("w+b")
            self._is_kept = True
        except OSError as error:
            folder = Path(tempfile.gettempdir())
            CONSOLE.print(
                f"{self.path.parent} cannot be written to ({error.strerror}): the pairs are in {folder} until "
                "this process ends, and are made again by the next.",
                style="yellow",
                markup=False,
            )
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
        checksum, arrays = 0, []
        for array in (pairs.replacement_rows, pairs.block_ends):
            self._new.write(array.data)
            checksum = zlib.crc32(array.data, checksum)
            arrays.append((array.dtype.str, array.shape))
        about = {
            "made_from": self._made_from,
            "num_rows": len(pairs.rows),
            "arrays": arrays,
            "checksum": checksum,
            "numbers": {name: getattr(pairs, name) for name in _NUMBERS},
        }
        text = json.dumps(about).encode()
        self._new.write(text + len(text).to_bytes(8, "little") + _WORD)
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
            raise DataError(
                self.path, "the disk is full", "free some of it: the pairs take 16 bytes an event, twice that at first"
            ) from None
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
    lock = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        os.close(lock)


def _stamps(path: Path) -> list[tuple[str, int, int]]:
    """List name, size and time of change of a file, or of all files in a folder."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    stats = [(file, file.stat()) for file in files if file.is_file()]
    return [(str(file.relative_to(path.parent)), stat.st_size, stat.st_mtime_ns) for file, stat in stats]
