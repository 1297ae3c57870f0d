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
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer
from nerfstudio.scripts import train as ns_train
from torch.autograd.profiler_util import FunctionEvent
from torch.profiler import profile, record_function

_RANGE = "part of a step: "
_BACKWARD_NODE = "autograd::engine::evaluate_function: "


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
        return self._seconds(lambda: self._train(steps))

    def render(self) -> dict[str, float]:
        """Render the first validation view and return the seconds that it took."""
        self._model.eval()
        return self._seconds(lambda: self._model.get_outputs_for_camera(self._camera))

    def psnr(self) -> float:
        """Return the PSNR over the validation views, with the color correction fitted on them."""
        pipeline = self._trainer.pipeline
        # Commits that refine the poses of the views would do it each time.
        pipeline.config.refine_test_poses = False
        pipeline.color_fit.fit()
        return pipeline.get_average_eval_image_metrics()["psnr"]

    def parts(self, steps: int) -> dict[str, float]:
        """Return the seconds that each part of some steps took: on a GPU those of its kernels, else wall-clock time."""
        trainer, model, manager = self._trainer, self._model, self._trainer.pipeline.datamanager
        places = [
            (manager, "next_train", "batch"),
            (model, "forward", "rendering"),
            (model.camera_optimizer, "apply_to_raybundle", "poses"),
            (model.camera_optimizer, "ray_rates", "poses"),
            (model.proposal_sampler, "forward", "proposals"),
            (model.field, "forward", "field"),
            (model, "get_loss_dict", "losses"),
            (model, "get_metrics_dict", "metrics"),
            (torch.Tensor, "backward", "backward"),
            (trainer.optimizers, "zero_grad_some", "optimizers"),
            (trainer.optimizers, "optimizer_scaler_step_some", "optimizers"),
            (trainer.optimizers, "scheduler_step_all", "optimizers"),
        ]
        with ExitStack() as stack:
            for owner, name, part in places:
                if hasattr(owner, name):
                    stack.enter_context(patch.object(owner, name, ranged(getattr(owner, name), part)))
            # In this thread, so that the backward pass lies within its range.
            stack.enter_context(torch.autograd.set_multithreading_enabled(False))
            profiler = stack.enter_context(profile())
            ranged(self._train, "rest")(steps)
        return seconds_of_parts(profiler.events(), on_gpu=self._camera.device.type == "cuda")

    def _train(self, steps: int) -> None:
        trainer = self._trainer
        for step in range(trainer.step, trainer.step + steps):
            trainer.pipeline.train()
            self._call_back(TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
            trainer.train_iteration(step)
            self._call_back(TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
            trainer.step = step + 1

    def _call_back(self, location: TrainingCallbackLocation) -> None:
        for callback in self._trainer.callbacks:
            callback.run_callback_at_location(self._trainer.step, location=location)

    def _seconds(self, work: Callable[[], Any]) -> dict[str, float]:
        self._wait()
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        self._wait()
        return {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}

    def _wait(self) -> None:
        if self._camera.device.type == "cuda":
            torch.cuda.synchronize()


def ranged(function: Callable[..., Any], part: str) -> Callable[..., Any]:
    """Return a function that the profiler sees as a part of the step."""

    def call(*arguments: Any, **options: Any) -> Any:
        with record_function(_RANGE + part):
            return function(*arguments, **options)

    return call


def seconds_of_parts(events: list[FunctionEvent], on_gpu: bool) -> dict[str, float]:
    """Return the seconds of the parts, which add up to the whole.

    A range does not count for the range around it. Autograd numbers the operations: a node of the backward pass has the
    number of its operation, and counts for the part in which that operation ran.
    """
    seconds: dict[str, float] = defaultdict(float)
    part_of_number: dict[int, str] = {}

    def visit(event: FunctionEvent, part: str) -> None:
        duration = (event.device_time_total if on_gpu else event.cpu_time_total) * 1e-6
        inner = part
        if event.name.startswith(_RANGE):
            inner = event.name.removeprefix(_RANGE)
        elif event.name.startswith(_BACKWARD_NODE):
            inner = f"backward of {part_of_number.get(event.sequence_nr, 'rest')}"
        elif not part.startswith("backward") and event.sequence_nr >= 0:
            part_of_number[event.sequence_nr] = part
        if inner != part:
            seconds[inner] += duration
            seconds[part] -= duration
        for child in event.cpu_children:
            visit(child, inner)

    for event in events:
        if event.name == _RANGE + "rest":
            seconds["rest"] += (event.device_time_total if on_gpu else event.cpu_time_total) * 1e-6
            for child in event.cpu_children:
                visit(child, "rest")
    return dict(seconds)


def main() -> None:
    """Answer requests until standard input ends."""
    if sys.argv[1] == "nerfacto":
        # At the end, because the repository's own `aenerf_ns` lacks two folders of the installed one.
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
