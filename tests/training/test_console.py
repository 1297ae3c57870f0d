"""What training prints."""

from __future__ import annotations

import itertools
import re
from copy import deepcopy
from pathlib import Path

import pytest
import torch
from helpers.small_pipelines import make_pipeline_config
from helpers.small_trainings import train_small_model

from aenerf_ns.camera.rotation import rotation_from_vector
from aenerf_ns.evaluation.poses import compare_with_ground_truth
from aenerf_ns.method_configs.aenerf import aenerf


def without_formatting(output: str) -> str:
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", output)


def columns_of(line: str) -> list[str]:
    return re.split(r" {2,}", line.strip())


def test_the_console_shows_losses_and_pose_errors_beside_the_times(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # A clock by which each step takes 0.25 s: it is read at the begin and at the end of a step.
    monkeypatch.setattr("nerfstudio.utils.writer.time", itertools.count(step=0.25).__next__)
    make_pipeline_config(tmp_path / "data", true_world=lambda poses: (poses @ turned_by(0.1))[:, :3])
    trainer = train_small_model(tmp_path, "run", 121)
    printed = without_formatting(capsys.readouterr().out)
    headings = [columns_of(line) for line in printed.splitlines() if line.startswith("Step (% Done)")][-1]
    rows = {line.split()[0]: columns_of(line) for line in printed.splitlines() if re.match(r"\d+ \(", line)}
    assert rows.keys() >= {"0", "10", "100", "110", "120"}
    assert headings == [
        "Step (% Done)", "Loss", "Reconstruction", "Interlevel", "Distortion", "Penalty", "Polarity", "Turned (°)",
        "Error (°)", "Error (length)", "Step time", "ETA", "Pairs/s",
    ]  # fmt: skip
    values = dict(zip(headings, rows["120"], strict=True))
    terms = [float(values[name]) for name in ("Reconstruction", "Interlevel", "Distortion", "Penalty")]
    assert float(values["Loss"]) == pytest.approx(sum(terms), rel=1e-3)
    assert terms[0] > 0
    assert 0 <= float(values["Polarity"]) <= 1
    # At step 120 the poses have moved last after step 119.
    metrics: dict[str, torch.Tensor] = {}
    trainer.pipeline.model.camera_optimizer.get_metrics_dict(metrics)
    assert float(values["Turned (°)"]) == pytest.approx(float(metrics["pose_correction_degrees"]), rel=1e-3)
    # The errors are measured every 100 steps and shown in between.
    index = headings.index("Error (°)")
    assert rows["100"][index] == rows["120"][index]
    run = trainer.pipeline.trained_run()
    errors = compare_with_ground_truth(run.model.camera_optimizer, run.scene)
    assert errors is not None
    assert float(rows["120"][index]) == pytest.approx(errors["corrected"]["rotation_error_degrees"], rel=0.3)
    # 32 pairs in a batch of 64 rays.
    assert values["Step time"] == "250.000 ms"
    assert values["Pairs/s"] == "128.00"


def turned_by(angle: float) -> torch.Tensor:
    """A turn of cameras about their own axes (4, 4): no motion of the world makes up for it in all of their poses."""
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = rotation_from_vector(torch.tensor([0.0, 0.0, angle], dtype=torch.float64))
    return turn


def test_a_run_that_goes_on_ends_at_a_hundred_percent(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = train_small_model(tmp_path, "first", 10)
    capsys.readouterr()
    train_small_model(tmp_path, "second", 15, load_dir=first.checkpoint_dir)
    shown = re.findall(r"^(\d+) \((\d+)\.00%\)", without_formatting(capsys.readouterr().out), re.MULTILINE)
    assert set(shown) == {("10", "40"), ("20", "80")}


def test_a_training_without_steps_or_rays_is_one_line() -> None:
    config = deepcopy(aenerf.config)
    config.max_num_iterations = 0
    with pytest.raises(SystemExit, match=r"^Error: ns-train: --max-num-iterations 0; give one or more$"):
        config.setup(local_rank=0, world_size=1)
    config.max_num_iterations = 1
    config.pipeline.datamanager.train_num_rays_per_batch = 0
    with pytest.raises(SystemExit, match=r"^Error: ns-train: --pipeline.datamanager.train-num-rays-per-batch 0; give"):
        config.setup(local_rank=0, world_size=1)
