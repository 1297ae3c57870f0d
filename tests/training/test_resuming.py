"""Trainings that go on from a checkpoint."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.engine.trainer import writer
from small_pipelines import make_pipeline_config

from aenerf_ns.method_configs.aenerf import aenerf
from aenerf_ns.training.trainer import AENeRFTrainer, AENeRFTrainerConfig

NUM_STEPS = 60
# Not a multiple of the 8 steps over which gradients of the poses are accumulated. Odd, because the proposal networks
# are trained at every other step. And in the part of the run in which the field's space counts rays.
NUM_FIRST = 13


@pytest.fixture(autouse=True)
def _no_writers_are_left() -> Any:
    yield
    writer.EVENT_WRITERS.clear()
    writer.EVENT_STORAGE.clear()


def train(folder: Path, name: str, num_steps: int, seed: int = 42, **options: Any) -> AENeRFTrainer:
    """Train a small model as ns-train does."""
    config = AENeRFTrainerConfig(
        method_name="aenerf",
        experiment_name=name,
        timestamp="now",
        output_dir=folder,
        vis="tensorboard",
        max_num_iterations=num_steps,
        pipeline=make_pipeline_config(folder / "data", pose_correction="spline"),
        optimizers=deepcopy(aenerf.config.optimizers),
        gradient_accumulation_steps=aenerf.config.gradient_accumulation_steps,
        **options,
    )
    config.pipeline.datamanager.train_num_rays_per_batch = 64
    config.machine.device_type = "cpu"
    for group in config.optimizers.values():
        group["scheduler"].warm_up = 4
    config.optimizers["camera_opt"]["scheduler"].delay = 2
    torch.manual_seed(seed)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.train()
    return trainer


def checkpoint(trainer: AENeRFTrainer) -> dict[str, Any]:
    (path,) = trainer.checkpoint_dir.glob("*.ckpt")
    return torch.load(path, weights_only=True)


def assert_equal(first: Any, second: Any, name: str = "checkpoint") -> None:
    """Assert that two checkpoints, or parts of them, hold the same values to the bit."""
    assert type(first) is type(second), name
    if isinstance(first, dict):
        assert first.keys() == second.keys(), name
        for key in first:
            assert_equal(first[key], second[key], f"{name}.{key}")
    elif isinstance(first, (list, tuple)):
        assert len(first) == len(second), name
        for index, (one, other) in enumerate(zip(first, second, strict=True)):
            assert_equal(one, other, f"{name}.{index}")
    elif isinstance(first, torch.Tensor):
        assert torch.equal(first, second), name
    else:
        assert first == second, name


def test_a_run_in_two_pieces_is_the_run_in_one(tmp_path: Path) -> None:
    whole = checkpoint(train(tmp_path, "whole", NUM_STEPS))
    first = train(tmp_path, "first", NUM_FIRST, schedule_length=NUM_STEPS)
    # The second piece is another process, whose generators are elsewhere.
    second = train(tmp_path, "second", NUM_STEPS - NUM_FIRST, seed=7, load_dir=first.checkpoint_dir)
    assert second.config.schedule_length == NUM_STEPS
    resumed = checkpoint(second)
    # The diagnosis compares with poses at nine tenths of each run.
    del whole["pipeline"]["_extra_state"], resumed["pipeline"]["_extra_state"]
    assert_equal(whole, resumed)
    moved = whole["pipeline"]["_model.camera_optimizer.twists.control_twists"]
    assert moved.any()
    assert checkpoint(first)["pipeline"]["training_state._extra_state"]["gradients"]["camera_opt"][0].any()
