"""Quality on novel views of a built-in scene, through the framework's own commands.

    python benchmarks/quality.py --name room_easy --steps 3000

Simulates, trains and evaluates; writes benchmarks/results/NAME.json with the metrics and the commands, and
benchmarks/results/NAME.png with truth, reconstruction and depth of some test views.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
import tyro
from PIL import Image

from aenerf_ns.bench.environment import environment

_RESULTS = Path(__file__).parent / "results"
_NUM_PICTURES = 3
_EVALUATE = ("aenerf", "evaluate", "--output", "other.json")


@dataclass
class Quality:
    """Measure quality on a built-in scene."""

    name: str
    """Name of the files to write."""
    method: str = "aenerf-small"
    """Registered method."""
    steps: int = 2000
    """Training steps."""
    simulate: str = "--scene room --speed easy --width 160 --height 120"
    """Options of aenerf simulate."""
    protocols: tuple[str, ...] = ()
    """Other colour corrections than the run's to evaluate it under, with aenerf evaluate --color-correction."""
    train: str = ""
    """More options of ns-train, as in --train="--machine.seed 1"."""

    def main(self) -> None:
        """Measures and writes the figures and the picture."""
        with TemporaryDirectory() as folder:
            root = Path(folder)
            device = "cuda" if torch.cuda.is_available() else "cpu"
            simulate = ["aenerf", "simulate", "--output", "scene", *self.simulate.split()]
            train = ["ns-train", self.method, "--machine.device-type", device, "--vis", "tensorboard",
                     "--max-num-iterations", str(self.steps), *self.train.split(), "--data", "scene"]  # fmt: skip
            seconds = {"simulate": self._run(simulate, root), "train": self._run(train, root)}
            config = str(next(root.rglob("config.yml")).relative_to(root))
            evaluate = ["ns-eval", "--load-config", config, "--output-path", "out.json", "--render-output-path", "out"]
            seconds["evaluate"] = self._run(evaluate, root)
            others = {}
            for protocol in self.protocols:
                self._run([*_EVALUATE, "--load-config", config, "--color-correction", protocol], root)
                others[protocol] = json.loads((root / "other.json").read_text())["results"]
            results = json.loads((root / "out.json").read_text())["results"]
            self._picture(root / "out")
        report = {
            "results": results,
            "results_under": others,
            "seconds": seconds,
            "commands": [" ".join(command) for command in (simulate, train, evaluate)],
            **environment(),
        }
        (_RESULTS / f"{self.name}.json").write_text(json.dumps(report, indent=2) + "\n")
        print(json.dumps(report, indent=2))

    def _run(self, command: list[str], folder: Path) -> float:
        begin = time.perf_counter()
        script = Path(sys.executable).parent / command[0]
        subprocess.run([script, *command[1:]], cwd=folder, check=True, capture_output=True)
        return time.perf_counter() - begin

    def _picture(self, folder: Path) -> None:
        """Some of the test views below each other: truth, reconstruction, depth."""
        files = sorted(folder.glob("eval_img_*.png"))
        rows = []
        for file in files[:: max(len(files) // _NUM_PICTURES, 1)][:_NUM_PICTURES]:
            pair, depth = Image.open(file), Image.open(str(file).replace("_img_", "_depth_"))
            row = Image.new("RGB", (pair.width + depth.width, pair.height))
            row.paste(pair, (0, 0))
            row.paste(depth, (pair.width, 0))
            rows.append(row)
        picture = Image.new("RGB", (rows[0].width, sum(row.height for row in rows)))
        for index, row in enumerate(rows):
            picture.paste(row, (0, index * row.height))
        picture.save(_RESULTS / f"{self.name}.png", optimize=True)


if __name__ == "__main__":
    tyro.cli(Quality).main()
