"""Commands that end with the process that started them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks import owned as module
from benchmarks.owned import owned

_PARENT = """
import subprocess, sys
from benchmarks.owned import owned
child = subprocess.Popen(owned([sys.executable, "-c", "import time; print('ready', flush=True); time.sleep(60)"]))
print(child.pid, flush=True)
child.wait()
"""


def _ended(pid: int) -> bool:
    """Whether a process has ended; a zombie, which nobody waits for, has."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM])
def test_a_command_ends_with_its_parent(end: signal.Signals) -> None:
    root = str(Path(module.__file__).parents[1])
    environment = {**os.environ, "PYTHONPATH": root}
    with subprocess.Popen(
        [sys.executable, "-c", _PARENT], stdout=subprocess.PIPE, env=environment, text=True
    ) as parent:
        assert parent.stdout is not None
        lines = {parent.stdout.readline().strip() for _ in range(2)}
        lines.remove("ready")
        child = int(lines.pop())
        assert not _ended(child)
        parent.send_signal(end)
    deadline = time.monotonic() + 60
    while not _ended(child):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_command_of_a_parent_that_has_ended_does_not_start() -> None:
    command = owned(["/bin/echo", "started"])
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "started\n"
    command[3] = "1"
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "started" not in done.stdout


def test_a_command_keeps_its_status_and_arguments() -> None:
    done = subprocess.run(owned([sys.executable, "-c", "import sys; sys.exit(len(sys.argv))", "a b", ""]), check=False)
    assert done.returncode == 3
