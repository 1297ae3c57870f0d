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
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from aenerf_ns.camera.image_encoding import ImageEncoding, decode, encode, to_channels
from aenerf_ns.errors import DataError
from aenerf_ns.recording.images import check_image, read_image
from aenerf_ns.supervision.base import Batch, Sampler, Supervision


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

    def prepare(self) -> None:
        """See :meth:`Sampler.prepare`."""
        _ = self._frames

    @cached_property
    def _frames(self) -> tuple[Tensor, Tensor, Tensor]:
        """(M,) float64 times since the trajectory's start, (M, pixels, channels) uint8 values, and the pixels to draw
        from, on the device."""
        scene = self.dataset.scene
        if not scene.frames:
            problem = "it has no training images that the event camera took at known times"
            raise DataError(scene.event_file.path.parent, problem, "make some with aenerf reconstruct")
        values = []
        for _, file in scene.frames:
            check_image(file, scene.event_camera)
            values.append(_as_seen(read_image(file), scene.sensor.num_channels, scene.image_encoding))
        line = f"Training on {len(values)} images, the first of them {scene.frames[0][1]}."
        CONSOLE.print(line, markup=False, soft_wrap=True)
        times = torch.tensor([time for time, _ in scene.frames], device=self.device)
        usable = torch.from_numpy(np.flatnonzero(self.pixel_rays.usable)).to(self.device)
        seen = torch.from_numpy(np.stack(values)).to(self.device)
        return self.pixel_rays.trajectory.seconds(times), seen, usable

    def sample(self, num_rays: int, training: bool = True) -> tuple[RayBundle, FrameBatch]:
        """Draw pixels of images, which take a ray each; see :meth:`Sampler.sample`."""
        seconds, values, usable = self._frames
        frame = torch.randint(len(seconds), (num_rays,), device=self.device)
        pixel = usable[torch.randint(len(usable), (num_rays,), device=self.device)]
        return self.pixel_rays.rays(pixel, [seconds[frame]]), FrameBatch(values[frame, pixel] / 255)


def _as_seen(image: Image.Image, num_channels: int, encoding: ImageEncoding) -> NDArray[np.uint8]:
    """Return the (pixels, channels) display values of an image as the sensor sees it and the metrics compare it."""
    display = torch.from_numpy(np.array(image.convert("RGB")).reshape(-1, 3)) / 255
    seen = to_channels(decode(display, encoding), num_channels)
    return (255 * encode(seen, encoding)).round().byte().numpy()
