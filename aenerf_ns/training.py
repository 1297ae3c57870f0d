"""The training schedule of the paper, for runs of any length."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import tyro
from nerfstudio.engine.schedulers import MultiStepScheduler, Scheduler, SchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR, LRScheduler


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
class RelativeCosineSchedulerConfig(SchedulerConfig):
    """Learning rate that rises linearly, and falls as half a cosine until the end of the run.

    For pose correction: a single batch tells little of a pose, so the noise of the gradients is averaged out by a rate
    that ends low.
    """

    _target: type = field(default_factory=lambda: RelativeCosineScheduler)
    warm_up: int = 50
    """Steps in which the rate rises."""
    final_factor: float = 0.01
    """Factor at the end of the run."""
    max_steps: tyro.conf.Suppress[int] = 0
    """Length of the run, which the trainer's configuration fills in."""


class RelativeCosineScheduler(Scheduler):
    """Not the framework's cosine decay, whose NumPy numbers current torch refuses to load from checkpoints."""

    config: RelativeCosineSchedulerConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LRScheduler:
        """The schedule of an optimizer whose learning rate is ``lr_init``."""
        config = self.config

        def factor(step: int) -> float:
            progress = min(step / max(config.max_steps, 1), 1.0)
            falling = config.final_factor + (1 - config.final_factor) * (1 + math.cos(math.pi * progress)) / 2
            return min(step / max(config.warm_up, 1), 1.0) * falling

        return LambdaLR(optimizer, factor)


@dataclass
class AENeRFTrainerConfig(TrainerConfig):
    """A trainer that tells the schedules how long the run is."""

    def __post_init__(self) -> None:
        for group in self.optimizers.values():
            if isinstance(group["scheduler"], (RelativeMultiStepSchedulerConfig, RelativeCosineSchedulerConfig)):
                group["scheduler"].max_steps = self.max_num_iterations
