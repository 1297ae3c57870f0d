"""Profile steps of a training: their time, their kernels, how long these kept the GPU busy, and memory.

    python -m benchmarks.profile --data data/room --output benchmarks/results/profile_h100.json

The time is measured first, without the profiler, which slows the steps.
"""

from __future__ import annotations

import shlex
import time
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
import tyro
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.utils import writer
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

from aenerf_ns.training.trainer import AENeRFTrainer
from benchmarks.runs import run_benchmark, write_result
from benchmarks.step.worker import train_steps

# Steps that the schedules are made for, and steps that are taken before the measurement.
_STEPS, _STEPS_BEFORE = 30000, 20
# So many kernels are listed, those that take longest.
_KERNELS = 12


@dataclass
class Profile:
    """Profile steps of trainings."""

    data: Path
    """Folder of a dataset."""
    output: Path
    """JSON file to write after each training."""
    variants: tuple[str, ...] = (
        "aenerf",
        "aenerf --pipeline.model.loss-coefficients.temporal-loss 1e-3",
        "aenerf-small",
        "aenerf-mlp",
    )
    """Methods with options of ns-train."""
    steps: int = 200
    """Steps that are timed."""

    def main(self) -> None:
        """Profile all trainings, and write what was found."""
        rows = []
        for words in self.variants:
            with TemporaryDirectory() as folder:
                rows.append({"variant": words, **self._profile(shlex.split(words), Path(folder))})
            write_result(self.output, {"steps": self.steps, "rows": rows})

    def _profile(self, words: list[str], folder: Path) -> dict[str, Any]:
        trainer = _new_trainer(words, self.data, folder)
        on_gpu = trainer.pipeline.device.type == "cuda"

        def train(count: int) -> float:
            begin = time.perf_counter()
            train_steps(trainer, count)
            if on_gpu:
                torch.cuda.synchronize()
            return 1e3 * (time.perf_counter() - begin) / count

        # Compiles, and lets the proposal networks train in every second step only.
        train(_STEPS_BEFORE)
        if on_gpu:
            torch.cuda.reset_peak_memory_stats()
        milliseconds = train(self.steps)
        memory = torch.cuda.max_memory_allocated() / 2**30 if on_gpu else None
        # The profiler keeps every call, so it watches few steps: two periods of the pose correction.
        watched = 16
        with profile(activities=[ProfilerActivity.CPU, *[ProfilerActivity.CUDA] * on_gpu]) as profiler:
            train(watched)
        device = DeviceType.CUDA if on_gpu else DeviceType.CPU
        # A step of an optimizer is listed as a whole, too, beside its kernels.
        kernels = [
            event
            for event in profiler.key_averages()
            if event.device_type == device and not event.key.startswith("Optimizer.step#")
        ]
        own_time = "self_device_time_total" if on_gpu else "self_cpu_time_total"
        kernels.sort(key=lambda event: -getattr(event, own_time))
        return {
            "milliseconds": milliseconds,
            "kernels": sum(event.count for event in kernels) / watched,
            "busy_milliseconds": sum(getattr(event, own_time) for event in kernels) / 1e3 / watched,
            "peak_gib": memory,
            "longest": [
                {
                    "kernel": event.key[:100],
                    "calls": event.count / watched,
                    "milliseconds": getattr(event, own_time) / 1e3 / watched,
                }
                for event in kernels[:_KERNELS]
            ],
        }


def _new_trainer(words: list[str], data: Path, output: Path) -> AENeRFTrainer:
    """Set up a training, by a method and options of ns-train, that evaluates and saves nothing on its way."""
    # Otherwise this training would write into the logs of the one before.
    writer.EVENT_WRITERS.clear()
    writer.EVENT_STORAGE.clear()
    method, *options = words
    config: Any = tyro.cli(type(all_methods[method]), default=deepcopy(all_methods[method]), args=options)
    config.machine.seed, config.vis = 1, "tensorboard"
    config.machine.device_type = "cuda" if torch.cuda.is_available() else "cpu"
    config.pipeline.datamanager.data = config.pipeline.datamanager.dataparser.data = data
    never = dict.fromkeys(
        ("steps_per_eval_batch", "steps_per_eval_image", "steps_per_eval_all_images", "steps_per_save"), _STEPS + 1
    )
    # A new configuration, because the schedules follow the number of steps when it is made.
    config = replace(config, max_num_iterations=_STEPS, output_dir=output, timestamp="now", **never)
    torch.manual_seed(1)
    trainer: AENeRFTrainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer


if __name__ == "__main__":
    run_benchmark(Profile)
