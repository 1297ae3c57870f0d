"""Trainings that go on from a checkpoint."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from helpers.small_trainings import train_small_model

from aenerf_ns.training.trainer import AENeRFTrainer

NUM_STEPS = 60
# Not a multiple of the 8 steps over which gradients of the poses are accumulated. Odd, because the proposal networks
# are trained at every other step. And in the part of the run in which the field's space counts rays.
NUM_FIRST = 13


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
    whole = checkpoint(train_small_model(tmp_path, "whole", NUM_STEPS))
    first = train_small_model(tmp_path, "first", NUM_FIRST, schedule_length=NUM_STEPS)
    # The second piece is another process, whose generators are elsewhere.
    second = train_small_model(tmp_path, "second", NUM_STEPS - NUM_FIRST, seed=7, load_dir=first.checkpoint_dir)
    assert second.config.schedule_length == NUM_STEPS
    resumed = checkpoint(second)
    # The diagnosis compares with poses at nine tenths of each run.
    del whole["pipeline"]["_extra_state"], resumed["pipeline"]["_extra_state"]
    assert_equal(whole, resumed)
    moved = whole["pipeline"]["_model.camera_optimizer.twists.control_twists"]
    assert moved.any()
    assert checkpoint(first)["pipeline"]["training_state._extra_state"]["gradients"]["camera_opt"][0].any()
