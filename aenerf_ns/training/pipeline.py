"""The pipeline: checks every step, fits the color correction, diagnoses the poses, and loads strictly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils import comms
from nerfstudio.utils.misc import step_check
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from aenerf_ns.errors import errors_as_one_line
from aenerf_ns.evaluation.color_fit import ColorFit
from aenerf_ns.evaluation.evaluate import evaluate
from aenerf_ns.evaluation.pose_diagnosis import diagnose
from aenerf_ns.evaluation.poses import compare_with_ground_truth
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.evaluation.view_metrics import average_metrics, measure_reference_views
from aenerf_ns.method.model import AENeRFModel
from aenerf_ns.supervision.base import ChangeBatch
from aenerf_ns.training.datamanager import EventDataManager
from aenerf_ns.training.framework import mean_step_seconds, steps_of
from aenerf_ns.training.preflight import provide_ffmpeg, require_camera_path
from aenerf_ns.training.training_state import TrainingState
from aenerf_ns.viewer.panel import RecordingPanel
from aenerf_ns.viewer.recording_view import RecordingView

# Steps between rough fits of the color correction, on a share of its pixels, for the viewer's picture while training.
_ROUGH_FIT_INTERVAL = 50
_ROUGH_FIT_SHARE = 1 / 8
# Steps between the errors of the corrected poses in the log, where true ones are known.
_POSE_ERROR_INTERVAL = 100


@dataclass
class AENeRFPipelineConfig(VanillaPipelineConfig):
    """Pipeline of an event datamanager and an AE-NeRF model."""

    _target: type = field(default_factory=lambda: AENeRFPipeline)
    refine_test_poses: bool = True
    """Evaluate a trained run a second time, with test poses that are refined photometrically. Besides the picture, that
    takes some 13,000 rays a view and their gradients."""


class AENeRFPipeline(VanillaPipeline):
    """Fits the color correction before each checkpoint, and evaluates with the one in the checkpoint."""

    config: AENeRFPipelineConfig
    datamanager: EventDataManager
    model: AENeRFModel

    def __init__(
        self,
        config: AENeRFPipelineConfig,
        device: str,
        test_mode: Literal["test", "val", "inference"] = "val",
        **kwargs: Any,
    ) -> None:
        if test_mode != "val":
            # Once the pipeline is made, ns-render asks for a program that pip cannot install, and reads a camera path.
            provide_ffmpeg()
            with errors_as_one_line():
                require_camera_path()
        super().__init__(config, device, test_mode=test_mode, **kwargs)
        self._pose_diagnosis: dict[str, Any] | None = None
        data = self.datamanager
        options = self.model.config.options_of_weights()
        self.training_state = TrainingState(data.train_dataset.scene, Path(data.get_datapath()), options)
        if test_mode != "inference":
            self.datamanager.supervise(self.model.supervision)
        # Made ahead of training: this run's diagnosis stays empty, and the fit does not read it.
        self.color_fit = ColorFit(self.trained_run())
        self._unchecked_losses: dict[str, Tensor] = {}
        self._steps_per_log = 1
        # The viewer, where one runs, finds its elements here and names their folder after the attribute.
        self.recording = RecordingPanel(RecordingView(self.model, self.datamanager.train_dataset))

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool | None = None) -> None:
        """Load all of a checkpoint. The framework would silently drop what does not fit.

        Raises:
            RuntimeError: the checkpoint belongs to a model with other parameters.
            SystemExit: with one clear line, when it belongs to a scene that is elsewhere.
        """
        with errors_as_one_line():
            super().load_state_dict(state_dict, strict=True)
        if self.test_mode != "val":
            # The framework's renderers and exporters derive their own cameras from these cameras.
            self.datamanager.place_cameras(self.model.camera_optimizer)
            self.model.camera_optimizer.training_cameras_are_corrected = True

    def get_extra_state(self) -> dict[str, Any] | None:
        """Return the diagnosis of the pose correction, which checkpoints hold; None before the last step."""
        return self._pose_diagnosis

    def set_extra_state(self, state: dict[str, Any] | None) -> None:
        """Take the diagnosis of the pose correction from a checkpoint."""
        self._pose_diagnosis = state

    def get_train_loss_dict(self, step: int) -> tuple[Any, dict[str, Tensor], dict[str, Any]]:
        """Return outputs, weighted losses and metrics of a training batch.

        There are metrics only at the steps that the trainer logs, with the pairs that are trained on in a second, and
        with the errors of the corrected poses if the step is a multiple of 100. The losses are checked after the
        backward pass, together with the gradients.
        """
        rays, batch = self.datamanager.next_train(step)
        # In several processes the model is wrapped in DistributedDataParallel.
        outputs = self._model(rays)
        metrics = {}
        if step_check(step, self._steps_per_log, run_at_zero=True):
            metrics = self.model.get_metrics_dict(outputs, batch)
            seconds = mean_step_seconds()
            if seconds is not None and isinstance(batch, ChangeBatch):
                metrics["pairs_per_second"] = comms.get_world_size() * len(batch) / seconds
            if step_check(step, _POSE_ERROR_INTERVAL, run_at_zero=True):
                errors = compare_with_ground_truth(self.model.camera_optimizer, self.datamanager.train_dataset.scene)
                if errors is not None:
                    metrics |= errors["corrected"]
        losses = self.model.get_loss_dict(outputs, batch, metrics)
        self._unchecked_losses = losses
        return outputs, losses, metrics

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Return all callbacks, with the color correction's and the diagnosis', and let optimizers check gradients."""
        trainer = training_callback_attributes.trainer
        steps = steps_of(trainer)
        self.training_state.resume(trainer, self.model.proposal_sampler)
        # A run that goes on from a checkpoint is diagnosed anew at its own end.
        self._pose_diagnosis = None

        def diagnose_poses(step: int) -> None:
            if step == steps[-1] and self.model.camera_optimizer.is_learned and comms.is_main_process():
                self._pose_diagnosis = diagnose(self.trained_run())
                CONSOLE.print(self._pose_diagnosis["summary"], soft_wrap=True)

        def fit(step: int) -> None:
            # The main process alone writes the checkpoints and evaluates.
            if not comms.is_main_process():
                return
            if step == steps[-1] or step_check(step, trainer.config.steps_per_save):
                self.color_fit.fit()
            elif step_check(step, _ROUGH_FIT_INTERVAL, run_at_zero=True):
                self.color_fit.fit(_ROUGH_FIT_SHARE)

        def check_losses(step: int) -> None:
            # With mixed precision only the losses are left to check. The scaler drops gradients that are not finite. If
            # the losses are not, it would silently drop every step's from now on.
            if self._unchecked_losses:
                self._require_finite([], step)

        self._steps_per_log = trainer.config.logging.steps_per_log
        optimizers = list(trainer.optimizers.optimizers.values())

        def check(*_: Any) -> None:
            # The first optimizer of a step looks at all gradients. Mixed precision's are still scaled here.
            if self._unchecked_losses and not trainer.grad_scaler.is_enabled():
                self._require_finite(optimizers, trainer.step)

        for optimizer in optimizers:
            optimizer.register_step_pre_hook(check)
        # After every step, because the trainer saves its last checkpoint before it calls the callbacks for the end.
        callbacks = [
            TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], function)
            for function in (check_losses, diagnose_poses, fit, lambda step: self.recording.after_step())
        ]
        return [*super().get_training_callbacks(training_callback_attributes), *callbacks]

    def _require_finite(self, optimizers: list[torch.optim.Optimizer], step: int) -> None:
        """Raise SystemExit unless the step's losses and the gradients of optimizers are finite.

        The CPU waits for the GPU once a call, however many values there are. That is the price of stopping before the
        first weight is lost.
        """
        losses, self._unchecked_losses = self._unchecked_losses, {}
        groups = [group for optimizer in optimizers for group in optimizer.param_groups]
        parameters = [p for group in groups for p in group["params"] if p.grad is not None]
        # Adam squares gradients: it cannot use a gradient whose norm overflows.
        norms = torch._foreach_norm([parameter.grad for parameter in parameters]) if parameters else ()
        values = torch.stack([*(loss.detach() for loss in losses.values()), *norms]).tolist()
        if all(map(math.isfinite, values)):
            return
        name_of = {parameter: name for name, parameter in self.model.named_parameters()}
        names = [*losses, *(name_of[parameter] for parameter in parameters)]
        bad = [f"{name} {value:g}" for name, value in zip(names, values, strict=True) if not math.isfinite(value)]
        # A loss that is not finite is the cause of gradients that are not.
        bad_losses = [line for line in bad if line.split()[0] in losses]
        what, bad = ("loss", bad_losses) if bad_losses else ("gradient", bad)
        raise SystemExit(
            f"Error: step {step}: {what} not finite ({', '.join(bad)}), training stopped before this reached the "
            "weights; go on from the last checkpoint (with --load-scheduler False, or its own learning rates count) or "
            "start again, with lower learning rates, without --mixed-precision if on, and with poses of sensible scale"
        )

    def trained_run(self) -> TrainedRun:
        """Return what evaluation, reports and exports need of this pipeline."""
        data = self.datamanager
        return TrainedRun(
            model=self.model,
            data=Path(data.get_datapath()),
            recording=data.dataparser.recording,
            dataset=data.train_dataset,
            views=data.eval_dataset if data.has_reference_views else None,
            read_reference_views=data.reference_views,
            sampler=data.train_pixel_sampler,
            refine_test_poses=self.config.refine_test_poses,
            pose_diagnosis=self._pose_diagnosis,
        )

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """Return all figures of :func:`~aenerf_ns.evaluation.evaluate.evaluate`; while training, the metrics alone.

        Raises:
            SystemExit: with one clear line, when there is nothing to evaluate on or the model renders no numbers.
        """
        run = self.trained_run()
        with errors_as_one_line():
            if self.test_mode == "test":
                return evaluate(run, output_path, get_std)
            # The trainer's log takes numbers only.
            return average_metrics(measure_reference_views(run, output_path), get_std)
