"""The seam: a supervision that this package does not know is trained by the same model, datamanager and pipeline."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.small_models import make_rays
from helpers.small_pipelines import make_pipeline_config
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor, nn

from aenerf_ns.supervision.base import Batch, LossCoefficients, Sampler, SamplerConfig, Supervision, SupervisionConfig


@dataclass
class Moments(Batch):
    """Rays at random moments."""

    offset: Tensor


@dataclass
class GrayCoefficients(LossCoefficients):
    gray_loss: float = 2.0


@dataclass
class GrayConfig(SupervisionConfig):
    """Says that everything looks the same."""

    _target: type = field(default_factory=lambda: Gray)


class Gray(Supervision):
    batch_type = Moments

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.level = nn.Parameter(torch.tensor(-1.0))

    def shift_ray_times(self, rays: RayBundle) -> dict[str, Tensor]:
        return {"level": self.level * 1.0}

    def loss_unit(self, outputs: Mapping[str, Any]) -> float:
        return self.sensor.negative_contrast_threshold

    def losses(self, outputs: Mapping[str, Any], batch: Moments) -> dict[str, Tensor]:
        return {"gray_loss": (outputs["log_radiance"] - outputs["level"] - batch.offset).square().mean()}

    def learned_values(self) -> dict[str, float]:
        return {"level": self.level.item()}


@dataclass
class MomentSamplerConfig(SamplerConfig):
    """Draws the same rays each time."""

    _target: type = field(default_factory=lambda: MomentSampler)


class MomentSampler(Sampler):
    batch_type = Moments

    def prepare(self) -> None:
        pass

    def sample(self, num_rays: int, training: bool = True) -> tuple[RayBundle, Moments]:
        return make_rays(num_rays, with_times=True), Moments(torch.full((num_rays, 1), 0.5))


def test_another_supervision_is_trained_and_what_it_learns_is_logged(tmp_path: Path) -> None:
    config = make_pipeline_config(tmp_path / "data", pose_correction="spline")
    config.model = replace(config.model, supervision=GrayConfig(), loss_coefficients=GrayCoefficients())
    config.datamanager = replace(config.datamanager, sampler=MomentSamplerConfig(), train_num_rays_per_batch=30)
    pipeline = config.setup(device="cpu", test_mode="val")
    groups = pipeline.get_param_groups()
    assert [parameter.shape for parameter in groups["sensor"]] == [()]
    optimizer = torch.optim.Adam([p for group in groups.values() for p in group], lr=0.02)
    history = []
    for step in range(40):
        optimizer.zero_grad()
        outputs, losses, metrics = pipeline.get_train_loss_dict(step)
        sum(losses.values()).backward()
        optimizer.step()
        history.append(losses["gray_loss"].item())
    assert len(outputs["log_radiance"]) == 30
    assert history[-1] < 0.05 * history[0]
    assert metrics["level"] != -1.0
    assert pipeline.model.camera_optimizer.twists.control_twists.abs().max() > 0


def test_a_sampler_for_another_supervision_is_refused(tmp_path: Path) -> None:
    config = make_pipeline_config(tmp_path / "data")
    config.datamanager = replace(config.datamanager, sampler=MomentSamplerConfig())
    with pytest.raises(
        SystemExit, match="its sampler draws a Moments, and its supervision compares a PairBatch; give it"
    ):
        config.setup(device="cpu", test_mode="val")
