"""What training prints."""

import itertools
import re
from copy import deepcopy
from pathlib import Path

import pytest
import torch
import tyro
from helpers.commands import CPU
from helpers.small_pipelines import make_pipeline_config
from helpers.small_trainings import train_small_model

from aenerf_ns.camera.rotation import rotation_from_vector
from aenerf_ns.evaluation.poses import compare_with_ground_truth
from aenerf_ns.method_configs.aenerf import aenerf


def columns_of(line: str) -> list[str]:
    return re.split(r" {2,}", line.strip())


def test_console_shows_losses_and_pose_errors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # A clock by which each step takes 0.25 s: it is read at the begin and at the end of a step.
    monkeypatch.setattr("nerfstudio.utils.writer.time", itertools.count(step=0.25).__next__)
    # Cameras turned about their own axes: no motion of the world makes up for it in all of their poses.
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = rotation_from_vector(torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64))
    make_pipeline_config(tmp_path / "data", true_world=lambda poses: (poses @ turn)[:, :3])
    trainer = train_small_model(tmp_path, "run", 121)
    lines = capsys.readouterr().out.splitlines()
    headings = [columns_of(line) for line in lines if line.startswith("Step (% Done)")][-1]
    printed = [columns_of(line) for line in lines if re.match(r"\d+ \(", line)]
    # Each logged step once.
    assert [row[0].split()[0] for row in printed] == [str(step) for step in range(0, 121, 10)]
    rows = {row[0].split()[0]: row for row in printed}
    assert headings == [
        "Step (% Done)", "Loss", "Reconstruction", "Interlevel", "Distortion", "Penalty", "Polarity", "Turned (°)",
        "Error (°)", "Error (length)", "Step time", "ETA", "Pairs/s",
    ]  # fmt: skip
    values = dict(zip(headings, rows["120"], strict=True))
    assert values["Step (% Done)"] == "120 (99.17%)"
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
    assert float(rows["120"][index]) == pytest.approx(errors["corrected"]["rotation_error_degrees"], rel=0.3)
    # 32 pairs in a batch of 64 rays.
    assert (values["Step time"], values["ETA"], values["Pairs/s"]) == ("0.25 s", "0:00:00", "128.00")


@pytest.mark.parametrize(
    "option",
    [
        "--max-num-iterations",
        "--pipeline.datamanager.train-num-rays-per-batch",
        "--gradient-accumulation-steps.camera-opt",
    ],
)
def test_no_steps_or_rays_is_one_line(option: str) -> None:
    config = tyro.cli(type(aenerf.config), args=[*CPU, option, "0"], default=deepcopy(aenerf.config))
    # What ns-train calls first.
    with pytest.raises(SystemExit, match=rf"^Error: ns-train: {option} 0; give one or more$"):
        config.save_config()


def test_missing_gpu_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    config = deepcopy(aenerf.config)
    config.machine.device_type = "cuda"
    message = r"^Error: --machine.device-type cuda: no GPU can be used; .*aenerf-small --machine.device-type cpu"
    with pytest.raises(SystemExit, match=message):
        config.save_config()
