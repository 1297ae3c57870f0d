"""Run commands, keep what they made and write results, for all benchmarks."""

from __future__ import annotations

import functools
import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import tyro
from filelock import FileLock

from aenerf_ns.errors import DataError
from aenerf_ns.training.provenance import provenance


def die_with_parent(command: Sequence[str]) -> list[str]:
    """Return a command that runs a command and is killed when this process, or its thread that starts it, ends.

    A benchmark that is killed cannot end its commands. They would go on and write where its next start writes. Only
    Linux tells a process that its parent ends; elsewhere the command is returned as it is.
    """
    setpriv = shutil.which("setpriv")
    return [setpriv, "--pdeathsig", "KILL", "--", *command] if setpriv else list(command)


def run_command(command: Sequence[str], log: Path, folder: Path = Path(), **variables: str) -> None:
    """Run a command in a folder, with more environment variables.

    Its output is added to the file ``log``.

    Raises:
        DataError: the command failed.
    """
    with log.open("a", encoding="utf8") as output:
        output.write(f"$ {shlex.join(command)}\n")
        output.flush()
        with subprocess.Popen(
            die_with_parent(command), cwd=folder, env=os.environ | variables, stdout=output, stderr=subprocess.STDOUT
        ) as process:
            try:
                status = process.wait()
            except BaseException:
                # Otherwise the command would continue beside its successor from the next start.
                process.terminate()
                raise
    if status:
        raise DataError(log, f"a command ended with status {status}", "see the end of this file")


@contextmanager
def exclusive(path: Path, timeout: float = -1) -> Iterator[None]:
    """Hold the lock of a file or folder that is being made, which may lie beside others that make it.

    Raises:
        Timeout: another process holds it after ``timeout`` seconds. By default this one waits.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(path.with_name(f".{path.name}.lock"), timeout=timeout):
        yield


def write_result(output: Path, result: dict[str, Any], show: bool = True) -> None:
    """Write a result with its machine, versions, commit and command as JSON, and print the result unless not shown."""
    output.write_text(json.dumps({**result, **_provenance()}, indent=2) + "\n", "utf8")
    if show:
        print(json.dumps(result, indent=2), flush=True)


# Looked up once, before anything is written: a result in the checkout would count as a change to the commit.
_provenance = functools.cache(provenance)


def run_benchmark(kind: Callable[..., Any]) -> None:
    """Run the command of a benchmark: a dataclass of its options with a method ``main``."""
    command = tyro.cli(kind)
    # Code that is changed while the benchmark runs is not the code that runs.
    _provenance()
    try:
        command.main()
    except DataError as error:
        sys.exit(f"Error: {error}")
