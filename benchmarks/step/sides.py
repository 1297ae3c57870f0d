"""The two sides of a comparison: each is a training in a process of its own, with the code of its own commit."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tarfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).parents[2]
_WORKER = Path(__file__).with_name("worker.py")


@dataclass(frozen=True)
class Side:
    """One side of a comparison.

    Attributes:
        arguments: of ns-train: the method and its options.
        threads: of torch and numba.
        commit: to measure; None for the code that is installed.
    """

    arguments: tuple[str, ...]
    threads: int = 1
    commit: str | None = None


class Training:
    """A training that waits for requests.

    Args:
        side: what to train.
        packages: folder with the package of the side's commit; None for the installed package.
        log: file for the output of the training.
        ending: the last arguments of ns-train.
    """

    def __init__(self, side: Side, packages: Path | None, log: Path, ending: tuple[str, ...]) -> None:
        self._log = log
        self._packages = packages
        paths = [str(packages)] * (packages is not None) + os.environ.get("PYTHONPATH", "").split(os.pathsep)
        threads = {"OMP_NUM_THREADS": str(side.threads), "NUMBA_NUM_THREADS": str(side.threads)}
        with log.open("w", encoding="utf8") as output:
            self._process = subprocess.Popen(
                [sys.executable, str(_WORKER), *side.arguments, *ending],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=output, text=True,
                env={**os.environ, **threads, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
            )  # fmt: skip

    def ask(self, name: str, *arguments: Any) -> Any:
        """Return the answer to a request; see ``worker.py``.

        Raises:
            SystemExit: the training has failed; with the end of its output.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write(json.dumps([name, *arguments]) + "\n")
            self._process.stdin.flush()
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            sys.exit(f"a training failed:\n{self._log.read_text('utf8')[-3000:]}")
        return json.loads(answer)

    def about(self, scale: float = 1.0) -> dict[str, Any]:
        """Wait until the training is ready, and scale the size of its picture.

        Returns:
            The most rays of a step and the pixels of the scaled picture.

        Raises:
            SystemExit: the training runs with the package of another commit.
        """
        about = self.ask("about", scale)
        package = Path(about.pop("package"))
        if self._packages is not None and not package.is_relative_to(self._packages):
            sys.exit(f"{package} was measured in place of the package in {self._packages}")
        return about

    def end(self) -> None:
        """End the process, and with it the processes that it has started."""
        self._process.communicate()


def install(commit: str, folder: Path) -> Path:
    """Install this project's package as of a commit, without its dependencies.

    Args:
        commit: as git names it.
        folder: empty folder to work in.

    Returns:
        The folder with the package, for PYTHONPATH.

    Raises:
        SystemExit: git or pip fails.
    """
    archive, source, packages = folder / "source.tar", folder / "source", folder / "packages"
    _run("git", "-C", str(_ROOT), "archive", "--output", str(archive), commit)
    with tarfile.open(archive) as file:
        file.extractall(source)
    _run(
        sys.executable, "-m", "pip", "install", "--no-deps", "--no-build-isolation", "--no-index",
        "--target", str(packages), str(source),
    )  # fmt: skip
    return packages


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(command)} ended with status {done.returncode}:\n{done.stderr[-3000:]}")
