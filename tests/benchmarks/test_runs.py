"""Commands of benchmarks: they end with the process that started them, and what fails is said in one line."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from aenerf_ns.errors import DataError
from benchmarks.runs import die_with_parent, run_command

ROOT = Path(__file__).parents[2]
_PARENT = """
import sys
from pathlib import Path
from subprocess import Popen
from benchmarks.runs import die_with_parent
command = [sys.executable, "-c", "import signal; print('ready', flush=True); signal.pause()"]
Popen(die_with_parent(command)).wait()
"""


@pytest.mark.skipif(shutil.which("setpriv") is None, reason="needs setpriv of util-linux")
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM])
def test_command_dies_with_its_parent(end: signal.Signals) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, "-c", _PARENT], stdout=subprocess.PIPE, env=environment, text=True
    ) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == "ready\n"
        parent.send_signal(end)
        # The command holds the other end of this pipe until it ends.
        assert parent.communicate(timeout=60)[0] == ""


def test_command_keeps_status_and_arguments() -> None:
    command = [sys.executable, "-c", "import sys; sys.exit(len(sys.argv))", "a b", ""]
    assert subprocess.run(die_with_parent(command), check=False).returncode == 3


def test_failed_command_names_its_log(tmp_path: Path) -> None:
    log = tmp_path / "a.log"
    run_command((sys.executable, "-c", "import os; print(os.environ['COLOR'])"), log, COLOR="red")
    with pytest.raises(DataError) as raised:
        run_command((sys.executable, "-c", "import os; print(os.getcwd()); exit(3)"), log, tmp_path)
    assert raised.value.source == log
    assert "status 3" in raised.value.problem
    assert [line for line in log.read_text().splitlines() if line[0] != "$"] == ["red", str(tmp_path)]
