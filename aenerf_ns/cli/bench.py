"""``aenerf bench``: the paper's tables on simulated scenes."""

from __future__ import annotations

import shlex
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from filelock import FileLock
from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.bench.plan import Poses, Scale, Table, plan
from aenerf_ns.errors import DataError
from aenerf_ns.progress import progress_bar


@dataclass
class Bench:
    """Simulate, train and evaluate scenes x speeds x methods x seeds, and write tables and figures.

    Can be stopped and repeated: what has been made stays. Several processes can work on one folder: the same command,
    started several times, or as a scheduler's array.
    """

    output: Path
    """Folder of the benchmark."""
    scale: Scale = "full"
    """346 x 260 pixels with aenerf, or for a CPU 96 x 72 with aenerf-small."""
    scenes: tuple[str, ...] = ("room", "object")
    """Scenes as aenerf simulate takes them: built-in ones and files."""
    speeds: tuple[Literal["easy", "hard"], ...] = ("easy", "hard")
    """Constant speed, and 8^sin(2 pi t) times that speed."""
    poses: Poses = "noise"
    """How the estimated poses come about."""
    tables: tuple[Table, ...] = ("methods", "losses")
    """Methods (the paper's tables 1 and 3), losses (its table 4)."""
    seeds: tuple[int, ...] = (42,)
    """Seeds of the trainings."""
    steps: int | None = None
    """Steps of every training; 30,000 or, for a CPU, 1500 by default."""
    simulate: str = ""
    """More options of aenerf simulate, as in --simulate="--bayer-pattern RGGB"."""
    train: str = ""
    """More options of the event method's trainings."""
    device: Literal["cuda", "cpu"] = "cuda"
    """Where to train."""

    def main(self) -> None:
        """Makes the runs and writes ``report.md`` and the figures."""
        from aenerf_ns.bench.figures import draw
        from aenerf_ns.bench.running import Runner
        from aenerf_ns.bench.tables import report

        runs = plan(
            self.scenes, self.speeds, self.poses, self.tables, self.seeds, self.scale, self.steps,
            shlex.split(self.simulate), shlex.split(self.train),
        )  # fmt: skip
        runner = Runner(self.output, self.device)
        # A scheduler ends its jobs so: as an exception it reaches the command that runs, which is not left behind.
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
        failures = {}
        with progress_bar() as progress:
            for run in progress.track(runs, description="Runs"):
                try:
                    made = runner.make(run)
                except DataError as error:
                    failures[run.name] = str(error)
                    CONSOLE.print(f"[red]{run.name}: {error}")
                else:
                    done = "another process is at it" if made is None else f"PSNR {made['results']['psnr']:.2f} dB"
                    CONSOLE.print(f"{run.name}: {done}")
        file = self.output / "report.md"
        # One process after the other, so that what is written last is the whole.
        with FileLock(self.output / ".report.lock"):
            figures = {run.name: one for run in runs if (one := runner.figures(run)) is not None}
            missing = {run.name: failures.get(run.name, "") for run in runs if run.name not in figures}
            file.write_text(report(list(figures.values()), missing), "utf8")
            drawn = draw(self.output, runs, figures)
        CONSOLE.print(f"{file}, {len(drawn)} figures beside it; {len(missing)} of {len(runs)} runs are missing.")
        if failures:
            raise DataError(self.output, f"{len(failures)} runs failed", "see above, and repeat the command")
