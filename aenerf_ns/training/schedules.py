"""The optimizer, and the training schedules for runs of any length."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import tyro
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR, LRScheduler


@dataclass
class FusedAdamOptimizerConfig(AdamOptimizerConfig):
    """Adam that updates all parameters in one operation, on CPU and GPU faster than one by one."""

    fused: tyro.conf.Suppress[bool] = True
    """For torch's Adam, which gets all fields."""


@dataclass
class _StepsFactor:
    """Factor on a learning rate that rises linearly and falls at milestones.

    It is an object of plain numbers, because a checkpoint stores objects but no functions, and because current torch
    refuses to load NumPy's numbers, which the framework's exponential and cosine decay leave in checkpoints.
    """

    warm_up: int
    milestones: list[int]
    gamma: float

    def __call__(self, step: int) -> float:
        return _rise(step, self.warm_up) * self.gamma ** sum(step >= milestone for milestone in self.milestones)


@dataclass
class _CosineFactor:
    """Factor on a learning rate that is zero, rises linearly and falls as half a cosine."""

    delay: int
    warm_up: int
    last_step: int
    final_factor: float

    def __call__(self, step: int) -> float:
        falling = (1 + math.cos(math.pi * min(step / max(self.last_step, 1), 1.0))) / 2
        if step < self.delay:
            return 0.0
        return _rise(step - self.delay, self.warm_up) * (self.final_factor + (1 - self.final_factor) * falling)


def _rise(step: int, warm_up: int) -> float:
    return min((step + 1) / max(warm_up, 1), 1.0)


@dataclass
class RelativeMultiStepSchedulerConfig(SchedulerConfig):
    """Learning rate that rises linearly at first, and falls by a factor at milestones given as parts of the run.

    The rate must not begin at its height. Adam's first steps are of full size however little the gradients say. They
    build a fog in front of the cameras that no camera motion changes, and a run can take long to leave it.
    """

    _target: type = field(default_factory=lambda: RelativeMultiStepScheduler)
    warm_up: int = 100
    """Steps in which the rate rises."""
    gamma: float = 0.33
    """Factor at each milestone."""
    relative_milestones: tuple[float, ...] = (0.5, 0.75, 0.9)
    """Milestones as parts of the run. The paper's 20,000, 30,000 and 36,000 steps are "50 %, 75 % and 90 %"."""
    max_steps: tyro.conf.Suppress[int] = 0
    """Length of the run, which the trainer's configuration fills in."""


class RelativeMultiStepScheduler(Scheduler):
    """The schedule of a :class:`RelativeMultiStepSchedulerConfig`. The framework's has no warm-up."""

    config: RelativeMultiStepSchedulerConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LRScheduler:
        """Return the schedule of an optimizer whose learning rate is ``lr_init``."""
        config = self.config
        milestones = [round(part * config.max_steps) for part in config.relative_milestones]
        return LambdaLR(optimizer, _StepsFactor(config.warm_up, milestones, config.gamma))


@dataclass
class RelativeCosineSchedulerConfig(SchedulerConfig):
    """Learning rate that is zero for some steps, rises linearly, and falls as half a cosine until the end of the run.

    It is meant for pose correction. Before the field has begun to take shape, its gradients lead poses astray. A field
    that has taken shape holds on to wrong poses. And a single batch tells little of a pose, so a rate that ends low
    averages the noise out.
    """

    _target: type = field(default_factory=lambda: RelativeCosineScheduler)
    delay: int = 100
    """Steps in which the rate is zero."""
    relative_delay: float = 0.0
    """Part of the run in which the rate is zero, where that is longer."""
    warm_up: int = 100
    """Steps after the delay in which the rate rises."""
    final_factor: float = 0.01
    """Factor at the end of the run."""
    max_steps: tyro.conf.Suppress[int] = 0
    """Length of the run, which the trainer's configuration fills in."""


class RelativeCosineScheduler(Scheduler):
    """The schedule of a :class:`RelativeCosineSchedulerConfig`."""

    config: RelativeCosineSchedulerConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LRScheduler:
        """Return the schedule of an optimizer whose learning rate is ``lr_init``."""
        config = self.config
        delay = max(config.delay, round(config.relative_delay * config.max_steps))
        return LambdaLR(optimizer, _CosineFactor(delay, config.warm_up, config.max_steps, config.final_factor))
