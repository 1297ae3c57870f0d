"""Measure which contrast thresholds and refractory period training learns when the dataset's values are wrong.

    python -m benchmarks.sensor_parameters --output benchmarks/results/sensor_parameters_NAME.json

Simulates a sensor with known values, and trains with other values given.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.runs import evaluate, run_benchmark, run_script, train, write_result


@dataclass
class SensorParametersBenchmark:
    """Train with wrong thresholds and without a refractory period, and write the learned values."""

    output: Path
    """JSON file to write."""
    method: str = "aenerf-small"
    """Registered method."""
    steps: int = 1500
    """Training steps."""
    positive_contrast_threshold: float = 0.3
    """True C+."""
    negative_contrast_threshold: float = 0.2
    """True C-. Training is given this value for both thresholds."""
    refractory_period_ns: int = 5_000_000
    """True refractory period. Training is given none."""
    simulate: str = "--scene room --speed hard --width 96 --height 72 --validation-views 5 --test-views 5"
    """Options of aenerf simulate."""

    def main(self) -> None:
        """Simulate, train, evaluate, and write the figures."""
        negative = str(self.negative_contrast_threshold)
        data = (
            "--data", "data", "aenerf-data", "--positive-contrast-threshold", negative, "--refractory-period-ns", "0",
        )  # fmt: skip
        results = {}
        with TemporaryDirectory() as name:
            folder = Path(name)
            run_script(
                folder, "aenerf", "simulate", "--output", "data", *shlex.split(self.simulate),
                "--positive-contrast-threshold", str(self.positive_contrast_threshold),
                "--negative-contrast-threshold", negative,
                "--refractory-period-ns", str(self.refractory_period_ns),
            )  # fmt: skip
            for row, learned in (("learned", "True"), ("not learned", "False")):
                options = (
                    "--pipeline.model.supervision.learn-contrast-threshold-ratio", learned,
                    "--pipeline.model.supervision.learn-refractory-period", learned,
                )  # fmt: skip
                train(folder, f"learned_{learned}", self.method, self.steps, options, data)
                results[row] = evaluate(folder, f"learned_{learned}")
        true_ratio = self.positive_contrast_threshold / self.negative_contrast_threshold
        result = {
            "true": {"contrast_threshold_ratio": true_ratio, "refractory_period_ns": self.refractory_period_ns},
            "given": {"contrast_threshold_ratio": 1.0, "refractory_period_ns": 0},
            "results": results,
            "simulate": self.simulate,
            "steps": self.steps,
        }
        write_result(self.output, result)


if __name__ == "__main__":
    run_benchmark(SensorParametersBenchmark)
