"""One command at a time for an output."""

from __future__ import annotations

import errno
import os
import shutil
import socket
from pathlib import Path

from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import output_error, require_absent

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_NO_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP}


class OutputLock:
    """Keep an output that does not exist yet to this process. Use it as a context manager.

    The lock is a file beside the output, which names its owner. The system releases it when the owner ends, in whatever
    way. A file that a killed owner left locks nothing, and the next owner takes it over.

    Args:
        output: the folder that will be written.

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
        try:
            require_absent(self.output)
            output.parent.mkdir(parents=True, exist_ok=True)
            self._descriptor = self._locked()
            try:
                os.ftruncate(self._descriptor, 0)
                os.write(self._descriptor, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
            except OSError:
                self.release()
                raise
        except OSError as error:
            raise output_error(output, error) from None
        try:
            # The owner before may have finished in the meantime.
            require_absent(self.output)
        except DataError:
            self.release()
            raise

    def _locked(self) -> int:
        """Return the descriptor of the file, which this process has locked."""
        while True:
            descriptor = os.open(self._file, os.O_RDWR | os.O_CREAT, 0o666)
            try:
                if fcntl is None:
                    raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                owner = os.pread(descriptor, 200, 0).decode("utf8", "replace").strip()
                os.close(descriptor)
                problem = f"another command is writing it ({owner or 'its process is unknown'})"
                raise DataError(self.output, problem, "wait for its end or choose another --output") from None
            except OSError as error:
                if error.errno not in _NO_LOCKS:
                    raise
                CONSOLE.print(
                    f"[yellow]{self.output}: its file system has no locks ({error.strerror}): start no second command "
                    "with this output",
                    soft_wrap=True,
                )
                return descriptor
            # Its owner may have removed the file after it was opened here. Somebody else may then have made a new one.
            try:
                if os.path.samestat(os.fstat(descriptor), self._file.stat()):
                    return descriptor
            except FileNotFoundError:
                pass
            os.close(descriptor)

    def release(self) -> None:
        """Let others write the output."""
        if fcntl is None:
            # Windows removes no file that is open.
            os.close(self._descriptor)
            self._file.unlink(missing_ok=True)
            return
        self._file.unlink(missing_ok=True)
        os.close(self._descriptor)

    def __enter__(self) -> OutputLock:
        return self

    def __exit__(self, *_: object) -> None:
        # A signal may have come before whoever made the folder could remove it.
        shutil.rmtree(self.partial, ignore_errors=True)
        self.release()
