"""Measure quality on novel views of a built-in scene, through the framework's own commands.

    python -m benchmarks.quality --name room_easy --steps 3000

Simulates, trains and evaluates. Writes benchmarks/results/NAME.json with the metrics, and benchmarks/results/NAME.png
with the truth, the reconstruction and the depth of some test views.
"""

from __future__ import annotations

import json
import shlex
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import tyro
from PIL import Image

from benchmarks.common import config_of, evaluate, run_script, train, write_result

_RESULTS = Path(__file__).parent / "results"
_NUM_PICTURES = 3


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
    """More color corrections to evaluate the run with, as in aenerf evaluate --color-correction."""
    train: str = ""
    """More options of ns-train, as in --train="--machine.seed 1"."""

    def main(self) -> None:
        """Measure, and write the figures and the picture."""
        with TemporaryDirectory() as name:
            folder = Path(name)
            simulating = run_script(folder, "aenerf", "simulate", "--output", "scene", *shlex.split(self.simulate))
            training = train(folder, "run", self.method, self.steps, shlex.split(self.train), ("--data", "scene"))
            results = evaluate(folder, "run", "--render-output-path", "pictures")
            _picture(folder / "pictures").save(_RESULTS / f"{self.name}.png", optimize=True)
            others = {protocol: _evaluate_under(folder, protocol) for protocol in self.protocols}
        seconds = {"simulate": simulating, "train": training}
        write_result(_RESULTS / f"{self.name}.json", {"results": results, "results_under": others, "seconds": seconds})


def _evaluate_under(folder: Path, protocol: str) -> dict[str, Any]:
    """Evaluate the run under another color correction than its own."""
    options = ("--load-config", config_of(folder, "run"), "--color-correction", protocol, "--output", "other.json")
    run_script(folder, "aenerf", "evaluate", *options)
    return json.loads((folder / "other.json").read_text("utf8"))["results"]


def _picture(folder: Path) -> Image.Image:
    """Return some test views in rows: truth, reconstruction and depth."""
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
    return picture


if __name__ == "__main__":
    tyro.cli(Quality).main()
