"""The registered methods: how they differ from each other, and that each of them trains."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch
import tyro
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import TrainerConfig
from small_datasets import write_native
from small_models import SMALL_FIELD, SMALL_PROPOSAL

from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.method.networks import FieldConfig, ProposalConfig
from aenerf_ns.method_configs.aenerf import aenerf
from aenerf_ns.method_configs.aenerf_small import aenerf_small
from aenerf_ns.method_configs.robust_enerf import robust_enerf
from aenerf_ns.method_configs.robust_enerf_small import robust_enerf_small

SMALL = [robust_enerf_small]


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return write_native(tmp_path / "made")


def with_options(config: TrainerConfig, *options: str) -> TrainerConfig:
    """The configuration that ns-train makes of options on the command line."""
    return tyro.cli(type(config), args=list(options), default=deepcopy(config))


def train(config: TrainerConfig, data: Path, num_steps: int) -> tuple[list[dict[str, float]], dict[str, torch.Tensor]]:
    """Trains tiny networks with a method's own losses, batches and optimizers; returns losses and final weights."""
    config = deepcopy(config)
    config.pipeline.datamanager.dataparser = NativeDataParserConfig(data=data)
    config.pipeline.datamanager.train_num_rays_per_batch = 60
    config.pipeline.model.field = FieldConfig(**SMALL_FIELD)
    config.pipeline.model.proposal = ProposalConfig(**SMALL_PROPOSAL)
    for group in config.optimizers.values():
        # So that few steps show something.
        group["scheduler"].warm_up = 0
        if hasattr(group["scheduler"], "delay"):
            group["scheduler"].delay = 0
    torch.manual_seed(0)
    pipeline = config.pipeline.setup(device="cpu", test_mode="val")
    pipeline.train()
    groups = pipeline.get_param_groups()
    optimizers = Optimizers({name: config.optimizers[name] for name in groups}, groups)
    history = []
    for step in range(num_steps):
        optimizers.zero_grad_all()
        _, losses, _ = pipeline.get_train_loss_dict(step)
        sum(losses.values()).backward()
        optimizers.optimizer_step_all()
        optimizers.scheduler_step_all(step)
        history.append({name: loss.item() for name, loss in losses.items()})
    return history, {name: value.clone() for name, value in pipeline.model.state_dict().items()}


def same(first: Any, second: Any) -> bool:
    """Whether two trainings gave the same losses and weights, to the bit."""
    return first[0] == second[0] and all(torch.equal(value, second[1][name]) for name, value in first[1].items())


AS_ROBUST = (
    "--pipeline.datamanager.sampler.max-events-per-pair", "1",
    "--pipeline.datamanager.sampler.share-to-moments", "0",
    "--pipeline.model.camera-optimizer.mode", "off",
)  # fmt: skip


@pytest.mark.parametrize(("robust", "ours"), [(robust_enerf, aenerf), (robust_enerf_small, aenerf_small)])
def test_robust_enerf_is_a_configuration_of_aenerf(robust: Any, ours: Any) -> None:
    as_robust = with_options(ours.config, *AS_ROBUST)
    as_robust.method_name = robust.config.method_name
    assert asdict(as_robust) == asdict(robust.config)


def test_robust_enerf_trains_as_aenerf_does_with_its_options_to_the_bit(data: Path) -> None:
    robust = train(robust_enerf_small.config, data, 5)
    assert same(robust, train(with_options(aenerf_small.config, *AS_ROBUST), data, 5))
    assert not same(robust, train(with_options(aenerf_small.config, *AS_ROBUST[2:]), data, 5))


@pytest.mark.parametrize("mode", ["off", "spline"])
@pytest.mark.parametrize("method", SMALL, ids=lambda method: method.config.method_name)
def test_every_peer_trains_with_and_without_pose_correction(method: Any, mode: str, data: Path) -> None:
    config = with_options(method.config, "--pipeline.model.camera-optimizer.mode", mode)
    history, weights = train(config, data, 3)
    assert len({losses["reconstruction_loss"] for losses in history}) == 3
    assert ("camera_optimizer.twists.control_twists" in weights) == (mode == "spline")
    if mode == "spline":
        assert weights["camera_optimizer.twists.control_twists"].abs().max() > 0
