"""The pipeline: colour correction on the validation views, and honest loading and evaluation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.misc import step_check
from torch import Tensor

from aenerf_ns.datamanager import EventDataManager
from aenerf_ns.model import AENeRFModel

# Steps between rough fits of the colour correction, on a share of its pixels, for the viewer's picture while training.
_ROUGH_FIT_INTERVAL = 50
_ROUGH_FIT_SHARE = 1 / 8


@dataclass
class AENeRFPipelineConfig(VanillaPipelineConfig):
    """Pipeline of an event datamanager and an AE-NeRF model."""

    _target: type = field(default_factory=lambda: AENeRFPipeline)


class AENeRFPipeline(VanillaPipeline):
    """Fits the colour correction before each checkpoint, and evaluates with the one in the checkpoint."""

    config: AENeRFPipelineConfig
    datamanager: EventDataManager
    model: AENeRFModel

    def __init__(self, config: AENeRFPipelineConfig, device: str, **kwargs: Any) -> None:
        super().__init__(config, device, **kwargs)
        if self.datamanager.train_pixel_sampler is not None:
            self.datamanager.train_pixel_sampler.with_time_within = self.model.uses_temporal_loss

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool | None = None) -> None:
        """Loads a checkpoint, all of it: the framework would drop what does not fit without a word.

        Raises:
            RuntimeError: the checkpoint is of a model with other parameters.
        """
        super().load_state_dict(state_dict, strict=True)

    def get_train_loss_dict(self, step: int) -> tuple[Any, dict[str, Tensor], dict[str, Tensor]]:
        """Outputs, weighted losses and metrics of a training batch.

        Raises:
            SystemExit: a loss is not finite.
        """
        outputs, losses, metrics = super().get_train_loss_dict(step)
        # With mixed precision, too: the scaler would skip every step from now on without a word.
        _require_finite(losses, "loss", step)
        return outputs, losses, metrics

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Adds the colour correction's to those of datamanager and model, and a look at the gradients to every
        optimizer."""
        trainer = training_callback_attributes.trainer
        assert trainer is not None
        # The dataparser has resolved the time window by now: opening the run again must give the same cameras without
        # reading the events.
        if trainer.local_rank == 0:
            trainer.config.save_config()
        last_step = trainer._start_step + trainer.config.max_num_iterations - 1

        def fit(step: int) -> None:
            if step == last_step or step_check(step, trainer.config.steps_per_save):
                self.fit_color_correction()
            elif step_check(step, _ROUGH_FIT_INTERVAL, run_at_zero=True):
                self.fit_color_correction(_ROUGH_FIT_SHARE)

        for optimizer in trainer.optimizers.optimizers.values():
            # Called by mixed precision's scaler only when it has found the gradients finite.
            optimizer.register_step_pre_hook(
                lambda optimizer, *_: self._require_finite_gradients(optimizer, trainer.step)
            )
        # After every step, since the trainer saves its last checkpoint before its callbacks for the end of training.
        callback = TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], fit, update_every_num_iters=1)
        return [*super().get_training_callbacks(training_callback_attributes), callback]

    def _require_finite_gradients(self, optimizer: torch.optim.Optimizer, step: int) -> None:
        """Raises SystemExit when an optimizer is about to make weights not finite."""
        names = {parameter: name for name, parameter in self.model.named_parameters()}
        parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
        # A norm that overflows is more than Adam can square.
        norms = {names[p]: p.grad.norm() for p in parameters if p.grad is not None}
        _require_finite(norms, "gradient", step)

    @torch.no_grad()
    def fit_color_correction(self, share: float = 1.0) -> None:
        """Fits the colour correction on the validation views (protocol "affine"), or where there are none stretches
        what the training cameras see over the display's range.

        Args:
            share: of the configured number of pixels to fit it on.
        """
        rays, reference = self._pixels
        count = max(round(share * len(rays)), 1)
        log_radiance = self.model.render_log_radiance(rays[:count])
        if reference is None:
            self.model.color_correction.stretch(log_radiance)
        else:
            self.model.color_correction.fit(log_radiance, reference[:count], len(self.datamanager.eval_dataset))

    @cached_property
    def _pixels(self) -> tuple[RayBundle, Tensor | None]:
        """Rays through random pixels of all validation views, the same in every run, and the radiance (N, channels)
        of the references there; without references, of all training cameras, and None."""
        views = self.datamanager.eval_dataset or self.datamanager.train_dataset
        generator = torch.Generator().manual_seed(0)
        cameras = views.cameras
        count = max(self.model.config.color_correction_num_rays, len(views))
        # Every view as often as the others, in random order: any part of it is spread over the views, too.
        index = (torch.arange(count) % len(views))[torch.randperm(count, generator=generator)]
        size = torch.cat([cameras.height, cameras.width], -1)[index]
        pixels = (torch.rand(count, 2, generator=generator) * size).long()
        rays = cameras.to(self.device).generate_rays(
            index[:, None].to(self.device), coords=(pixels + 0.5).to(self.device)
        )
        if self.datamanager.eval_dataset is None:
            return rays, None
        image = torch.zeros(count, 3)
        for view in range(len(views)):
            rows, columns = pixels[index == view].T
            image[index == view] = views.get_image_float32(view)[rows, columns, :3]
        return rays, self.model.reference_radiance(image).to(self.device)

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """Mean metrics over the reference views, and what they were computed with.

        Raises:
            SystemExit: there are no reference views.
        """
        if not self.datamanager.has_reference_views:
            raise SystemExit(
                f"Error: {self.datamanager.get_datapath()}: the {self.datamanager.test_split} split has no reference "
                "images to evaluate on; ns-render shows what was reconstructed"
            )
        metrics: dict[str, Any] = super().get_average_eval_image_metrics(step, output_path, get_std)
        # A single view has no standard deviation, and NaN is no JSON.
        metrics = {name: value for name, value in metrics.items() if not math.isnan(value)}
        if self.test_mode == "test":
            # The trainer's log, in the other mode, takes numbers only.
            num_views = int(self.model.color_correction.num_views)
            metrics["color_correction"] = (
                f"affine, fitted on {num_views} validation views" if num_views else "percentile stretch, no references"
            )
            metrics["num_views"] = len(self.datamanager.eval_dataset)
            if self.model.image_metrics.lpips_absent is not None:
                metrics["lpips"] = None
                metrics["lpips_absent"] = self.model.image_metrics.lpips_absent
        return metrics


def _require_finite(values: Mapping[str, Tensor], what: str, step: int) -> None:
    """Raises SystemExit unless all scalar ``values`` are finite.

    A GPU's queue runs dry here, once a call however many values there are. That is the price of stopping ahead of the
    first weight that would be lost.
    """
    finite = torch.stack([value.detach() for value in values.values()]).isfinite().tolist()
    if all(finite):
        return
    bad = ", ".join(f"{name} {value:g}" for (name, value), ok in zip(values.items(), finite, strict=True) if not ok)
    raise SystemExit(
        f"Error: step {step}: {what} not finite ({bad}), training stopped before this reached the weights; "
        "go on from the last checkpoint or start again, with lower learning rates, without --mixed-precision if on"
        ", and with poses of sensible scale"
    )
