"""PAEv3D's supervision: patches in windows of time, and priors from the optical flow of the events.

J. Wang, J. He, Z. Zhang and R. Xu, *Physical Priors Augmented Event-Based 3D Reconstruction*, ICRA 2024. Its release is
Mercerai/PAEv3d, read at 97f6a2b. The release has no license, so nothing of it was copied. It differs from what is here:

- **Flow.** The release takes the flow from a network, and from random weights if the network's file is missing. Its
  README says that the paper's flow came from an optimization. Here it comes from this project's contrast maximization:
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
- **Windows** of the release are up to 10 pose intervals long. Here they are up to 0.1 of the recording's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.model_components.renderers import DepthRenderer
from numpy.typing import NDArray
from torch import Tensor

from aenerf_ns.errors import DataError
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.supervision.base import ChangeBatch, ChangeSupervision, LossCoefficients, Supervision
from aenerf_ns.supervision.peers.windows import WindowSampler, WindowSamplerConfig, draw

# Changes are cut at that of this many events.
_MAX_EVENTS = 5
# Rays of less opacity have no priors.
_MIN_OPACITY = 0.25
# Shares of the patches with 0, 1, 2, 3 and 4 active pixels.
_PATCH_SHARES = np.array([5, 25, 25, 25, 176]) / 256
# Events from which a flow is computed, as a share of the sensor's pixels. With half as many, edges of the benchmark's
# scenes move by three pixels only.
_FLOW_DENSITY = 2.0


def mask_loss(opacity: Tensor, has_flow: Tensor) -> Tensor:
    """Return the mean of -log opacity over rays that see something move, because a moving edge is opaque.

    Args:
        opacity: (N,) of the rays.
        has_flow: (N,) whether the ray's pixel has optical flow.
    """
    return _mean(-opacity.clamp_min(1e-3).log(), has_flow & (opacity >= _MIN_OPACITY))


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
    counts = (speed > 0) & (opacity >= _MIN_OPACITY)
    relative = []
    for values in (1 / depth, speed):
        largest = torch.zeros_like(values).scatter_reduce(0, window, values * counts, "amax")
        relative.append(values / largest[window].clamp_min(1e-12))
    return _mean((relative[0] - relative[1]).abs(), counts)


def change_by_flow(values: Tensor, displacement: Tensor) -> Tensor:
    """Return the change of an image that is displaced, to first order: the negative product of gradient and flow.

    Args:
        values: (P, 2, 2, channels) of the image in patches, rows first.
        displacement: (P, 2, 2, 2) of the patches' pixels along x and y, in pixels.

    Returns:
        (P, 2, 2, channels) changes.
    """
    return -(values.diff(dim=2) * displacement[..., :1] + values.diff(dim=1) * displacement[..., 1:])


def _mean(values: Tensor, counts: Tensor) -> Tensor:
    """Return the mean of those values that count, 0 if none does."""
    return torch.where(counts, values, 0.0).sum() / counts.sum().clamp_min(1)


@dataclass
class PatchBatch(ChangeBatch):
    """Patches of 2 x 2 pixels in windows of time: the four pixels of a patch one after another, row by row.

    Attributes:
        window: (N,) index of the pixel's window in the batch.
        displacement: (N, 2) float, displacement over the window by the optical flow, in pixels along x and y; 0 where
            the pixel has no events.
    """

    window: Tensor
    displacement: Tensor


@dataclass
class PAEv3DLossCoefficients(LossCoefficients):
    """Weights of PAEv3D's losses."""

    mask_loss: float = 1e-3
    """Weight of the prior that a moving edge is opaque."""
    flow_loss: float = 1e-2
    """Weight of the prior that the image's gradient and the flow give the change."""
    depth_loss: float = 1e-3
    """Weight of the prior that what is near moves fast."""


class PAEv3DSupervision(ChangeSupervision):
    """Compares changes by their mean absolute error, and opacity, depth and gradients with the optical flow."""

    batch_type = PatchBatch

    def losses(self, outputs: Mapping[str, Any], batch: PatchBatch) -> dict[str, Tensor]:
        """Return the absolute error of the changes, and while training the three priors, in units of C̄."""
        rendered, change = self.changes(outputs, batch)
        positive, negative = (_MAX_EVENTS * threshold for threshold in self.sensor_thresholds)
        losses = {"reconstruction_loss": F.l1_loss(rendered, change.clamp(-negative, positive))}
        if self.training:
            # The first half of the rays are the starts of the windows.
            weights = outputs["weights_list"][-1][: len(batch)]
            depth = DepthRenderer("expected")(weights, outputs["ray_samples_list"][-1][: len(batch)])[:, 0]
            opacity, speed = weights.sum(-2)[:, 0], batch.displacement.norm(dim=-1)
            start = outputs["log_radiance"][: len(batch)].unflatten(0, (-1, 2, 2))
            by_flow = change_by_flow(start, batch.displacement.unflatten(0, (-1, 2, 2))).flatten(0, 2)
            losses["mask_loss"] = mask_loss(opacity, speed > 0)
            losses["depth_loss"] = depth_loss(depth, opacity, speed, batch.window)
            losses["flow_loss"] = F.l1_loss(by_flow.gather(1, batch.channel[:, None])[:, 0], change)
        return {name: loss / self.loss_unit(outputs) for name, loss in losses.items()}


