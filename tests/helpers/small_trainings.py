"""Small trainings in the tests' own process."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.trainer import writer

from aenerf_ns.method_configs.aenerf import aenerf
from aenerf_ns.training.trainer import AENeRFTrainer, AENeRFTrainerConfig
from helpers.small_pipelines import make_pipeline_config


@contextmanager
def own_log() -> Iterator[None]:
    """Forget afterwards who writes the log of a training in this process. The framework keeps them for good."""
    try:
        yield
    finally:
        writer.EVENT_WRITERS.clear()
        writer.EVENT_STORAGE.clear()


def train_small_model(
    folder: Path,
    name: str,
    num_steps: int,
    seed: int = 42,
    prepare: Callable[[AENeRFTrainer], object] = lambda trainer: None,
    **options: Any,
) -> AENeRFTrainer:
    """Train a small model as ns-train does, on the dataset ``data`` of a folder; ``prepare`` may change the trainer."""
    options.setdefault("pipeline", make_pipeline_config(folder / "data", pose_correction="spline"))
    config = AENeRFTrainerConfig(
        method_name="aenerf",
        experiment_name=name,
        timestamp="now",
        output_dir=folder,
        vis="tensorboard",
        max_num_iterations=num_steps,
        optimizers=deepcopy(aenerf.config.optimizers),
        gradient_accumulation_steps=aenerf.config.gradient_accumulation_steps,
        logging=aenerf.config.logging,
        **options,
    )
    config.pipeline.datamanager.train_num_rays_per_batch = 64
    config.machine.device_type = "cpu"
    for group in config.optimizers.values():
        group["scheduler"].warm_up = 4
    config.optimizers["camera_opt"]["scheduler"].delay = 2
    torch.manual_seed(seed)
    with own_log():
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        prepare(trainer)
        trainer.train()
    return trainer
