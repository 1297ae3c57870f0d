"""PAEv3D's supervision: patches in windows of time, and priors from the optical flow of the events.

J. Wang, J. He, Z. Zhang and R. Xu, *Physical Priors Augmented Event-Based 3D Reconstruction*, ICRA 2024. Its release is
Mercerai/PAEv3d, read at 97f6a2b. The release has no licence, so nothing of it was copied. It differs from what is here:

- **Flow.** The release takes the flow from a network, and from random weights if the network's file is missing. Its
  README says that the paper's flow came from an optimisation. Here it comes from this project's contrast maximisation:
  one velocity for each tile of 16 pixels, over events in a row that are twice as many as the pixels. A pixel without
  events in the window has no flow.
- **Flow loss.** The release compares the change of a linear brightness with a change of its logarithm, and multiplies
  the flow along x by the difference between rows. Here both sides are logarithms, the flow along x goes with the
  difference between columns, and velocities are multiplied by the length of the window.
- **Least opacity.** The release's rises from 0 to 0.25 in 20,000 steps, because its field starts transparent. Here the
  field starts opaque, so 0.25 holds from the start.
- **Maxima.** The depth loss divides depth and flow by their maxima over the batch, which is one window in the release.
  Here a batch has several windows, of different speeds, so the maxima are those of each window.
- **Depth and opacity** are those at the start of the window, where the flow loss has its differences.
- **Units.** All losses are divided by the mean contrast threshold, so their weights mean the same as in the release.
- **Two thresholds.** Positive and negative events count with the sensor's C+ and C-, and the change is cut at five of
  either.
- **Windows** of the release are up to 10 pose intervals long. Here they are up to 0.01 of the recording's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.model_components.renderers import AccumulationRenderer, DepthRenderer
from numpy.typing import NDArray
from torch import Tensor

from aenerf_ns.errors import DataError
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.supervision.base import Supervision, SupervisionConfig
from aenerf_ns.supervision.windows import (
    DrawnWindow,
    WindowSampler,
    WindowSamplerConfig,
    WindowSupervision,
    drawn_from,
)

# A change is cut at that of so many events.
_MOST_EVENTS = 5
# Rays of less opacity have no priors.
_LEAST_OPACITY = 0.25
# The mask loss of a ray of less opacity is constant.
_LEAST_LOG_OPACITY = 1e-3
# Shares of the patches with 0, 1, 2, 3 and 4 active pixels.
_SHARES = np.array([5, 25, 25, 25, 176]) / 256
# Events from which a flow is computed, as a share of the sensor's pixels. With half as many, edges of the benchmark's
# scenes move by three pixels only.
_FLOW_DENSITY = 2.0


def mask_loss(opacity: Tensor, has_flow: Tensor) -> Tensor:
    """Return the mean of -log opacity over rays that see something move, because a moving edge is opaque.

    Args:
        opacity: (N,) of the rays.
        has_flow: (N,) whether the ray's pixel has optical flow.
    """
    return _mean(-opacity.clamp_min(_LEAST_LOG_OPACITY).log(), has_flow & (opacity >= _LEAST_OPACITY))


def depth_loss(depth: Tensor, opacity: Tensor, speed: Tensor, window: Tensor) -> Tensor:
    """Return the mean absolute difference of inverse depth and speed, because what is near moves fast in the image.

    That holds for a camera that is translated. Depth and speed have no common scale, so each is divided by its maximum
    over the rays of a window that count.

    Args:
        depth: (N,) of the rays.
        opacity: (N,) of the rays.
        speed: (N,) length of the optical flow, 0 where there is none.
        window: (N,) number of the ray's window, below N.
    """
    counts = (speed > 0) & (opacity >= _LEAST_OPACITY)
    relative = []
    for values in (1 / depth, speed):
        largest = torch.zeros_like(values).scatter_reduce(0, window, values * counts, "amax")
        relative.append(values / largest[window].clamp_min(1e-12))
    return _mean((relative[0] - relative[1]).abs(), counts)


def change_by_flow(values: Tensor, displacement: Tensor) -> Tensor:
    """Return the change of an image that is displaced, to first order: the negative product of gradient and flow.

    Args:
        values: (P, 2, 2) of the image in patches, rows first.
        displacement: (P, 2, 2, 2) of the patches' pixels along x and y, in pixels.

    Returns:
        (P, 2, 2) changes.
    """
    along_x = values.diff(dim=2).expand_as(values)
    along_y = values.diff(dim=1).expand_as(values)
    return -(along_x * displacement[..., 0] + along_y * displacement[..., 1])


def _mean(values: Tensor, counts: Tensor) -> Tensor:
    """Return the mean of those values that count, 0 if none does."""
    return torch.where(counts, values, 0.0).sum() / counts.sum().clamp_min(1)


@dataclass
class PAEv3DSupervisionConfig(SupervisionConfig):
    """PAEv3D's losses on patches in windows."""

    _target: type = field(default_factory=lambda: PAEv3DSupervision)


