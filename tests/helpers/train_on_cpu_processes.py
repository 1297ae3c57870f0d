"""``ns-train`` with ``--machine.num-devices``, each process on a CPU where the framework wants a GPU for it.

What each process sees and learns is left in ``process_0.pt``, ``process_1.pt``, ...

With ``SHARED_BATCHES`` in the environment, any number of processes sees the same rays: each process sees its part of
one batch, and samples are at the same places along the rays.
"""

import os
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


def share_batches(trainer: Trainer) -> None:
    """Give every process its part of a batch that is drawn for all of them."""
    datamanager, model = trainer.pipeline.datamanager, trainer.pipeline.model
    # Otherwise each process would move the samples along its rays at random.
    model.proposal_sampler.initial_sampler.train_stratified = False
    model.proposal_sampler.pdf_sampler.train_stratified = False

    def next_train(step: int) -> Any:
        torch.manual_seed(step)
        num_rays = trainer.world_size * datamanager.config.train_num_rays_per_batch
        rays, batch = datamanager.train_pixel_sampler.sample(num_rays)
        num_pairs = len(batch)
        part = torch.arange(num_pairs).chunk(trainer.world_size)[trainer.local_rank]
        of_part = torch.arange(len(rays)).unflatten(0, (-1, num_pairs))[:, part].flatten()
        return rays[of_part], batch[part]

    datamanager.next_train = next_train


def train_and_keep(trainer: Trainer) -> None:
    """Trains, and keeps the times of the first batch, what was learned, and how often colors were fitted."""
    if "SHARED_BATCHES" in os.environ:
        share_batches(trainer)
    datamanager, pipeline = trainer.pipeline.datamanager, trainer.pipeline
    next_train, times = datamanager.next_train, []
    fit, fits = pipeline.color_fit.fit, []

    def watched(step: int) -> Any:
        rays, batch = next_train(step)
        times.append(rays.times.clone())
        return rays, batch

    def fitted(*share: float) -> None:
        fits.append(share)
        fit(*share)

    datamanager.next_train, pipeline.color_fit.fit = watched, fitted
    before = {name: value.clone() for name, value in pipeline.model.state_dict().items()}
    train_alone(trainer)
    kept = {"times": times[0], "before": before, "weights": pipeline.model.state_dict(), "num_fits": len(fits)}
    torch.save(kept, f"process_{trainer.local_rank}.pt")


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
    # Of a single process, which is no worker.
    Trainer.train = train_and_keep
    train.entrypoint()
