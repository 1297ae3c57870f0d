"""Train by ns-train, some steps at a time, and tell how long they took.

    python benchmarks/step/worker.py METHOD OPTIONS

A request is one line of JSON on standard input, such as ``["train", 8]``; the answer is one line of JSON on standard
output. This file runs with the code of any commit: it uses only the names of Nerfstudio and those of AE-NeRF's pipeline
that have never changed.
"""

from __future__ import annotations

import importlib.util
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer
from nerfstudio.scripts import train as ns_train


def train_steps(trainer: Trainer, count: int) -> None:
    """Train for some more steps as Nerfstudio does, with the callbacks, but without its evaluations and checkpoints."""

    def call_back(location: TrainingCallbackLocation) -> None:
        for callback in trainer.callbacks:
            callback.run_callback_at_location(trainer.step, location=location)

    for step in range(trainer.step, trainer.step + count):
        trainer.pipeline.train()
        call_back(TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        trainer.train_iteration(step)
        call_back(TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
        trainer.step = step + 1


class _Worker:
    """Answer requests about one training."""

    def __init__(self, trainer: Trainer) -> None:
        self._trainer = trainer
        self._model = trainer.pipeline.model
        self._camera = trainer.pipeline.datamanager.eval_dataset.cameras[:1].to(trainer.device)

    def about(self, scale: float) -> dict[str, Any]:
        """Scale the size of the picture.

        Returns:
            The file of the package that is measured, the most rays of a step, and the pixels of the scaled picture.
        """
        self._camera.rescale_output_resolution(scale)
        package = importlib.util.find_spec("aenerf_ns")
        return {
            "package": package.origin if package else None,
            "rays": self._trainer.pipeline.datamanager.get_train_rays_per_batch(),
            "pixels": int(self._camera.height) * int(self._camera.width),
        }

    def train(self, steps: int) -> dict[str, float]:
        """Train for some steps and return the seconds that they took."""
        return self._seconds(lambda: train_steps(self._trainer, steps))

    def render(self) -> dict[str, float]:
        """Render the first validation view and return the seconds that it took."""
        self._model.eval()
        return self._seconds(lambda: self._model.get_outputs_for_camera(self._camera))

    def _seconds(self, work: Callable[[], Any]) -> dict[str, float]:
        self._wait()
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        self._wait()
        return {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}

    def _wait(self) -> None:
        if self._camera.device.type == "cuda":
            torch.cuda.synchronize()


def main() -> None:
    """Answer requests until standard input ends."""
    if sys.argv[1] == "nerfacto":
        # The path comes last, because the repository's own `aenerf_ns` lacks two folders of the installed one.
        sys.path.append(str(Path(__file__).parents[2]))
        from benchmarks.paper.worker import prepare

        prepare()
    # All else that is printed goes to standard error.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf8", buffering=1)
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())

    def serve(trainer: Trainer) -> None:
        worker = _Worker(trainer)
        for request in sys.stdin:
            name, *arguments = json.loads(request)
            answers.write(json.dumps(getattr(worker, name)(*arguments)) + "\n")

    Trainer.train = serve
    ns_train.entrypoint()


if __name__ == "__main__":
    main()