class PAEv3DSupervision(WindowSupervision):
    """Compares changes by their mean absolute error, and opacity, depth and gradients with the optical flow."""

    batch = "patches"

    def losses(self, outputs: Mapping[str, Any], batch: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return the absolute error of the changes, and while training the three priors, in units of C̄."""
        predicted, change = self._changes(outputs, batch)
        positive, negative = (_MOST_EVENTS * threshold for threshold in self.sensor_thresholds)
        losses = {"reconstruction_loss": F.l1_loss(predicted, change.clamp(-negative, positive))}
        if self.training:
            displacement = batch["displacement"]
            # The first half of the rays are the starts of the windows.
            weights = outputs["weights_list"][-1][: len(change)]
            depth = DepthRenderer("expected")(weights, outputs["ray_samples_list"][-1][: len(change)])[:, 0]
            opacity, speed = AccumulationRenderer()(weights)[:, 0], displacement.norm(dim=-1)
            start = outputs["log_radiance"][: len(change)]
            by_flow = torch.stack(
                [change_by_flow(one.view(-1, 2, 2), displacement.view(-1, 2, 2, 2)).flatten() for one in start.T], -1
            )
            losses["mask_loss"] = mask_loss(opacity, speed > 0)
            losses["depth_loss"] = depth_loss(depth, opacity, speed, batch["window"])
            losses["flow_loss"] = F.l1_loss(by_flow.gather(1, batch["channel"][:, None])[:, 0], change)
        return {name: loss / self.unit(outputs) for name, loss in losses.items()}


@dataclass
class PatchSamplerConfig(WindowSamplerConfig):
    """Windows of time, and in them patches of 2 x 2 pixels."""

    _target: type = field(default_factory=lambda: PatchSampler)
    longest_window: float = 0.01


class PatchSampler(WindowSampler):
    """Samples windows of time, and in each of them patches of 2 x 2 pixels by the number of their active pixels.

    The image is divided into patches that do not overlap. A pixel is active if its polarities do not add up to zero in
    the window. If no patch has some number of active pixels, patches of any number take its share.

    Optical flow is computed when a window is drawn for the first time in a stretch of events, and kept.

    Args:
        config: the options. ``share_of_all_pixels`` has no effect.
        dataset: the training data.
        supervision: a :class:`PAEv3DSupervision`.
        device: of the batches.

    Raises:
        DataError: an option is out of range, or no patch can be used.
    """

    batch = "patches"

    def __init__(
        self, config: PatchSamplerConfig, dataset: EventDataset, supervision: Supervision, device: torch.device | str
    ) -> None:
        super().__init__(config, dataset, supervision, device)
        usable = self._pixel_rays.usable
        height, width = usable.shape
        numbers = np.arange(height * width).reshape(height, width)[: height // 2 * 2, : width // 2 * 2]
        patches = numbers.reshape(height // 2, 2, width // 2, 2).swapaxes(1, 2).reshape(-1, 4)
        self._patches = patches[usable.ravel()[patches].all(1)]
        if len(self._patches) == 0:
            raise DataError("the lens model", "it gives no patch of 2 x 2 pixels a direction", "check its parameters")
        self._flows: dict[int, tuple[NDArray[np.float64], int]] = {}

    def _draw_pixels(self, counts: NDArray[np.int64], num_pixels: int) -> NDArray[np.int64]:
        """Return the numbers (N,) of pixels, patch by patch, given the events (2, pixels) of a window."""
        num_active = (counts[0] != counts[1])[self._patches].sum(1)
        # Whole patches for every number, which add up to all.
        ends = np.rint(np.cumsum(_SHARES) * (num_pixels // 4)).astype(int)
        drawn = []
        for number, share in enumerate(np.diff(ends, prepend=0)):
            chosen_from = np.flatnonzero(num_active == number)
            drawn.append(drawn_from(chosen_from if len(chosen_from) else np.arange(len(self._patches)), share))
        return self._patches[np.concatenate(drawn)].ravel()

    def sample(self, num_rays: int, training: bool = True) -> tuple[RayBundle, dict[str, Any]]:
        """Draw a batch of patches in windows.

        Args:
            num_rays: the most rays. A patch takes eight.
            training: has no effect.

        Returns:
            As :meth:`WindowSampler.sample` does, with the four pixels of a patch one after another, row by row. And for
            each pixel: the number (N,) of its ``window`` in the batch, and its ``displacement`` (N, 2) over the window
            by the optical flow, in pixels along x and y, 0 where the pixel has no events.
        """
        drawn = self._draw(num_rays // 2, 4)
        rays, batch = self._batch(drawn)
        window = np.repeat(np.arange(len(drawn)), [len(one.pixels) for one in drawn])
        displacement = np.concatenate([self._displacement(one) for one in drawn])
        batch["window"] = torch.from_numpy(window).to(self.device)
        batch["displacement"] = torch.from_numpy(displacement).to(self.device)
        return rays, batch

    def _displacement(self, drawn: DrawnWindow) -> NDArray[np.float32]:
        """Return the displacements (N, 2) of the pixels of a window."""
        velocities, side = self._flow(drawn.start)
        rows, columns = np.divmod(drawn.pixels, self._pixel_rays.usable.shape[1])
        moved = velocities[rows // side, columns // side] * ((drawn.end - drawn.start) * 1e-9)
        return (moved * drawn.counts.any(0)[:, None]).astype(np.float32)

    def _flow(self, time: int) -> tuple[NDArray[np.float64], int]:
        """Return the velocities of the tiles at a time, and the side of a tile."""
        # Imported lazily: every ns-* command imports this module, and numba is slow to import.
        from aenerf_ns.checking.optical_flow import optical_flow

        windows, (height, width) = self.dataset.windows, self._pixel_rays.usable.shape
        piece = next((first, last) for first, last in windows.pieces if first <= time <= last)
        first, at = np.searchsorted(windows.times, [piece[0], time])
        last = np.searchsorted(windows.times, piece[1], side="right")
        size = int(_FLOW_DENSITY * height * width)
        begin = int(max(min(at - (at - first) % size, last - size), first))
        if begin not in self._flows:
            self._flows[begin] = optical_flow(windows.stream(slice(begin, min(begin + size, last)), width))
        return self._flows[begin]
