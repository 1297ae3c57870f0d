"""The training schedule of the paper, for runs of any length."""

from __future__ import annotations

from dataclasses import dataclass

from nerfstudio.engine.schedulers import MultiStepSchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig

# The paper's milestones, 20,000, 30,000 and 36,000, "at 50 %, 75 % and 90 % of the training process".
_MILESTONES = (0.5, 0.75, 0.9)


@dataclass
class AENeRFTrainerConfig(TrainerConfig):
    """A trainer whose learning rates fall by a factor of 0.33 at 50, 75 and 90 % of the run, however long it is.

    The schedule has steps, not the framework's exponential decay, whose checkpoints current torch refuses to load.
    """

    def __post_init__(self) -> None:
        for group in self.optimizers.values():
            scheduler = group["scheduler"]
            if isinstance(scheduler, MultiStepSchedulerConfig):
                scheduler.max_steps = self.max_num_iterations
                scheduler.milestones = tuple(int(part * self.max_num_iterations) for part in _MILESTONES)
