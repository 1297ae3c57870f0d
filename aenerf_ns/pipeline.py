"""The pipeline: colour correction on the validation views, and honest loading and evaluation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.misc import step_check
from torch import Tensor

from aenerf_ns.datamanager import EventDataManager
from aenerf_ns.dataset import EventDataset
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

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool | None = None) -> None:
        """Loads a checkpoint, all of it: the framework would drop what does not fit without a word.

        Raises:
            RuntimeError: the checkpoint is of a model with other parameters.
        """
        super().load_state_dict(state_dict, strict=True)

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Adds the colour correction's to those of datamanager and model."""
        trainer = training_callback_attributes.trainer
        assert trainer is not None
        # The dataparser has resolved the time window by now: opening the run again must give the same cameras without
        # reading the events.
        trainer.config.save_config()
        last_step = trainer._start_step + trainer.config.max_num_iterations - 1

        def fit(step: int) -> None:
            if step == last_step or step_check(step, trainer.config.steps_per_save):
                self.fit_color_correction()
            elif step_check(step, _ROUGH_FIT_INTERVAL, run_at_zero=True):
                self.fit_color_correction(_ROUGH_FIT_SHARE)

        # After every step, since the trainer saves its last checkpoint before its callbacks for the end of training.
        callback = TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], fit, update_every_num_iters=1)
        return [*super().get_training_callbacks(training_callback_attributes), callback]

    @torch.no_grad()
    def fit_color_correction(self, share: float = 1.0) -> None:
        """Fits the colour correction on the validation views (protocol "affine"), or where there are none stretches
        what the training cameras see over the display's range.

        Args:
            share: of the configured number of pixels to fit it on.
        """
        views = self.datamanager.eval_dataset
        num_rays = round(share * self.model.config.color_correction_num_rays)
        if views is None:
            log_radiance, _ = self._sample_pixels(self.datamanager.train_dataset, num_rays, with_images=False)
            self.model.color_correction.stretch(log_radiance)
            return
        log_radiance, image = self._sample_pixels(views, num_rays, with_images=True)
        self.model.color_correction.fit(log_radiance, self.model.reference_radiance(image), len(views))

    def _sample_pixels(self, views: EventDataset, num_rays: int, with_images: bool) -> tuple[Tensor, Tensor]:
        """Rendered log-radiance (N, channels) and image values (N, 3) of random pixels of all views, the same pixels
        at every call."""
        generator = torch.Generator().manual_seed(0)
        cameras = views.cameras.to(self.device)
        count = max(num_rays // len(views), 1)
        bundles, values = [], []
        for index in range(len(views)):
            size = (int(cameras.height[index]), int(cameras.width[index]))
            rows, columns = (torch.randint(extent, (count,), generator=generator) for extent in size)
            coordinates = torch.stack([rows, columns], -1) + 0.5
            view = torch.full((count, 1), index)
            bundles.append(cameras.generate_rays(view.to(self.device), coords=coordinates.to(self.device)))
            if with_images:
                values.append(views.get_image_float32(index)[rows, columns, :3])
        image = torch.cat(values).to(self.device) if with_images else torch.zeros(0, 3)
        return self.model.render_log_radiance(bundles), image

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """Mean metrics over the reference views, and what they were computed with.

        Raises:
            SystemExit: there are no reference views.
        """
        if self.datamanager.eval_dataset is None:
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
