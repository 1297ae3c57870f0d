"""The paper's ablations (tables 3 and 4) on a built-in scene, through the framework's own commands.

    python benchmarks/ablation.py --table losses --work WORK --output benchmarks/results/ablation_losses_NAME.json
    python benchmarks/ablation.py --table poses --work WORK --output benchmarks/results/ablation_poses_NAME.json

Simulates the dataset once for each size of pose noise, then trains and evaluates each row. Everything lands in the work
folder; rows that are there already, with the same options, are not run again: the command can be stopped and repeated.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
import tyro

from aenerf_ns.bench.environment import environment

# Root mean square of the pose noise: degrees and metres. What COLMAP left on a room walked through at constant and at
# changing speed was about 0.7 and 2.3 degrees, 0.3 and 2.1 % of the extent.
_NOISE = {"exact": (0.0, 0.0), "small": (0.7, 0.02), "middle": (2.0, 0.05), "large": (4.0, 0.1)}
_LOSSES = {
    "l_p + l_r": {"temporal_loss": 0.0, "distortion_loss": 0.0},
    "l_p + l_r + l_g": {"temporal_loss": 1e-3, "distortion_loss": 0.0},
    "l_p + l_r + l_d": {"temporal_loss": 0.0, "distortion_loss": 1e-3},
    "all": {"temporal_loss": 1e-3, "distortion_loss": 1e-3},
}


@dataclass(frozen=True)
class _Row:
    name: str
    noise: str
    options: tuple[str, ...]


@dataclass
class Ablation:
    """Run an ablation and write its table."""

    table: Literal["losses", "poses"]
    """The paper's table 4 or table 3."""
    work: Path
    """Folder for datasets, runs and their figures."""
    output: Path
    """JSON file to write."""
    method: str = "aenerf-small"
    """Registered method."""
    steps: int = 2000
    """Training steps."""
    pairs: int = 512
    """Pairs of a batch: two rays each, or three with the temporal loss."""
    simulate: str = "--scene room --speed hard --width 128 --height 96 --validation-views 10 --test-views 10"
    """Options of aenerf simulate."""
    noise: tuple[str, ...] = field(default_factory=lambda: tuple(_NOISE))
    """Sizes of pose noise of table 3."""
    modes: tuple[str, ...] = ("off", "network", "spline")
    """Kinds of pose correction of table 3."""
    seed: int = 42
    """Seed of the trainings."""
    jobs: int = 1
    """Trainings at the same time."""

    def main(self) -> None:
        """Runs what is missing, and writes the table."""
        rows = self._loss_rows() if self.table == "losses" else self._pose_rows()
        for noise in {row.noise: None for row in rows}:
            # Before the trainings, which run side by side.
            self._dataset(noise)
        with ThreadPoolExecutor(self.jobs) as pool:
            figures = list(pool.map(self._run, rows))
        report = {"table": self.table, "rows": figures, "simulate": self.simulate, "steps": self.steps,
                  "pairs": self.pairs, "noise": _NOISE, **environment()}  # fmt: skip
        self.output.write_text(json.dumps(report, indent=2) + "\n")
        print(_losses_table(figures) if self.table == "losses" else _poses_table(figures))

    def _loss_rows(self) -> list[_Row]:
        return [
            _Row(
                name,
                "exact",
                tuple(
                    word
                    for loss, weight in weights.items()
                    for word in (f"--pipeline.model.loss-coefficients.{loss.replace('_', '-')}", str(weight))
                )
                + self._rays(3 if weights["temporal_loss"] else 2)
                + ("--pipeline.model.camera-optimizer.mode", "off"),
            )
            for name, weights in _LOSSES.items()
        ]

    def _pose_rows(self) -> list[_Row]:
        return [
            _Row(f"{noise}, {mode}", noise, ("--pipeline.model.camera-optimizer.mode", mode, *self._rays(2)))
            for noise in self.noise
            for mode in self.modes
        ]

    def _rays(self, rays_per_pair: int) -> tuple[str, str]:
        return ("--pipeline.datamanager.train-num-rays-per-batch", str(rays_per_pair * self.pairs))

    def _dataset(self, noise: str) -> str:
        """The name of the dataset, in the work folder."""
        degrees, translation = _NOISE[noise]
        options = (
            *self.simulate.split(),
            "--pose-noise-degrees",
            str(degrees),
            "--pose-noise-translation",
            str(translation),
        )
        name = f"{noise}_{_digest(options)}"
        if not (self.work / name).exists():
            self.work.mkdir(parents=True, exist_ok=True)
            self._command("aenerf", "simulate", "--output", name, *options)
        return name

    def _run(self, row: _Row) -> dict:
        data = self._dataset(row.noise)
        settings = ("--machine.seed", str(self.seed), "--max-num-iterations", str(self.steps), *row.options)
        name = f"{self.table}_{row.name}_{_digest((self.method, data, *settings))}".replace(" ", "")
        file = self.work / f"{name}.json"
        if not file.exists():
            device = "cuda" if torch.cuda.is_available() else "cpu"
            # Later rows may be of a later commit than the first.
            commit = environment()["commit"]
            begin = time.perf_counter()
            self._command(
                "ns-train", self.method, "--machine.device-type", device, "--vis", "tensorboard",
                "--experiment-name", name, *settings, "--data", data,
            )  # fmt: skip
            seconds = time.perf_counter() - begin
            config = max((self.work / "outputs" / name).rglob("config.yml"))
            partial = self.work / f"{name}.partial.json"
            self._command("ns-eval", "--load-config", str(config.relative_to(self.work)), "--output-path", partial.name)
            figures = json.loads(partial.read_text())["results"]
            partial.unlink()
            figures |= {"name": row.name, "options": " ".join(row.options), "train_seconds": round(seconds),
                        "commit": commit}  # fmt: skip
            file.write_text(json.dumps(figures, indent=2) + "\n")
            print(row.name, round(figures["psnr"], 2), figures["pose_errors"]["corrected"], flush=True)
        return json.loads(file.read_text())

    def _command(self, name: str, *arguments: str) -> None:
        done = subprocess.run(
            [Path(sys.executable).parent / name, *arguments],
            cwd=self.work, env=os.environ, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False,
        )  # fmt: skip
        if done.returncode:
            raise SystemExit(f"{name} {' '.join(arguments)}\n{done.stdout[-3000:]}")


def _digest(options: tuple[str, ...]) -> str:
    """Tells apart what was made with other options."""
    return hashlib.sha256("\0".join(options).encode()).hexdigest()[:8]


def _losses_table(rows: list[dict]) -> str:
    lines = ["| losses | PSNR | SSIM |", "|---|---|---|"]
    return "\n".join(lines + [f"| {row['name']} | {row['psnr']:.2f} | {row['ssim']:.3f} |" for row in rows])


def _poses_table(rows: list[dict]) -> str:
    lines = [
        "| noise, ψ | rotation before | after | translation before | after | PSNR | SSIM |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        before, after = row["pose_errors"]["estimated"], row["pose_errors"]["corrected"]
        lines.append(
            f"| {row['name']} | {before['rotation_error_degrees']:.2f}° | {after['rotation_error_degrees']:.2f}° "
            f"| {100 * before['translation_error']:.2f} cm | {100 * after['translation_error']:.2f} cm "
            f"| {row['psnr']:.2f} | {row['ssim']:.3f} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    tyro.cli(Ablation).main()
