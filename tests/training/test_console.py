"""What training prints."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from small_trainings import train_small_model


def without_formatting(output: str) -> str:
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", output)


def test_the_console_shows_the_losses_beside_the_times(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trainer = train_small_model(tmp_path, "run", 21)
    printed = without_formatting(capsys.readouterr().out)
    headings = [line for line in printed.splitlines() if line.startswith("Step (% Done)")]
    rows = {line.split()[0]: line for line in printed.splitlines() if re.match(r"\d+ \(", line)}
    assert rows.keys() >= {"0", "10", "20"}
    assert headings[-1].split("  ")[0] == "Step (% Done)"
    columns = re.split(r" {2,}", headings[-1].strip())
    assert columns[1:5] == ["Train Loss", "Reconstruction", "Polarity agreement", "Poses turned (deg)"]
    assert "Train Iter (time)" in columns
    values = dict(zip(columns, re.split(r" {2,}", rows["20"].strip()), strict=True))
    assert float(values["Train Loss"]) >= float(values["Reconstruction"]) > 0
    assert 0 <= float(values["Polarity agreement"]) <= 1
    # At step 20 the poses have moved twice: after steps 7 and 15.
    metrics: dict[str, torch.Tensor] = {}
    trainer.pipeline.model.camera_optimizer.get_metrics_dict(metrics)
    assert float(values["Poses turned (deg)"]) == pytest.approx(float(metrics["pose_correction_degrees"]), abs=1e-4)


def test_a_run_that_goes_on_ends_at_a_hundred_percent(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = train_small_model(tmp_path, "first", 10)
    capsys.readouterr()
    train_small_model(tmp_path, "second", 15, load_dir=first.checkpoint_dir)
    shown = re.findall(r"^(\d+) \((\d+)\.00%\)", without_formatting(capsys.readouterr().out), re.MULTILINE)
    assert set(shown) == {("10", "40"), ("20", "80")}
