"""Nerfstudio's trainer, with schedules of the run's length and runs that are made in pieces."""

from __future__ import annotations

from dataclasses import dataclass, field

from nerfstudio.engine.trainer import Trainer, TrainerConfig

from aenerf_ns.training.schedules import RelativeCosineSchedulerConfig, RelativeMultiStepSchedulerConfig


@dataclass
class AENeRFTrainerConfig(TrainerConfig):
    """Nerfstudio's trainer, which tells the schedules how long the run is."""

    _target: type = field(default_factory=lambda: AENeRFTrainer)
    schedule_length: int | None = None
    """Steps that the schedules are made for, if the run is made in pieces: the steps of all pieces. The first piece
    takes the option. The others take the length from the checkpoint. None: max-num-iterations."""

    def __post_init__(self) -> None:
        for group in self.optimizers.values():
            if isinstance(group["scheduler"], (RelativeMultiStepSchedulerConfig, RelativeCosineSchedulerConfig)):
                group["scheduler"].max_steps = self.schedule_length or self.max_num_iterations


class AENeRFTrainer(Trainer):
    """Trainer whose configuration holds the length of the schedules."""

    config: AENeRFTrainerConfig

    def __init__(self, config: AENeRFTrainerConfig, local_rank: int = 0, world_size: int = 1) -> None:
        config.schedule_length = config.schedule_length or config.max_num_iterations
        super().__init__(config, local_rank, world_size)
