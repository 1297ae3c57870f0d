r"""Learned contrast thresholds and refractory period: what training finds when the dataset's values are wrong.

    python benchmarks/sensor_parameters.py --output benchmarks/results/sensor_parameters_NAME.json

A sensor with known values is simulated, and training is told others.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
import tyro

from aenerf_ns.bench.environment import environment


@dataclass
class SensorParametersBenchmark:
    """Train from wrong thresholds and without a refractory period, and write what was learned."""

    output: Path
    """JSON file to write."""
    method: str = "aenerf-small"
    """Registered method."""
    steps: int = 1500
    """Training steps."""
    positive_contrast_threshold: float = 0.3
    """True C+."""
    negative_contrast_threshold: float = 0.2
    """True C-, which training is given for both thresholds."""
    refractory_period_ns: int = 5_000_000
    """True refractory period; training is given none."""
    simulate: str = "--scene room --speed hard --width 96 --height 72 --validation-views 5 --test-views 5"
    """Options of aenerf simulate."""

    def main(self) -> None:
        """Simulates, trains, evaluates, and writes the figures."""
        with TemporaryDirectory() as name:
            folder = Path(name)
            self._command(
                folder, "aenerf", "simulate", "--output", "data", *self.simulate.split(),
                "--positive-contrast-threshold", str(self.positive_contrast_threshold),
                "--negative-contrast-threshold", str(self.negative_contrast_threshold),
                "--refractory-period-ns", str(self.refractory_period_ns),
            )  # fmt: skip
            rows = {}
            for row, learned in (("learned", "True"), ("not learned", "False")):
                rows[row] = self._run(folder, learned)
        report = {
            "true": {
                "contrast_threshold_ratio": self.positive_contrast_threshold / self.negative_contrast_threshold,
                "refractory_period_ns": self.refractory_period_ns,
            },
            "given": {"contrast_threshold_ratio": 1.0, "refractory_period_ns": 0},
            "results": rows,
            "simulate": self.simulate,
            "steps": self.steps,
            **environment(),
        }
        self.output.write_text(json.dumps(report, indent=2) + "\n")
        print(json.dumps(report, indent=2))

    def _run(self, folder: Path, learned: str) -> dict:
        device = "cuda" if torch.cuda.is_available() else "cpu"
        name = f"learned_{learned}"
        self._command(
            folder, "ns-train", self.method, "--machine.device-type", device, "--vis", "tensorboard",
            "--experiment-name", name, "--max-num-iterations", str(self.steps),
            "--pipeline.model.learn-contrast-threshold-ratio", learned,
            "--pipeline.model.learn-refractory-period", learned, "--data", "data", "aenerf-data",
            "--positive-contrast-threshold", str(self.negative_contrast_threshold), "--refractory-period-ns", "0",
        )  # fmt: skip
        config = next((folder / "outputs" / name).rglob("config.yml")).relative_to(folder)
        self._command(folder, "ns-eval", "--load-config", str(config), "--output-path", f"{name}.json")
        return json.loads((folder / f"{name}.json").read_text())["results"]

    def _command(self, folder: Path, name: str, *arguments: str) -> None:
        subprocess.run([Path(sys.executable).parent / name, *arguments], cwd=folder, check=True, capture_output=True)


if __name__ == "__main__":
    tyro.cli(SensorParametersBenchmark).main()
