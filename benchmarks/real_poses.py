r"""Pose correction on a real recording: known poses are perturbed, and the correction is compared with them.

    python benchmarks/real_poses.py --recording slider_depth --output benchmarks/results/real_poses_NAME.json \
        --train="--pipeline.model.near-plane 0.25 --pipeline.model.far-plane 20"

The recording is in the text format of the Event Camera Dataset. Its poses serve as ground truth; training gets the
perturbed ones.
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
from aenerf_ns.camera.noise import perturb
from aenerf_ns.files.tum_trajectory import read_tum_trajectory, write_tum_trajectory


@dataclass
class RealPoses:
    """Pose errors of a real recording before and after correction."""

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
    """Root mean square of the rotations' error over the whole trajectory, in degrees."""
    translation: float = 0.01
    """Root mean square of the positions' error, in the units of the recording."""
    correlation_time: float = 0.05
    """Seconds over which the errors are alike."""
    train: str = ""
    """More options of ns-train."""

    def main(self) -> None:
        """Perturbs, trains, and writes the figures."""
        truth = read_tum_trajectory(self.recording / "groundtruth.txt")
        noisy = perturb(truth, self.degrees, self.translation, self.correlation_time, seed=0)
        figures = {}
        for mode in self.modes:
            with TemporaryDirectory() as folder:
                write_tum_trajectory(Path(folder) / "perturbed.txt", noisy)
                figures[mode] = self._run(mode, Path(folder))
        report = {
            "recording": self.recording.name,
            "steps": self.steps,
            "noise": {
                "degrees": self.degrees,
                "translation": self.translation,
                "correlation_time": self.correlation_time,
            },
            "pose_errors": figures,
            **environment(),
        }
        self.output.write_text(json.dumps(report, indent=2) + "\n")
        print(json.dumps(figures, indent=2))

    def _run(self, mode: str, folder: Path) -> dict:
        device = "cuda" if torch.cuda.is_available() else "cpu"
        self._command(
            folder, "ns-train", self.method, "--machine.device-type", device, "--vis", "tensorboard",
            "--max-num-iterations", str(self.steps), "--pipeline.model.camera-optimizer.mode", mode,
            *self.train.split(), "--data", str(self.recording.resolve()), "ecd-data", "--trajectory", "perturbed.txt",
        )  # fmt: skip
        config = next(folder.rglob("config.yml"))
        self._command(folder, "ns-eval", "--load-config", str(config), "--output-path", "out.json")
        return json.loads((folder / "out.json").read_text())["results"]["pose_errors"]

    def _command(self, folder: Path, name: str, *arguments: str) -> None:
        subprocess.run([Path(sys.executable).parent / name, *arguments], cwd=folder, check=True, capture_output=True)


if __name__ == "__main__":
    tyro.cli(RealPoses).main()
