"""All that is used of Nerfstudio although it is private, or global to the process.

A new version may change it without notice: a test asks for each name. The rest goes by Nerfstudio's public classes and
by subclasses of them.
"""

from __future__ import annotations

import inspect
from typing import Any

from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import writer

USED_NAMES = {
    # Read here.
    "nerfstudio.engine.trainer:Trainer": ("_load_checkpoint", "_start_step"),
    "nerfstudio.utils.writer": ("EVENT_WRITERS", "EVENT_STORAGE", "GLOBAL_BUFFER"),
    # Overridden or read in subclasses.
    "nerfstudio.configs.base_config:InstantiateConfig": ("_target",),
    "nerfstudio.data.dataparsers.base_dataparser:DataParser": ("_generate_dataparser_outputs",),
    "nerfstudio.data.datasets.base_dataset:InputDataset": ("_dataparser_outputs",),
    "nerfstudio.model_components.ray_samplers:ProposalNetworkSampler": ("_step", "_steps_since_update"),
    "nerfstudio.pipelines.base_pipeline:VanillaPipeline": ("_model",),
    "nerfstudio.viewer.viewer_elements:ViewerControl": ("_setup",),
}
"""The names, by the module or class of Nerfstudio that has them."""


def steps_of(trainer: Trainer) -> range:
    """Return the steps that a trainer will take, once it has loaded its checkpoint.

    Nerfstudio 1.1.5 takes ``max_num_iterations`` more steps when it resumes. Its main branch, which calls itself 1.1.5
    too, counts the steps before the checkpoint among them since commit 4d73c4e6.
    """
    start, count = trainer._start_step, trainer.config.max_num_iterations
    return range(start, count if _counts_earlier_steps() else start + count)


def iterations_to_reach(end: int, step: int) -> int:
    """Return the ``max_num_iterations`` with which a run that resumes after a step ends ahead of step ``end``."""
    return end if _counts_earlier_steps() else end - step - 1


def _counts_earlier_steps() -> bool:
    return "max_num_iterations - self._start_step" in inspect.getsource(Trainer.train)


def add_writer(new_writer: writer.Writer) -> None:
    """Send all that a training logs to a writer, too."""
    writer.EVENT_WRITERS.append(new_writer)


def set_end(step: int) -> None:
    """Tell the log at which step a training ends. Nerfstudio takes a run that resumes for one that starts at step 0."""
    writer.GLOBAL_BUFFER["max_iter"] = step


def logged_events() -> dict[str, Any]:
    """Return what has been logged since it was last written out, by name."""
    return {event["name"]: event["event"] for event in writer.EVENT_STORAGE}


def progress() -> tuple[int, float]:
    """Return the latest step, and the share of the training that is done by then."""
    step = writer.GLOBAL_BUFFER["step"]
    return step, step / writer.GLOBAL_BUFFER["max_iter"]


def is_logged(step: int) -> bool:
    """Return whether the losses of a step are logged."""
    return step % writer.GLOBAL_BUFFER["steps_per_log"] == 0


def mean_step_seconds() -> float | None:
    """Return the mean time of the latest steps; None before the first step, and outside a training."""
    times = writer.GLOBAL_BUFFER.get("events", {}).get(writer.EventName.ITER_TRAIN_TIME.value)
    return None if times is None else times["avg"]