class FlowPatchSampler(WindowSampler):
    """Samples windows of time, and in each of them patches of 2 x 2 pixels by the number of their active pixels.

    The image is divided into patches that do not overlap. A pixel is active if its polarities do not add up to zero in
    the window. If no patch has some number of active pixels, patches of any number take its share.

    The optical flow of the events is computed when a window first begins in a stretch of events, and kept.

    Args:
        config: the options. ``share_of_all_pixels`` has no effect.
        dataset, device: see :class:`~aenerf_ns.supervision.base.Sampler`.
        supervision: a :class:`PAEv3DSupervision`.

    Raises:
        DataError: an option is out of range, or no patch can be used.
    """

    batch_type = PatchBatch  # type: ignore[assignment]
    pixels_per_draw = 4

    def __init__(
        self, config: WindowSamplerConfig, dataset: EventDataset, supervision: Supervision, device: torch.device | str
    ) -> None:
        super().__init__(config, dataset, supervision, device)
        # Velocities of the tiles and side of a tile, by the first event of a stretch and the one after its last.
        self._flows: dict[tuple[int, int], tuple[NDArray[np.float64], int]] = {}
        usable = self.pixel_rays.usable
        height, width = usable.shape
        pixels = np.arange(height * width).reshape(height, width)[: height // 2 * 2, : width // 2 * 2]
        patches = pixels.reshape(height // 2, 2, width // 2, 2).swapaxes(1, 2).reshape(-1, 4)
        self._patches = patches[usable.ravel()[patches].all(1)]
        if len(self._patches) == 0:
            raise DataError("the lens model", "it gives no patch of 2 x 2 pixels a direction", "check its parameters")

    def draw_pixels(self, counts: NDArray[np.int64], num_draws: int) -> NDArray[np.int64]:
        """Return the (N,) pixels of ``num_draws`` patches, given the events (2, pixels) of a window."""
        num_active = (counts[0] != counts[1])[self._patches].sum(1)
        # Whole patches for every number of active pixels, which add up to all.
        ends = np.rint(np.cumsum(_PATCH_SHARES) * num_draws).astype(int)
        drawn = []
        for number, share in enumerate(np.diff(ends, prepend=0)):
            candidates = np.flatnonzero(num_active == number)
            drawn.append(draw(candidates if len(candidates) else np.arange(len(self._patches)), share))
        return self._patches[np.concatenate(drawn)].ravel()

    def sample(self, num_rays: int, training: bool = True) -> tuple[RayBundle, PatchBatch]:
        """Draw patches in windows, which take eight rays each; see :meth:`Sampler.sample`."""
        drawn = self.draw_windows(num_rays // 2)
        rays, batch = self.rays_and_batch(drawn)
        window = np.repeat(np.arange(len(drawn)), [part.shape[1] for part in drawn])
        displacement = np.concatenate([self._displacement(part) for part in drawn])
        to_device = (torch.from_numpy(array).to(self.device) for array in (window, displacement))
        return rays, PatchBatch(*vars(batch).values(), *to_device)

    def _displacement(self, drawn: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the displacements (N, 2) of the pixels of a window (5, N)."""
        pixels, positive, negative, starts, ends = drawn
        velocities, side = self._flow(starts[0])
        rows, columns = np.divmod(pixels, self.pixel_rays.usable.shape[1])
        moved = velocities[rows // side, columns // side] * ((ends[0] - starts[0]) * 1e-9)
        return (moved * (positive + negative > 0)[:, None]).astype(np.float32)

    def _flow(self, time: int) -> tuple[NDArray[np.float64], int]:
        """Return the velocities of the tiles at a time, and the side of a tile."""
        # Imported lazily: every ns-* command imports this module, and numba is slow to import.
        from aenerf_ns.events.optical_flow import optical_flow

        windows, (height, width) = self.dataset.windows, self.pixel_rays.usable.shape
        piece = next((first, last) for first, last in windows.pieces if first <= time <= last)
        first, at = np.searchsorted(windows.times, [piece[0], time])
        last = np.searchsorted(windows.times, piece[1], side="right")
        size = int(_FLOW_DENSITY * height * width)
        begin = int(max(min(at - (at - first) % size, last - size), first))
        # Where the poses between two gaps have no events, the next ones' first stretch begins at the same index.
        stretch = begin, min(begin + size, int(last))
        if stretch not in self._flows:
            self._flows[stretch] = optical_flow(windows.events(slice(*stretch)))
        return self._flows[stretch]
