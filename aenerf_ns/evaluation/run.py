"""A trained run: all that evaluation, reports and exports need of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from aenerf_ns.method.model import AENeRFModel
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.recording.recording import Recording
from aenerf_ns.recording.scene import SceneRecording
from aenerf_ns.supervision.base import Sampler


@dataclass(frozen=True)
class TrainedRun:
    """A model with the data that it was trained on, and the views that it is evaluated on.

    Attributes:
        model: the model. It holds the corrected poses.
        data: the dataset, as the run's configuration names it.
        recording: the dataset in its own world and units.
        dataset: the training data.
        views: the reference views to evaluate on, None where there are none. Of a run that is opened to be tested,
            their cameras are where the evaluation places them.
        read_reference_views: reads the reference views of a split as the dataset gives them; None where there are none.
        sampler: draws the batches of the run's method, from events that are read with the first batch. None of a run
            that is opened for inference.
        refine_test_poses: whether to evaluate with photometrically refined test poses too.
        pose_diagnosis: see :func:`~aenerf_ns.evaluation.pose_diagnosis.diagnose`. None where poses are not corrected,
            and before the last step of a training.
    """

    model: AENeRFModel
    data: Path
    recording: Recording
    dataset: EventDataset
    views: EventDataset | None
    read_reference_views: Callable[[Literal["val", "test"]], EventDataset | None]
    sampler: Sampler | None
    refine_test_poses: bool
    pose_diagnosis: dict[str, Any] | None

    @property
    def scene(self) -> SceneRecording:
        """The recording in the frame of the scene."""
        return self.dataset.scene

    @property
    def device(self) -> torch.device:
        """The device that the model renders on."""
        return self.model.device
