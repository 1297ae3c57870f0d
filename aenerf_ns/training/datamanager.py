"""The event datamanager: batches of the supervision's sampler for training, reference views for evaluation."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.data.utils.dataloaders import FixedIndicesEvalDataloader, RandIndicesEvalDataloader

from aenerf_ns.errors import errors_as_one_line
from aenerf_ns.method.pose_correction import PoseCorrection
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.supervision.base import Batch, Sampler, SamplerConfig, Supervision
from aenerf_ns.supervision.event_pairs import PairSamplerConfig


@dataclass
class EventDataManagerConfig(VanillaDataManagerConfig):
    """Events to train on. Inherited options about sampling pixels of images have no effect."""

    _target: type = field(default_factory=lambda: EventDataManager)
    train_num_rays_per_batch: int = 8192
    """The most rays of a training batch. A pair of events takes two, or three with the temporal loss. A pixel in a
    window of time takes two, a pixel of an image one."""
    eval_num_rays_per_batch: int = 8192
    """The most rays of a batch on which the loss is logged without training. A pair of events takes two, and so does a
    pixel in a window of time. A pixel of an image takes one."""
    sampler: SamplerConfig = field(default_factory=PairSamplerConfig)
    """How batches are drawn. The model's supervision says what their renderings are compared with."""


class EventDataManager(VanillaDataManager[EventDataset]):
    """Nerfstudio's datamanager, with events to train on.

    Raises:
        SystemExit: with one clear line, when the dataset cannot be used.
    """

    config: EventDataManagerConfig
    dataparser: EventDataParser
    train_pixel_sampler: Sampler | None
    has_reference_views: bool

    def __init__(self, config: EventDataManagerConfig, **kwargs: Any) -> None:
        with errors_as_one_line():
            super().__init__(config, **kwargs)

    def resolved_config(self) -> EventDataManagerConfig:
        """Return the configuration with what the dataparser resolved: its format, its paths and its time window."""
        dataparser = self.dataparser.resolved_config()
        # The framework's fields, whose types mypy does not see.
        return replace(self.config, dataparser=dataparser, data=dataparser.data)  # type: ignore[call-arg]

    def create_eval_dataset(self) -> EventDataset | None:
        """Return the reference views.

        Without reference views: None while training, else the training cameras, so that the framework's renderers have
        cameras to start from.
        """
        views = self.reference_views(self.test_split)
        self.has_reference_views = views is not None
        # ns-render dataset --split val opens the validation views as a training does.
        if views is None and (self.test_mode != "val" or Path(sys.argv[0]).name == "ns-render"):
            return self.train_dataset
        return views

    def reference_views(self, split: Literal["val", "test"]) -> EventDataset | None:
        """Return the reference views of a split, or None where there are none."""
        outputs = self.dataparser.get_dataparser_outputs(split=split)
        if not outputs.image_filenames:
            return None
        return self.dataset_type(dataparser_outputs=outputs, scale_factor=self.config.camera_res_scale_factor)

    def setup_train(self) -> None:
        """Do nothing: :meth:`supervise` makes the sampler, once there is a supervision to make it for."""

    def supervise(self, supervision: Supervision) -> None:
        """Make the sampler for a supervision. While training, read the events for both; a trained run opens without.

        Raises:
            SystemExit: with one clear line, when events, sampler and supervision do not fit each other.
        """
        with errors_as_one_line():
            self.train_pixel_sampler = self.config.sampler.setup(
                dataset=self.train_dataset, supervision=supervision, device=self.device
            )
            # Exporters of the framework change it.
            self.train_pixel_sampler.num_rays_per_batch = self.config.train_num_rays_per_batch
            if self.test_mode == "val":
                self.train_pixel_sampler.prepare()
                supervision.prepare(self.train_dataset)

    def setup_eval(self) -> None:
        """Make the loaders of whole reference views. No pixels are sampled from them."""
        options = {"input_dataset": self.eval_dataset, "device": self.device, "num_workers": self.world_size * 4}
        self.fixed_indices_eval_dataloader = FixedIndicesEvalDataloader(**options)
        self.eval_dataloader = RandIndicesEvalDataloader(**options)

    def place_cameras(self, correction: PoseCorrection) -> None:
        """Carry all cameras over to the frame of the corrected poses, for good. Training cameras are only shown."""
        for dataset in [self.train_dataset, self.eval_dataset] if self.has_reference_views else [self.train_dataset]:
            poses = correction.apply_to_camera(dataset.cameras.to(self.device)).to(dataset.cameras.device)
            # Without metadata: these cameras are in the scene's frame, and must not be carried there again.
            dataset.cameras = replace(dataset.cameras, camera_to_worlds=poses, metadata={})
        if self.test_mode != "inference":
            # The loaders have copies of the cameras.
            self.setup_eval()

    def next_train(self, step: int) -> tuple[RayBundle, Batch]:
        """Draw a batch to train on; see :meth:`Sampler.sample`."""
        # An exporter asks a trained run for batches too: its events are read only then.
        return self._sample(self.get_train_rays_per_batch(), training=self.test_mode == "val")

    def next_eval(self, step: int) -> tuple[RayBundle, Batch]:
        """Draw a batch to log the loss on."""
        return self._sample(self.config.eval_num_rays_per_batch, training=False)

    def _sample(self, num_rays: int, training: bool) -> tuple[RayBundle, Batch]:
        assert self.train_pixel_sampler is not None
        with errors_as_one_line():
            return self.train_pixel_sampler.sample(num_rays, training)
