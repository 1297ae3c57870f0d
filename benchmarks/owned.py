"""Commands that end with the process that started them, however that process ends.

A benchmark that is killed cannot end its commands. They would go on and write where the next start of the benchmark
writes.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

# Of Linux's prctl: the signal that a process gets when its parent ends. Replacing the program keeps it.
_SET_SIGNAL_OF_PARENTS_END = 1


def owned(command: Sequence[str]) -> list[str]:
    """Return a command that runs a command and is killed when this process, or its thread that starts it, ends.

    Only Linux tells a process that its parent ends. Elsewhere the command is returned as it is.

    Args:
        command: the path of a program, and its arguments.
    """
    if sys.platform != "linux":
        return list(command)
    return [sys.executable, "-I", str(Path(__file__).resolve()), str(os.getpid()), *command]


def main() -> None:
    """Become the command that the arguments name."""
    parent, *command = sys.argv[1:]
    ctypes.CDLL(None).prctl(_SET_SIGNAL_OF_PARENTS_END, signal.SIGKILL)
    if os.getppid() != int(parent):
        sys.exit("the process that started this command has ended")
    os.execv(command[0], command)


if __name__ == "__main__":
    main()
