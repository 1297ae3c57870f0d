"""One command at a time for an output."""

from __future__ import annotations

import errno
import os
import shutil
import socket
from pathlib import Path

from filelock import FileLock, Timeout
from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import output_error, require_absent

# Errors of network folders that have no locks.
_NO_LOCKS = {errno.ENOLCK, errno.EOPNOTSUPP}


class OutputLock:
    """Keep a folder that does not exist yet to this process. Use it as a context manager.

    The lock is a file beside the output, which names its owner. The system releases it when the owner ends, in whatever
    way. A file that a killed owner left locks nothing, and the next owner takes it over.

    Raises:
        DataError: the output exists, another process holds the lock, or the file cannot be written.

    Attributes:
        output: the folder.
        partial: where the owner makes the folder before it gets its name. It is removed when the context ends.
    """

    def __init__(self, output: Path) -> None:
        self.output = output
        self.partial = output.with_name(f".{output.name}.partial")
        self._file = self.partial.with_name(f"{self.partial.name}.lock")
        self._lock = FileLock(self._file)
        try:
            require_absent(output)
            output.parent.mkdir(parents=True, exist_ok=True)
            self._acquire()
            try:
                self._file.write_text(f"process {os.getpid()} on {socket.gethostname()}\n", "utf8")
                # The owner before may have finished in the meantime.
                require_absent(output)
            except (OSError, DataError):
                self.release()
                raise
        except OSError as error:
            raise output_error(output, error) from None

    def _acquire(self) -> None:
        try:
            self._lock.acquire(blocking=False)
        except Timeout:
            owner = self._file.read_text("utf8", errors="replace")[:200].strip() or "its process is unknown"
            problem = f"another command is writing it ({owner})"
            raise DataError(self.output, problem, "wait for its end or choose another --output") from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
            problem = f"its file system has no locks ({error.strerror})"
            warning = f"{self.output}: {problem}: start no second command with this output"
            CONSOLE.print(warning, style="yellow", markup=False, soft_wrap=True)

    def release(self) -> None:
        """Let others write the output."""
        # Whoever waits for the removed file notices, and makes a new one.
        self._file.unlink(missing_ok=True)
        self._lock.release()

    def __enter__(self) -> OutputLock:
        return self

    def __exit__(self, *_: object) -> None:
        # A signal may have come before whoever made the folder could remove it.
        shutil.rmtree(self.partial, ignore_errors=True)
        self.release()
