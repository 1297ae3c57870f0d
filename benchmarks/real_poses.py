r"""Measure pose correction on a real recording: perturb its poses, and compare the corrected poses with the given ones.

    python -m benchmarks.real_poses --recording slider_depth --output benchmarks/results/real_poses_NAME.json \
        --train="--pipeline.model.near-plane 0.25 --pipeline.model.far-plane 20"

The recording is in the text format of the Event Camera Dataset.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from aenerf_ns.camera.noise import perturb
from aenerf_ns.files.tum_trajectory import read_tum_trajectory, write_tum_trajectory
from benchmarks.runs import evaluate, run_benchmark, train, write_result


@dataclass
class RealPoses:
    """Measure the pose errors of a real recording before and after correction."""

    recording: Path
    """Folder of the recording."""
    output: Path
    """JSON file to write."""
    modes: tuple[str, ...] = ("spline", "network")
    """Kinds of pose correction."""
    method: str = "aenerf-small"
    """Registered method."""
    steps: int = 1500
    """Training steps."""
    degrees: float = 1.0
    """Root mean square of the added rotations over the whole trajectory, in degrees."""
    translation: float = 0.01
    """Root mean square of the added translations, in the units of the recording."""
    correlation_time: float = 0.05
    """Seconds over which the added errors are alike."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the added errors and of the trainings. Results without seeds were made with 0 and 42."""
    train: str = ""
    """More options of ns-train."""

    def main(self) -> None:
        """Perturb, train, and write the figures."""
        noise = {"degrees": self.degrees, "translation": self.translation, "correlation_time": self.correlation_time}
        given = read_tum_trajectory(self.recording / "groundtruth.txt")
        data = ("--data", str(self.recording.resolve()), "ecd-data", "--trajectory", "perturbed.txt")
        with TemporaryDirectory() as name:
            folder = Path(name)
            figures: dict[str, list[dict[str, Any]]] = {mode: [] for mode in self.modes}
            for seed in self.seeds:
                perturbed = perturb(given, self.degrees, self.translation, self.correlation_time, seed)
                write_tum_trajectory(folder / "perturbed.txt", perturbed)
                for mode in self.modes:
                    options = (
                        "--pipeline.model.camera-optimizer.mode", mode, "--machine.seed", str(seed),
                        *shlex.split(self.train),
                    )  # fmt: skip
                    run = f"{mode}_{seed}"
                    train(folder, run, self.method, self.steps, options, data)
                    figures[mode].append({"seed": seed, **evaluate(folder, run)["pose_errors"]})
        result = {"recording": self.recording.name, "steps": self.steps, "noise": noise, "pose_errors": figures}
        write_result(self.output, result)


if __name__ == "__main__":
    run_benchmark(RealPoses)
