"""The learning rates' schedules."""

from __future__ import annotations

import io
from itertools import pairwise

import pytest
import torch

from aenerf_ns.training import RelativeCosineSchedulerConfig


def test_the_pose_correction_s_rate_rises_and_falls() -> None:
    optimizer = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))], lr=0.2)
    config = RelativeCosineSchedulerConfig(warm_up=10, final_factor=0.01, max_steps=250)
    scheduler = config.setup().get_scheduler(optimizer, 0.2)
    rates = []
    for _ in range(251):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()
    assert rates[0] == 0
    assert rates[5] == pytest.approx(0.1, rel=0.01)
    # Half way to the end.
    assert rates[125] == pytest.approx(0.2 * 0.505)
    assert rates[250] == pytest.approx(0.002)
    assert all(later <= earlier for earlier, later in pairwise(rates[10:]))
    # Current torch loads nothing but plain numbers and tensors.
    file = io.BytesIO()
    torch.save(scheduler.state_dict(), file)
    file.seek(0)
    assert torch.load(file, weights_only=True)["last_epoch"] == 251
