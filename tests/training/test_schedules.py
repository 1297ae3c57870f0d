"""The learning rates' schedules."""

import math
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from helpers.small_pipelines import make_pipeline_config
from helpers.small_trainings import train_small_model
from torch.optim.lr_scheduler import LRScheduler

from aenerf_ns.training.schedules import RelativeCosineSchedulerConfig, RelativeMultiStepSchedulerConfig


def make_scheduler(
    config: RelativeCosineSchedulerConfig | RelativeMultiStepSchedulerConfig,
) -> tuple[torch.optim.Optimizer, LRScheduler]:
    optimizer = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))], lr=0.2)
    return optimizer, config.setup().get_scheduler(optimizer, 0.2)


def run(optimizer: torch.optim.Optimizer, scheduler: LRScheduler, count: int) -> list[float]:
    """The rates of ``count`` steps."""
    rates = []
    for _ in range(count):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()
    return rates


def test_the_fields_rate_rises_and_falls_at_the_milestones() -> None:
    rates = run(*make_scheduler(RelativeMultiStepSchedulerConfig(warm_up=10, max_steps=200)), 200)
    assert rates[0] == pytest.approx(0.02)
    assert rates[4] == pytest.approx(0.1)
    for first, last, drops in ((9, 100, 0), (100, 150, 1), (150, 180, 2), (180, 200, 3)):
        assert rates[first:last] == pytest.approx([0.2 * 0.33**drops] * (last - first))


def test_the_pose_corrections_rate_rises_and_falls() -> None:
    config = RelativeCosineSchedulerConfig(delay=5, warm_up=10, final_factor=0.01, max_steps=250)
    rates = run(*make_scheduler(config), 251)
    assert rates[:5] == [0.0] * 5
    assert rates[5] == pytest.approx(0.02, rel=0.01)
    assert rates[9] == pytest.approx(0.1, rel=0.01)
    # Half way to the end.
    assert rates[125] == pytest.approx(0.2 * 0.505)
    assert rates[250] == pytest.approx(0.002)
    assert all(later <= earlier for earlier, later in pairwise(rates[15:]))


def test_a_delay_follows_the_length_of_the_run() -> None:
    config = RelativeCosineSchedulerConfig(delay=5, relative_delay=0.4, warm_up=10, max_steps=250)
    rates = run(*make_scheduler(config), 251)
    assert rates[:100] == [0.0] * 100
    # It rises in ten steps, while the cosine falls.
    assert rates[100] == pytest.approx(0.2 * 0.1 * (0.01 + 0.99 * (1 + math.cos(0.4 * math.pi)) / 2))
    assert rates[250] == pytest.approx(0.002)


@pytest.mark.parametrize(("mode", "focal", "factor"), [("spline", 5, 1), ("spline", 500, 0.5), ("network", 500, 1)])
def test_a_spline_of_poses_learns_more_slowly_through_a_long_lens(
    tmp_path: Path, mode: str, focal: float, factor: float
) -> None:
    pipeline = make_pipeline_config(tmp_path / "data", pose_correction=mode)
    description = tmp_path / "data" / "transforms.json"
    description.write_text(description.read_text().replace('"fl_x": 5.0', f'"fl_x": {focal}.0'))
    # Every second pose is off by a quarter of the path, so the spline has a finer one.
    lines = [f"{i / 20} {i / 100} {i % 2 / 20} 0 0 0 0 1" for i in range(21)]
    (tmp_path / "data" / "trajectory_estimated.txt").write_text("\n".join(lines))
    trainer = train_small_model(tmp_path, "run", 3, pipeline=pipeline)
    assert trainer.pipeline.datamanager.train_dataset.scene.event_camera.fx == focal
    rates = {name: schedule.base_lrs for name, schedule in trainer.optimizers.schedulers.items()}
    groups = {"camera_opt": 8e-3, "camera_opt_finer": 2e-3} if mode == "spline" else {"camera_opt": 8e-3}
    assert {name: rates.pop(name) for name in groups} == {name: [factor * rate] for name, rate in groups.items()}
    assert rates == {name: [trainer.config.optimizers[name]["optimizer"].lr] for name in rates}
