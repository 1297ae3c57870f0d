"""Measure training steps and rendered pictures, beside nerfacto and beside an earlier commit.

    python -m benchmarks.step --data demo/room --against ae14542 --output benchmarks/results/step_cpu2.json

A comparison has two sides, a baseline and a subject. Each side is a training in a process of its own. The sides take
turns, so that other work on the machine slows both. A ratio is the time of the subject through that of the baseline,
within one round of turns. On a machine with a GPU, the trainings run there.
"""

from __future__ import annotations

import json
import os
import shlex
import statistics
import subprocess
import sys
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args

import torch

from aenerf_ns.errors import DataError
from benchmarks.paper.plan import SMALL_NERFACTO
from benchmarks.runs import die_with_parent, run_benchmark, run_command, write_result

Measurement = Literal["small", "small-two-threads", "full", "temporal-loss", "nerfacto-small", "nerfacto-full"]

_ROOT = Path(__file__).parents[2]
_WORKER = Path(__file__).with_name("worker.py")
_ON_GPU = torch.cuda.is_available()
_SMALL = ("aenerf-small", "--pipeline.model.camera-optimizer.mode", "spline")
_RAYS = "--pipeline.datamanager.train-num-rays-per-batch"
# On a CPU, a step of 8192 rays takes too long, and a small chunk renders faster because it fits the cache.
_CHUNK = () if _ON_GPU else ("--pipeline.model.eval-num-rays-per-chunk", "1024")
_FULL_RAYS = (_RAYS, "8192" if _ON_GPU else "1024", *_CHUNK)
_FULL = ("aenerf", *_SMALL[1:], *_FULL_RAYS)
# The framework's implementation that needs no CUDA extension. Its grids, networks and samples are those of `aenerf`.
_NERFACTO = ("nerfacto", "--pipeline.model.implementation", "torch")
_NERFACTO_FULL = (*_NERFACTO, *_FULL_RAYS)
# Its proposal network is that of `aenerf-small`, too.
_NERFACTO_SMALL = (
    *_NERFACTO, *SMALL_NERFACTO, *_CHUNK,
    "--pipeline.model.proposal-net-args-list.0.num-levels", "4",
    "--pipeline.model.proposal-net-args-list.0.max-res", "64",
    "--pipeline.model.proposal-net-args-list.0.log2-hashmap-size", "14",
)  # fmt: skip
_TEMPORAL_LOSS = ("--pipeline.model.loss-coefficients.temporal-loss", "0.001")


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
    """A training in a process of its own, which waits for requests.

    Args:
        side: what to train.
        folder: for the log, the run, and the packages of earlier commits.
        data: the dataset.
    """

    def __init__(self, side: Side, folder: Path, data: Path) -> None:
        self._packages = None if side.commit is None else _install(side.commit, folder)
        self._log = folder / f"{len(list(folder.glob('*.log')))}.log"
        paths = [str(self._packages or ""), os.environ.get("PYTHONPATH", "")]
        threads = {"OMP_NUM_THREADS": str(side.threads), "NUMBA_NUM_THREADS": str(side.threads)}
        output = ("--output-dir", str(self._log.with_suffix("")))
        device = ("--machine.device-type", "cuda" if _ON_GPU else "cpu", "--vis", "tensorboard")
        # nerfacto reads the images with the estimated poses.
        images = ("nerfstudio-data",) if side.arguments[0] == "nerfacto" else ()
        ending = (*device, *images, "--data", str(data.resolve()))
        command = (sys.executable, str(_WORKER), *side.arguments, *output, *ending)
        with self._log.open("w", encoding="utf8") as log:
            self._process = subprocess.Popen(
                die_with_parent(command), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True,
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

    def about(self, scale: float) -> dict[str, Any]:
        """Wait until the training is ready, and scale the size of its picture.

        Returns:
            The most rays of a step and the pixels of the scaled picture.

        Raises:
            DataError: the training runs with the package of another commit.
        """
        about = self.ask("about", scale)
        package = Path(about.pop("package"))
        if self._packages is not None and not package.is_relative_to(self._packages):
            raise DataError(package, "another commit's package would be measured", "check PYTHONPATH")
        return about

    def close(self) -> None:
        """End the process, and with it the processes that it has started."""
        self._process.communicate()


def _install(commit: str, folder: Path) -> Path:
    """Install this project's package as of a commit, without its dependencies. Return the folder for PYTHONPATH."""
    packages, source, log = folder / commit / "packages", folder / commit / "source", folder / commit / "install"
    if not packages.exists():
        source.mkdir(parents=True)
        run_command(("git", "-C", str(_ROOT), "archive", "--output", str(source) + ".tar", commit), log)
        run_command(("tar", "-xf", f"{source}.tar", "-C", str(source)), log)
        pip = (sys.executable, "-m", "pip", "install", "--no-deps", "--no-build-isolation", "--no-index")
        run_command((*pip, "--target", str(packages), str(source)), log)
    return packages


@dataclass
class StepCost:
    """Measure training steps and rendered pictures."""

    data: Path
    """Dataset of aenerf simulate, with validation views."""
    output: Path
    """JSON file to write."""
    against: str = "ae14542"
    """Earlier commit to compare with."""
    measure: tuple[Measurement, ...] = get_args(Measurement)
    """The comparisons to make."""
    rounds: int = 12
    """Turns of each side, at least 2."""

    def main(self) -> None:
        """Measure and write the figures."""
        small, full, two_threads = Side(_SMALL), Side(_FULL), Side(_SMALL, threads=2)
        comparisons: dict[Measurement, tuple[Side, Side]] = {
            "small": (replace(small, commit=self.against), small),
            "small-two-threads": (replace(two_threads, commit=self.against), two_threads),
            "full": (replace(full, commit=self.against), full),
            "temporal-loss": (small, Side((*_SMALL, *_TEMPORAL_LOSS))),
            "nerfacto-small": (Side(_NERFACTO_SMALL), small),
            "nerfacto-full": (Side(_NERFACTO_FULL), full),
        }
        rows = []
        with TemporaryDirectory() as folder:
            for name in self.measure:
                sides = comparisons[name]
                with ExitStack() as stack:
                    started = (Training(side, Path(folder), self.data) for side in sides)
                    trainings = [stack.enter_context(closing(training)) for training in started]
                    figures = self._cost(trainings, long=not _ON_GPU and "full" in name)
                described = [{**vars(side), "arguments": shlex.join(side.arguments)} for side in sides]
                rows.append({"measurement": name, "baseline": described[0], "subject": described[1], **figures})
                # The file is written after each comparison, because all of them take long.
                write_result(self.output, {"rows": rows})

    def _cost(self, trainings: list[Training], long: bool) -> dict[str, Any]:
        """Return the cost of steps and of pictures.

        Args:
            trainings: of the baseline and of the subject.
            long: whether steps take so long that a turn has few steps, and a picture of a quarter of the width.
        """
        # An even number, because the proposal networks are trained every second step.
        steps, scale = (2, 0.25) if long else (8, 1.0)
        about = [training.about(scale) for training in trainings]
        for training in trainings:
            training.ask("render")
            # The first steps compile, and the first ten all train the proposal networks.
            training.ask("train", 10)
        trained = self._turns(trainings, "train", steps)
        rendered = self._turns(trainings, "render")
        return {
            "step": _compare(trained, steps, "rays", [side["rays"] for side in about]),
            "picture": _compare(rendered, 1, "pixels", [side["pixels"] for side in about]),
        }

    def _turns(self, trainings: list[Training], *request: Any) -> list[list[dict[str, float]]]:
        """Return the seconds of each side in each round, (side, round). The side that begins changes every round."""
        seconds: list[list[dict[str, float]]] = [[], []]
        for turn in range(self.rounds):
            for side in (0, 1) if turn % 2 else (1, 0):
                seconds[side].append(trainings[side].ask(*request))
        return seconds


def _compare(seconds: list[list[dict[str, float]]], count: int, unit: str, units: list[int]) -> dict[str, Any]:
    """Return medians of both sides, and the quartiles of the ratios within a round.

    Args:
        seconds: (side, round) of ``count`` pieces of work.
        count: pieces of work in a turn.
        unit: that a piece of work consists of.
        units: (side,) in a piece of work.
    """
    result: dict[str, Any] = {}
    for clock in ("wall", "cpu"):
        baseline, subject = ([turn[clock] / count for turn in of_side] for of_side in seconds)
        medians = [statistics.median(of_side) for of_side in (baseline, subject)]
        result[clock] = {
            "milliseconds": [1e3 * median for median in medians],
            f"{unit}_per_second": [number / median for number, median in zip(units, medians, strict=True)],
            "quartiles_of_ratio": statistics.quantiles((b / a for a, b in zip(baseline, subject, strict=True)), n=4),
        }
    return result


if __name__ == "__main__":
    run_benchmark(StepCost)
