"""The command ``python -m benchmarks.paper --output FOLDER``, which runs from the repository's root."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.cli.termination import sigterm_as_system_exit
from aenerf_ns.errors import DataError
from aenerf_ns.progress import track
from benchmarks.paper.figures import draw
from benchmarks.paper.plan import Plan, Run
from benchmarks.paper.running import Runner
from benchmarks.paper.tables import report
from benchmarks.runs import exclusive, run_benchmark


@dataclass(kw_only=True)
class Bench(Plan):
    """Simulate, train and evaluate scenes x speeds x methods x seeds, and write tables and figures.

    Stop the command at any time and repeat it: finished runs are kept. Several processes can work on one folder: start
    the same command several times, or as a scheduler's array.
    """

    output: Path
    """Folder of the benchmark."""
    device: Literal["cuda", "cpu"] = "cuda"
    """Where to train."""

    def main(self) -> None:
        """Make the runs and write ``report.md`` and the figures.

        Raises:
            DataError: two scenes have one name, or some runs failed.
        """
        runs = self.runs()
        runner = Runner(self.output, self.device)
        # The exception reaches the command that is running, which is then ended too.
        with sigterm_as_system_exit():
            failures = _make(runner, runs)
            self._report(runner, runs, failures)
        if failures:
            raise DataError(self.output, f"{len(failures)} runs failed", "see above, and repeat the command")

    def _report(self, runner: Runner, runs: list[Run], failures: dict[str, str]) -> None:
        file = self.output / "report.md"
        # One process at a time: the last one to write then writes all figures.
        with exclusive(file):
            figures = {run.name: one for run in runs if (one := runner.figures(run)) is not None}
            missing = {run.name: failures.get(run.name, "") for run in runs if run.name not in figures}
            file.write_text(report(list(figures.values()), missing), "utf8")
            drawn = draw(self.output, runs, figures)
        CONSOLE.print(f"{file}, {len(drawn)} figures beside it; {len(missing)} of {len(runs)} runs are missing.")


def _make(runner: Runner, runs: list[Run]) -> dict[str, str]:
    """Make all runs and return the errors of the failed ones, by the name of the run."""
    failures = {}
    for run in track(runs, "Runs"):
        try:
            made = runner.make(run)
        except DataError as error:
            failures[run.name] = str(error)
            CONSOLE.print(f"[red]{run.name}: {error}")
        else:
            done = "another process is making it" if made is None else f"PSNR {made['results']['psnr']:.2f} dB"
            CONSOLE.print(f"{run.name}: {done}")
    return failures


if __name__ == "__main__":
    run_benchmark(Bench)
