"""The cost of training steps: parts of made-up steps, and small comparisons by the command."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.commands import simulate
from helpers.small_datasets import CAMERA, write_native
from torch.profiler import profile

from benchmarks.step.worker import ranged, seconds_of_parts

ROOT = Path(__file__).parents[2]


def measure(data: Path, *options: str) -> dict[str, Any]:
    """Measures on a dataset and returns the row of the result."""
    output = data.with_name("result.json")
    command = (sys.executable, "-m", "benchmarks.step", "--data", str(data), "--output", str(output), *options)
    environment = {**os.environ, "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    (row,) = json.loads(output.read_text("utf8"))["rows"]
    return row


def test_the_parts_of_a_step_add_up_and_take_their_share_of_the_backward_pass() -> None:
    weights, inputs = torch.ones(300, 300, requires_grad=True), torch.ones(300, 300)

    def losses() -> torch.Tensor:
        # 20 products in the part around it, one in the part within.
        many = inputs
        for _ in range(20):
            many = many @ weights
        return (many + ranged(lambda: inputs @ weights, "field")()).sum()

    with profile() as profiler:
        ranged(lambda: ranged(torch.Tensor.backward, "backward")(ranged(losses, "losses")()), "rest")()
    seconds = seconds_of_parts(profiler.events(), on_gpu=False)
    of_backward = {"backward", "backward of losses", "backward of field", "backward of rest"}
    assert set(seconds) == {"rest", "losses", "field", *of_backward}
    assert min(seconds.values()) > 0
    (whole,) = (event.cpu_time_total for event in profiler.events() if event.name.endswith(": rest"))
    assert sum(seconds.values()) == pytest.approx(whole * 1e-6)
    assert seconds["losses"] > 3 * seconds["field"]
    assert seconds["backward of losses"] > 3 * seconds["backward of field"]


@pytest.mark.slow
def test_the_command_compares_steps_and_pictures_and_lists_the_parts(tmp_path: Path) -> None:
    row = measure(write_native(tmp_path / "data"), "--measure", "temporal-loss", "--rounds", "2")
    assert "temporal-loss 0.001" in row["subject"]["arguments"]
    assert "temporal-loss" not in row["baseline"]["arguments"]
    for what, unit, units in (("step", "rays", 1024), ("picture", "pixels", CAMERA.width * CAMERA.height)):
        for clock in ("wall", "cpu"):
            figures = row[what][clock]
            assert sorted(figures["quartiles_of_ratio"]) == figures["quartiles_of_ratio"]
            for milliseconds, rate in zip(figures["milliseconds"], figures[f"{unit}_per_second"], strict=True):
                assert milliseconds * rate == pytest.approx(1e3 * units)
    for parts in row["milliseconds_of_parts"]:
        assert {"batch", "poses", "proposals", "field", "rendering", "losses", "optimizers"} < parts.keys()
        assert parts["backward of field"] > parts["backward of losses"]
        assert parts["backward of rest"] < 0.1 * sum(parts.values())


@pytest.mark.slow
def test_the_command_compares_the_seconds_to_a_psnr_with_a_commit(tmp_path: Path) -> None:
    data = simulate(tmp_path / "data", "--scene", "object")
    row = measure(data, "--measure", "seconds-to-psnr", "--against", "HEAD", "--psnr", "3", "--psnr-steps", "32")
    assert (row["baseline"]["commit"], row["subject"]["commit"]) == ("HEAD", None)
    for (reached,) in row["curves"]:
        assert reached["step"] == 16
        assert reached["psnr"] > 3
    baseline, subject = (curve[0]["cpu"] for curve in row["curves"])
    assert row["ratio_of_seconds"]["cpu"] == pytest.approx(subject / baseline)
