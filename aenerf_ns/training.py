"""The training schedule of the paper, for runs of any length."""

from __future__ import annotations

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
class RelativeExponentialSchedulerConfig(SchedulerConfig):
    """Learning rate that waits, rises linearly, and falls exponentially, at times given as parts of the run.

    For pose correction. While the field is still taking shape its gradients would move good poses away, so it waits;
    and a single batch tells little of a pose, so the noise of the gradients is averaged out by a rate that ends low.
    """

    _target: type = field(default_factory=lambda: RelativeExponentialScheduler)
    delay: float = 0.05
    """Part of the run in which nothing is learned."""
    warm_up: float = 0.05
    """Part of the run in which the rate then rises."""
    final_factor: float = 0.01
    """Factor at the end of the run. The rate falls towards it from the start on."""
    max_steps: tyro.conf.Suppress[int] = 0
    """Length of the run, which the trainer's configuration fills in."""


class RelativeExponentialScheduler(Scheduler):
    """Not the framework's exponential decay, whose checkpoints current torch refuses to load."""

    config: RelativeExponentialSchedulerConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LRScheduler:
        """The schedule of an optimizer whose learning rate is ``lr_init``."""
        config = self.config

        def factor(step: int) -> float:
            progress = min(step / max(config.max_steps, 1), 1.0)
            risen = (progress - config.delay) / config.warm_up if config.warm_up else float(progress >= config.delay)
            return min(max(risen, 0.0), 1.0) * config.final_factor**progress

        return LambdaLR(optimizer, factor)


@dataclass
class AENeRFTrainerConfig(TrainerConfig):
    """A trainer that tells the schedules how long the run is."""

    def __post_init__(self) -> None:
        for group in self.optimizers.values():
            if isinstance(group["scheduler"], (RelativeMultiStepSchedulerConfig, RelativeExponentialSchedulerConfig)):
                group["scheduler"].max_steps = self.max_num_iterations
