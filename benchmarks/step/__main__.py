"""Measure training steps and rendered pictures: by part, beside nerfacto, and beside an earlier commit.

    python -m benchmarks.step --data demo/room --against ae14542 --output benchmarks/results/step_cpu2.json

A comparison has two sides, a baseline and a subject. Each side is a training in a process of its own. The sides take
turns, so that other work on the machine slows both. A ratio is the time of the subject through that of the baseline,
within one round of turns. On a machine with a GPU, the trainings run there.
"""

from __future__ import annotations

import shlex
import statistics
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args

import torch

from benchmarks.runs import run_benchmark, write_result
from benchmarks.step.sides import Side, Training, install

Measurement = Literal[
    "small", "small-two-threads", "full", "temporal-loss", "nerfacto-small", "nerfacto-full", "seconds-to-psnr"
]

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
# With the sizes of `aenerf-small`.
_NERFACTO_SMALL = (
    *_NERFACTO, _RAYS, "1024", *_CHUNK, "--pipeline.model.num-levels", "8", "--pipeline.model.max-res", "256",
    "--pipeline.model.log2-hashmap-size", "15", "--pipeline.model.hidden-dim", "32",
    "--pipeline.model.hidden-dim-color", "32", "--pipeline.model.num-nerf-samples-per-ray", "24",
    "--pipeline.model.num-proposal-iterations", "1", "--pipeline.model.num-proposal-samples-per-ray", "48",
    "--pipeline.model.proposal-net-args-list.0.num-levels", "4",
    "--pipeline.model.proposal-net-args-list.0.max-res", "64",
    "--pipeline.model.proposal-net-args-list.0.log2-hashmap-size", "14",
)  # fmt: skip
_TEMPORAL_LOSS = ("--pipeline.model.loss-coefficients.temporal-loss", "0.001")
# A run to a PSNR has so many turns. Its second half is evaluated, because the schedules reach the quality at the end.
_PSNR_TURNS = 16


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
    psnr: float = 28.5
    """PSNR over the validation views whose seconds are measured, in dB."""
    psnr_steps: int = 800
    """Steps of the runs that shall reach it."""

    def main(self) -> None:
        """Measure and write the figures."""
        small, full, two_threads = Side(_SMALL), Side(_FULL), Side(_SMALL, threads=2)
        to_psnr = Side((*_SMALL, "--max-num-iterations", str(self.psnr_steps)))
        comparisons: dict[Measurement, tuple[Side, Side]] = {
            "small": (replace(small, commit=self.against), small),
            "small-two-threads": (replace(two_threads, commit=self.against), two_threads),
            "full": (replace(full, commit=self.against), full),
            "temporal-loss": (small, Side((*_SMALL, *_TEMPORAL_LOSS))),
            "nerfacto-small": (Side(_NERFACTO_SMALL), small),
            "nerfacto-full": (Side(_NERFACTO_FULL), full),
            "seconds-to-psnr": (replace(to_psnr, commit=self.against), to_psnr),
        }
        rows = []
        with TemporaryDirectory() as folder:
            for name in self.measure:
                sides = comparisons[name]
                with self._trainings(sides, Path(folder)) as trainings:
                    figures = (
                        self._seconds_to_psnr(*trainings)
                        if name == "seconds-to-psnr"
                        else self._cost(trainings, long=not _ON_GPU and "full" in name)
                    )
                described = [{**vars(side), "arguments": shlex.join(side.arguments)} for side in sides]
                rows.append({"measurement": name, "baseline": described[0], "subject": described[1], **figures})
                # After each comparison, because all of them take long.
                write_result(self.output, {"rows": rows})

    @contextmanager
    def _trainings(self, sides: tuple[Side, Side], folder: Path) -> Iterator[list[Training]]:
        """Start the trainings of both sides, and end them."""
        trainings: list[Training] = []
        try:
            for index, side in enumerate(sides):
                packages = None
                if side.commit is not None:
                    packages = folder / side.commit / "packages"
                    if not packages.exists():
                        packages.parent.mkdir(parents=True)
                        install(side.commit, packages.parent)
                # nerfacto reads the images with the estimated poses.
                images = ("nerfstudio-data",) if side.arguments[0] == "nerfacto" else ()
                ending = (
                    "--machine.device-type", "cuda" if _ON_GPU else "cpu", "--vis", "tensorboard",
                    "--output-dir", str(folder / str(index)), *images, "--data", str(self.data.resolve()),
                )  # fmt: skip
                trainings.append(Training(side, packages, folder / f"{index}.log", ending))
            yield trainings
        finally:
            for training in trainings:
                training.end()

    def _cost(self, trainings: list[Training], long: bool) -> dict[str, Any]:
        """Return the cost of steps and of pictures, and the parts of a step.

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
        # Before the pictures, because rendering puts off the next training of the proposal networks.
        parts = [training.ask("parts", steps) for training in trainings]
        rendered = self._turns(trainings, "render")
        return {
            "step": _compare(trained, steps, "rays", [one["rays"] for one in about]),
            "picture": _compare(rendered, 1, "pixels", [one["pixels"] for one in about]),
            "milliseconds_of_parts": [
                {part: 1e3 * seconds / steps for part, seconds in of_side.items()} for of_side in parts
            ],
        }

    def _turns(self, trainings: list[Training], *request: Any) -> list[list[dict[str, float]]]:
        """Return the seconds of each side in each round, (side, round). The side that begins changes every round."""
        seconds: list[list[dict[str, float]]] = [[], []]
        for turn in range(self.rounds):
            for side in (0, 1) if turn % 2 else (1, 0):
                seconds[side].append(trainings[side].ask(*request))
        return seconds

    def _seconds_to_psnr(self, *trainings: Training) -> dict[str, Any]:
        """Return the seconds of training until the PSNR is reached, without start-up and without the evaluations."""
        for training in trainings:
            training.about()
        steps = self.psnr_steps // _PSNR_TURNS
        curves: list[list[dict[str, float]]] = [[], []]
        spent = [{"wall": 0.0, "cpu": 0.0} for _ in trainings]
        for turn in range(1, _PSNR_TURNS + 1):
            for training, curve, seconds in zip(trainings, curves, spent, strict=True):
                if curve and curve[-1]["psnr"] >= self.psnr:
                    continue
                for clock, value in training.ask("train", steps).items():
                    seconds[clock] += value
                if turn >= _PSNR_TURNS // 2:
                    curve.append({"step": turn * steps, "psnr": training.ask("psnr"), **seconds})
        reached = [curve[-1] if curve[-1]["psnr"] >= self.psnr else None for curve in curves]
        ratio = None
        if reached[0] is not None and reached[1] is not None:
            ratio = {clock: reached[1][clock] / reached[0][clock] for clock in ("wall", "cpu")}
        return {"psnr": self.psnr, "curves": curves, "ratio_of_seconds": ratio}


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
        baseline, subject = ([one[clock] / count for one in of_side] for of_side in seconds)
        medians = [statistics.median(of_side) for of_side in (baseline, subject)]
        result[clock] = {
            "milliseconds": [1e3 * median for median in medians],
            f"{unit}_per_second": [number / median for number, median in zip(units, medians, strict=True)],
            "quartiles_of_ratio": statistics.quantiles((b / a for a, b in zip(baseline, subject, strict=True)), n=4),
        }
    return result


if __name__ == "__main__":
    run_benchmark(StepCost)
