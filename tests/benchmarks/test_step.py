"""The cost of training steps: a small comparison by the command."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.small_datasets import CAMERA, write_native

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_compare_steps_with_commit(tmp_path: Path) -> None:
    data, output = write_native(tmp_path / "data"), tmp_path / "result.json"
    options = ("--measure", "small", "--against", "HEAD", "--rounds", "2")
    command = (sys.executable, "-m", "benchmarks.step", "--data", str(data), "--output", str(output), *options)
    environment = {**os.environ, "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    (row,) = json.loads(output.read_text("utf8"))["rows"]
    assert (row["baseline"]["commit"], row["subject"]["commit"]) == ("HEAD", None)
    for what, unit, units in (("step", "rays", 1024), ("picture", "pixels", CAMERA.width * CAMERA.height)):
        for clock in ("wall", "cpu"):
            figures = row[what][clock]
            for milliseconds, rate in zip(figures["milliseconds"], figures[f"{unit}_per_second"], strict=True):
                assert milliseconds * rate == pytest.approx(1e3 * units)
