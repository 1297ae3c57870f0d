"""The training schedule of the paper, for runs of any length."""

from __future__ import annotations

from dataclasses import dataclass, field

import tyro
from nerfstudio.engine.schedulers import MultiStepScheduler, SchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig


@dataclass
class RelativeMultiStepSchedulerConfig(SchedulerConfig):
    """Learning rate that falls by a factor at milestones given as parts of the run.

    Steps, not the framework's exponential decay, whose checkpoints current torch refuses to load.
    """

    _target: type = field(default_factory=lambda: MultiStepScheduler)
    gamma: float = 0.33
    """Factor at each milestone."""
    relative_milestones: tuple[float, ...] = (0.5, 0.75, 0.9)
    """Milestones as parts of the run. The paper's 20,000, 30,000 and 36,000 steps are "50 %, 75 % and 90 %"."""
    max_steps: tyro.conf.Suppress[int] = 0
    """Length of the run, which the trainer's configuration fills in."""

    @property
    def milestones(self) -> tuple[int, ...]:
        """Milestones in steps."""
        return tuple(round(part * self.max_steps) for part in self.relative_milestones)


@dataclass
class AENeRFTrainerConfig(TrainerConfig):
    """A trainer that tells the schedules how long the run is."""

    def __post_init__(self) -> None:
        for group in self.optimizers.values():
            if isinstance(group["scheduler"], RelativeMultiStepSchedulerConfig):
                group["scheduler"].max_steps = self.max_num_iterations
