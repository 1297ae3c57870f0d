"""The pipeline: colour correction on reference views, and honest loading and evaluation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.misc import step_check
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from aenerf_ns.color_correction import ColorCorrectionProtocol, NoColorCorrection
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
        # Made once: a fit every so many steps would read the images again.
        self._pixels_of_split: dict[str, tuple[RayBundle, Tensor | None, int]] = {}
        self._warn_of_test_views()

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
        if trainer.local_rank == 0:
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

    def replace_color_correction(self, protocol: ColorCorrectionProtocol) -> None:
        """Replaces the run's colour correction by that of another protocol, fitted anew on the run's data."""
        self.model.color_correction = self.model.new_color_correction(protocol).to(self.device)
        self._warn_of_test_views()
        self.fit_color_correction()

    @torch.no_grad()
    def fit_color_correction(self, share: float = 1.0) -> None:
        """Fits the colour correction on its protocol's reference views, or where there are none stretches what the
        training cameras see over the display's range.

        Args:
            share: of the configured number of pixels to fit it on. Less than all makes a rough fit.
        """
        correction = self.model.color_correction
        if isinstance(correction, NoColorCorrection):
            return
        if correction.split not in self._pixels_of_split:
            self._pixels_of_split[correction.split] = self._pixels(correction.split)
        rays, reference, num_views = self._pixels_of_split[correction.split]
        count = max(round(share * len(rays)), 1)
        log_radiance = self.model.render_log_radiance(rays[:count])
        if reference is None:
            correction.stretch(log_radiance)
        else:
            correction.fit(log_radiance, reference[:count], num_views, rough=share < 1)

    def _warn_of_test_views(self) -> None:
        if self.model.color_correction.protocol == "affine-test":
            CONSOLE.print(
                "[yellow]Colour correction affine-test is fitted on the test views themselves: only to compare with "
                "figures that were made so."
            )

    def _pixels(self, split: Literal["val", "test"]) -> tuple[RayBundle, Tensor | None, int]:
        """Rays through random pixels of all reference views of a split, the same in every run, the radiance
        (N, channels) of the references there, and the number of views; without references, rays of all training
        cameras, None, and 0."""
        references = self.datamanager.reference_views(split)
        views = references or self.datamanager.train_dataset
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
        if references is None:
            return rays, None, 0
        image = torch.zeros(count, 3)
        for view in range(len(views)):
            rows, columns = pixels[index == view].T
            image[index == view] = views.get_image_float32(view)[rows, columns, :3]
        return rays, self.model.reference_radiance(image).to(self.device), len(views)

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
            metrics["color_correction"] = self.model.color_correction.description
            metrics["num_views"] = len(self.datamanager.eval_dataset)
            if self.model.image_metrics.lpips_absent is not None:
                metrics["lpips"] = None
                metrics["lpips_absent"] = self.model.image_metrics.lpips_absent
        return metrics
