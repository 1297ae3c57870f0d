"""``aenerf bench``: the paper's tables on simulated scenes."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.bench.plan import Poses, Scale, Table, plan
from aenerf_ns.errors import DataError
from aenerf_ns.progress import progress_bar


@dataclass
class Bench:
    """Simulate, train and evaluate scenes x speeds x methods x seeds, and write tables and figures.

    Can be stopped and repeated: what has been made stays. Several processes can share the work, see --shard.
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
    shard: str = "1/1"
    """Which part of the runs to make, as in 2/8: for the jobs of a scheduler's array that work on one folder."""

    def main(self) -> None:
        """Makes the runs and writes ``report.md`` and the figures."""
        from aenerf_ns.bench.figures import draw
        from aenerf_ns.bench.running import Runner
        from aenerf_ns.bench.tables import report

        part, parts = self._shard()
        runs = plan(
            self.scenes, self.speeds, self.poses, self.tables, self.seeds, self.scale, self.steps,
            self.simulate.split(), self.train.split(),
        )  # fmt: skip
        runner = Runner(self.output, self.device)
        failures = []
        with progress_bar() as progress:
            for run in progress.track(runs[part - 1 :: parts], description="Runs"):
                try:
                    results = runner.make(run)["results"]
                except DataError as error:
                    failures.append(str(error))
                    CONSOLE.print(f"[red]{run.name}: {error}")
                else:
                    CONSOLE.print(f"{run.name}: PSNR {results['psnr']:.2f} dB")
        figures = {run.name: one for run in runs if (one := runner.figures(run)) is not None}
        missing = [run.name for run in runs if run.name not in figures]
        file = self.output / "report.md"
        partial = self.output / f".report.{os.getpid()}"
        partial.write_text(report(list(figures.values()), missing), "utf8")
        partial.rename(file)
        drawn = draw(self.output, runs, figures)
        CONSOLE.print(f"{file}, {len(drawn)} figures beside it; {len(missing)} of {len(runs)} runs are missing.")
        if failures:
            raise DataError(self.output, f"{len(failures)} runs failed", "see above, and repeat the command")

    def _shard(self) -> tuple[int, int]:
        match = re.fullmatch(r"(\d+)/(\d+)", self.shard)
        part, parts = map(int, match.groups()) if match else (0, 0)
        if not 1 <= part <= parts:
            raise DataError("aenerf bench", f"--shard {self.shard}", "give it as 1/4, 2/4, 3/4 or 4/4")
        return part, parts
