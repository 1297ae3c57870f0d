"""``ns-train`` with ``--machine.num-devices``, each process on a CPU where the framework wants a GPU for it.

What each process sees and learns is left in ``process_0.pt``, ``process_1.pt``, ...
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import timedelta
from typing import Any

import torch
import torch.distributed
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.pipelines import base_pipeline
from nerfstudio.scripts import train
from nerfstudio.utils import comms

train_alone = Trainer.train


class DistributedDataParallelOnCPU(torch.nn.parallel.DistributedDataParallel):
    """Of a module that is on no GPU."""

    def __init__(self, module: torch.nn.Module, device_ids: list[int], **options: Any) -> None:
        super().__init__(module, **options)


def train_and_keep(trainer: Trainer) -> None:
    """Trains, and keeps the times of the first batch and what was learned."""
    datamanager = trainer.pipeline.datamanager
    next_train, times = datamanager.next_train, []

    def watched(step: int) -> Any:
        rays, batch = next_train(step)
        times.append(rays.times.clone())
        return rays, batch

    datamanager.next_train = watched
    train_alone(trainer)
    torch.save({"times": times[0], "weights": trainer.pipeline.state_dict()}, f"process_{trainer.local_rank}.pt")


def worker(
    local_rank: int,
    main_func: Callable[..., None],
    world_size: int,
    num_devices_per_machine: int,
    machine_rank: int,
    dist_url: str,
    config: TrainerConfig,
    timeout: timedelta,
    device_type: str,
) -> None:
    """The framework's worker, which asserts that there is a GPU for each."""
    torch.distributed.init_process_group(
        "gloo", init_method=dist_url, world_size=world_size, rank=local_rank, timeout=timeout
    )
    comms.LOCAL_PROCESS_GROUP = torch.distributed.group.WORLD
    base_pipeline.DDP = DistributedDataParallelOnCPU
    barrier = torch.distributed.barrier
    torch.distributed.barrier = lambda device_ids=None: barrier()
    Trainer.train = train_and_keep
    main_func(local_rank, world_size, config, local_rank)
    torch.distributed.destroy_process_group()


if __name__ == "__main__":
    train._distributed_worker = worker
    train.entrypoint()
