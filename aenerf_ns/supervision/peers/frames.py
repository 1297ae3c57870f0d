"""Supervision by images: those that ``aenerf reconstruct`` makes of the events, as in E2VID + NeRF."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from aenerf_ns.errors import DataError
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.recording.images import check_image, read_image
from aenerf_ns.supervision.base import Batch, Sampler, SamplerConfig, Supervision
from aenerf_ns.supervision.pixel_rays import PixelRays


@dataclass
class FrameBatch(Batch):
    """Pixels of images.

    Attributes:
        values: (N, channels) display values in [0, 1].
    """

    values: Tensor


class FrameSupervision(Supervision):
    """Compares rendered radiance with the display values of images.

    A network that reconstructs images knows neither their exposure nor their gamma. So the field learns display values
    as they are. The color correction, which is affine in the logarithm, takes up the exposure and the gamma.
    """

    batch_type = FrameBatch

    def loss_unit(self, outputs: Mapping[str, Any]) -> float:
        """Return 1, because the loss has the unit of display values and not of log-radiance."""
        return 1.0

    def losses(self, outputs: Mapping[str, Any], batch: FrameBatch) -> dict[str, Tensor]:
        """Return the mean squared error of radiance."""
        return {"reconstruction_loss": F.mse_loss(outputs["log_radiance"].exp(), batch.values)}


class FrameSampler(Sampler):
    """Draws pixels of the dataset's timed training images, at the poses of the trajectory at their times."""

    batch_type = FrameBatch

    def __init__(
        self, config: SamplerConfig, dataset: EventDataset, supervision: Supervision, device: torch.device | str
    ) -> None:
        super().__init__(config, dataset, supervision, device)
        self._pixel_rays = PixelRays(dataset.scene, device)
        self._usable = torch.from_numpy(np.flatnonzero(self._pixel_rays.usable)).to(device)

    def prepare(self) -> None:
        """Read the images now rather than with the first batch.

        Raises:
            DataError: there are no images to train on, or one cannot be read.
        """
        _ = self._frames

    @cached_property
    def _frames(self) -> tuple[Tensor, Tensor]:
        """(M,) float64 times since the trajectory's start, and (M, pixels, channels) uint8 values, on the device."""
        scene = self.dataset.scene
        if not scene.frames:
            raise DataError(
                scene.event_file.path.parent,
                "it has no training images that the event camera took at known times",
                "make some with aenerf reconstruct",
            )
        mode = "L" if scene.sensor.num_channels == 1 else "RGB"
        values = []
        for _, file in scene.frames:
            check_image(file, scene.event_camera)
            values.append(np.asarray(read_image(file).convert(mode)).reshape(-1, scene.sensor.num_channels))
        line = f"Training on {len(values)} images, the first of them {scene.frames[0][1]}."
        CONSOLE.print(line, markup=False, soft_wrap=True)
        times = torch.tensor([time for time, _ in scene.frames], device=self.device)
        return self._pixel_rays.trajectory.seconds(times), torch.from_numpy(np.stack(values)).to(self.device)

    def sample(self, num_rays: int, training: bool = True) -> tuple[RayBundle, FrameBatch]:
        """Draw a batch of pixels.

        Args:
            num_rays: the number of rays, one for each pixel.
            training: has no effect.

        Returns:
            The rays of the N pixels, and their display values.
        """
        seconds, values = self._frames
        frame = torch.randint(len(seconds), (num_rays,), device=self.device)
        pixel = self._usable[torch.randint(len(self._usable), (num_rays,), device=self.device)]
        return self._pixel_rays.rays(pixel, [seconds[frame]]), FrameBatch(values[frame, pixel] / 255)
