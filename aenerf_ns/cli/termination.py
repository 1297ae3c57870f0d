"""SIGTERM during a command that writes an output."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from aenerf_ns.recording.output_lock import OutputLock


@contextmanager
def sigterm_as_system_exit() -> Iterator[None]:
    """Turn SIGTERM into :class:`SystemExit` within the context, so that a command that is terminated cleans up.

    Schedulers and ``kill`` send SIGTERM, which by default ends a process at once. Python already turns the keyboard's
    interrupt into an exception. Enter this context in the main thread only.
    """
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def exclusive_output(output: Path) -> Iterator[OutputLock]:
    """Keep an output that does not exist yet to this process, which cleans up if it is terminated.

    Raises:
        DataError: see :class:`~aenerf_ns.recording.output_lock.OutputLock`.
    """
    with sigterm_as_system_exit(), OutputLock(output) as lock:
        yield lock
