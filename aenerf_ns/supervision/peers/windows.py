"""Supervision by windows of time, in which the events of a pixel are counted: EventNeRF's and Ev-NeRF's."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from nerfstudio.cameras.rays import RayBundle
from numpy.typing import NDArray
from torch import Tensor, nn

from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.supervision.base import Sampler, SamplerConfig, Supervision, SupervisionConfig
from aenerf_ns.supervision.losses import (
    dead_zone_excess,
    log_radiance_change,
    reconstruction_loss,
    threshold_bound_loss,
)
from aenerf_ns.supervision.pixel_rays import PixelRays

# Shares of the patches with 0, 1, 2, 3 and 4 active pixels, as PAEv3D draws them.
_PATCH_SHARES = np.array([5, 25, 25, 25, 176]) / 256
# The inverse of softplus at 1.
_RAW_ONE = math.log(math.expm1(1))


class WindowSupervision(Supervision):
    """Compares the rendered change of log-radiance over a window with the events of the pixel in the window.

    A window begins and ends anywhere between two events of a pixel. So the events tell the change only to within a
    contrast threshold at either end, which is why methods differ in how they compare the two.
    """

    batch = "windows"

    @property
    def sensor_thresholds(self) -> tuple[float, float]:
        """The sensor's C₊ and C₋."""
        return self.sensor.positive_contrast_threshold, self.sensor.negative_contrast_threshold

    def unit(self, outputs: Mapping[str, Any]) -> float:
        """Return C̄, the mean of the sensor's contrast thresholds, also where other thresholds are learned.

        With a learned unit, thresholds would rise only because every loss is divided by it.
        """
        return sum(self.sensor_thresholds) / 2

    def metrics(self, outputs: Mapping[str, Any], batch: Mapping[str, Any]) -> dict[str, Any]:
        """Return the share of the pixels whose rendered change has the sign of their events."""
        predicted, change = self._changes(outputs, batch)
        signed = change != 0
        agreeing = (predicted.detach() * change > 0) & signed
        return {"polarity_agreement": agreeing.sum() / signed.sum().clamp_min(1)}

    def _changes(self, outputs: Mapping[str, Any], batch: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
        """Return the (N,) changes over the windows: as rendered in the pixel's channel, and as the events tell."""
        start, end = outputs["log_radiance"].chunk(2)
        predicted = (end - start).gather(1, batch["channel"][:, None])[:, 0]
        thresholds = self._thresholds(outputs)
        return predicted, log_radiance_change(batch["num_positive"], batch["num_negative"], *thresholds)

    def _thresholds(self, outputs: Mapping[str, Any]) -> tuple[Tensor | float, Tensor | float]:
        """Return the changes of log-radiance that a positive and a negative event stand for, both positive."""
        return self.sensor_thresholds


@dataclass
class EventNeRFSupervisionConfig(SupervisionConfig):
    """EventNeRF's loss on windows."""

    _target: type = field(default_factory=lambda: EventNeRFSupervision)


class EventNeRFSupervision(WindowSupervision):
    """Compares changes by their mean squared error, as EventNeRF does (Rudnev et al., CVPR 2023)."""

    def losses(self, outputs: Mapping[str, Any], batch: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return the mean squared error of the changes, in units of C̄²."""
        return {"reconstruction_loss": reconstruction_loss(*self._changes(outputs, batch), self.unit(outputs))}


@dataclass
class EvNeRFSupervisionConfig(SupervisionConfig):
    """Ev-NeRF's loss on windows, with learned thresholds."""

    _target: type = field(default_factory=lambda: EvNeRFSupervision)


class EvNeRFSupervision(WindowSupervision):
    """Compares changes with a dead zone of one threshold, as Ev-NeRF does (Hwang et al., WACV 2023).

    The thresholds B₊ and B₋ are learned, one pair for the whole recording. They begin as the sensor's. The smaller they
    are, the smaller the changes that they ask for, down to a scene without contrast: a second loss holds them at the
    sensor's or above.
    """

    _least: Tensor

    def __init__(
        self, config: EvNeRFSupervisionConfig, sensor: SensorModel, loss_coefficients: Mapping[str, float]
    ) -> None:
        super().__init__(config, sensor, loss_coefficients)
        # Softplus keeps the thresholds positive.
        self.raw_factors = nn.Parameter(torch.full((2,), _RAW_ONE))
        self.register_buffer("_least", torch.tensor(self.sensor_thresholds), persistent=False)

    def place(self, rays: RayBundle) -> dict[str, Tensor]:
        """Return the ``thresholds`` (2,), of positive and of negative events. Rays stay in their places."""
        return {"thresholds": self._learned_thresholds()}

    def losses(self, outputs: Mapping[str, Any], batch: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return how far changes are outside the dead zone, and thresholds below the sensor's, in units of C̄."""
        thresholds = outputs["thresholds"]
        excess = dead_zone_excess(*self._changes(outputs, batch), *thresholds)
        return {
            "reconstruction_loss": excess.mean() / self.unit(outputs),
            "threshold_bound_loss": threshold_bound_loss(thresholds, self._least) / self.unit(outputs),
        }

    def learned(self) -> dict[str, float]:
        """Return B₊ and B₋, a positive number too."""
        positive, negative = self._learned_thresholds().tolist()
        return {"positive_threshold": positive, "negative_threshold": negative}

    def _thresholds(self, outputs: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
        positive, negative = outputs["thresholds"]
        return positive, negative

    def _learned_thresholds(self) -> Tensor:
        return F.softplus(self.raw_factors) * self._least


@dataclass
class WindowSamplerConfig(SamplerConfig):
    """Windows of time, in which the events of a pixel are counted."""

    _target: type = field(default_factory=lambda: WindowSampler)
    shortest_window: float = 0.0
    """Length of the shortest window, as a share of the intervals between the poses of the recording. It has at least
    one interval."""
    longest_window: float = 0.05
    """Length of the longest window, as a share of the intervals between the poses of the recording. A window has at
    least one interval. Lengths are drawn uniformly from the shortest to the longest."""
    share_of_all_pixels: float = 0.1
    """Share of the pixels of a window that are drawn from all pixels. The others are drawn from the pixels whose
    polarities do not add up to zero in the window."""
    pixels_per_window: int = 1024
    """Pixels that are drawn in a window. A batch has as many windows as it takes to fill it."""


@dataclass(frozen=True)
class DrawnWindow:
    """A window of time, and the pixels that were drawn in it.

    Attributes:
        start: nanoseconds.
        end: nanoseconds.
        pixels: (N,) numbers of the pixels.
        counts: (2, N) positive and negative events of the pixels.
    """

    start: int
    end: int
    pixels: NDArray[np.int64]
    counts: NDArray[np.int64]

    def rows(self) -> NDArray[np.int64]:
        """Return (5, N) of pixel, positive events, negative events, start and end."""
        return np.stack([self.pixels, *self.counts, *(np.full_like(self.pixels, t) for t in (self.start, self.end))])


class WindowSampler(Sampler):
    """Samples windows of time, and in each of them pixels with the events that the pixel had.

    A window begins and ends at poses, at the recording's ends or at the ends of pose gaps. It contains no gap. Its end
    is drawn uniformly, then its length, as far as there are poses before its end.

    Draws from torch's global generator of the CPU, which Nerfstudio seeds. Events stay in host memory, where they are
    counted.

    Args:
        config: the options.
        dataset: the training data.
        supervision: a :class:`WindowSupervision`.
        device: of the batches.

    Raises:
        DataError: an option is out of range.
    """

    batch = "windows"
    config: WindowSamplerConfig

    def __init__(
        self, config: WindowSamplerConfig, dataset: EventDataset, supervision: Supervision, device: torch.device | str
    ) -> None:
        super().__init__(config, dataset, supervision, device)
        for name in ("shortest_window", "longest_window", "share_of_all_pixels"):
            if not 0 <= getattr(config, name) <= 1:
                raise DataError(
                    "the sampler", f"{name.replace('_', '-')} is {getattr(config, name)}", "give a number from 0 to 1"
                )
        if config.shortest_window > config.longest_window:
            raise DataError(
                "the sampler",
                f"shortest-window is {config.shortest_window}, longest-window {config.longest_window}",
                "give a longest window that is no shorter",
            )
        if config.pixels_per_window < 1:
            raise DataError("the sampler", f"pixels-per-window is {config.pixels_per_window}", "give at least 1")
        self._pixel_rays = PixelRays(dataset.scene, device)
        self._usable = np.flatnonzero(self._pixel_rays.usable)

    def prepare(self) -> None:
        """Read the events now rather than with the first batch.

        Raises:
            DataError: the events cannot be used, or no two poses follow each other without a gap.
        """
        _ = self.dataset.windows, self._ends

    @cached_property
    def _ends(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Times at which windows may begin or end, and for each of them the number that begin or end before it.

        They are counted from the last gap on.
        """
        knots = self.dataset.scene.trajectory.times.numpy()
        pieces = [
            np.unique(np.r_[first, knots[(knots > first) & (knots < last)], last])
            for first, last in self.dataset.windows.pieces
        ]
        times, before = np.concatenate(pieces), np.concatenate([np.arange(len(piece)) for piece in pieces])
        if not before.any():
            raise DataError("the poses", "no two of them follow each other without a gap", "give --max-pose-gap-ns")
        return times, before

    def _draw_window(self) -> tuple[int, int]:
        """Return the two times of a window in nanoseconds."""
        times, before = self._ends
        possible = np.flatnonzero(before)
        end = possible[torch.randint(len(possible), ())]
        longest = max(round(self.config.longest_window * len(possible)), 1)
        shortest = max(round(self.config.shortest_window * len(possible)), 1)
        longest = min(longest, before[end])
        length = torch.randint(min(shortest, longest), longest + 1, ())
        return int(times[end - length]), int(times[end])

    def _draw_pixels(self, counts: NDArray[np.int64], num_pixels: int) -> NDArray[np.int64]:
        """Return the numbers (N,) of pixels, given the positive and negative events (2, pixels) of a window."""
        active = np.flatnonzero(counts[0] != counts[1])
        num_active = int(num_pixels * (1 - self.config.share_of_all_pixels)) if len(active) else 0
        return np.concatenate([_drawn_from(active, num_active), _drawn_from(self._usable, num_pixels - num_active)])

    def _draw(self, num_pixels: int, patch_size: int = 1) -> list[DrawnWindow]:
        """Return windows with their pixels: whole patches of ``patch_size`` pixels, at least one in all."""
        drawn = []
        num_windows = max(round(num_pixels / self.config.pixels_per_window), 1)
        for part in np.array_split(np.arange(max(num_pixels // patch_size, 1)), num_windows):
            start, end = self._draw_window()
            counts = self.dataset.windows.counts(start, end)
            pixels = self._draw_pixels(counts, patch_size * len(part))
            drawn.append(DrawnWindow(start, end, pixels, counts[:, pixels]))
        return drawn

    def _batch(self, drawn: Sequence[DrawnWindow]) -> tuple[RayBundle, dict[str, Any]]:
        """Return the rays of windows, and what the sensor recorded of them."""
        # In one piece, because every copy to a GPU takes its time.
        rows = torch.from_numpy(np.concatenate([one.rows() for one in drawn], 1)).to(self.device)
        pixel, positive, negative, *times = rows
        rays = self._pixel_rays.rays(pixel, [self._pixel_rays.trajectory.seconds(time) for time in times])
        batch = {
            "num_positive": positive.float(),
            "num_negative": negative.float(),
            "channel": self._pixel_rays.channels.index_select(0, pixel),
        }
        return rays, batch

    def sample(self, num_rays: int, training: bool = True) -> tuple[RayBundle, dict[str, Any]]:
        """Draw a batch of pixels in windows.

        Args:
            num_rays: the most rays. A pixel takes two.
            training: has no effect.

        Returns:
            The rays of the N pixels at the starts of their windows, then those at the ends. And for each pixel:
            ``num_positive`` and ``num_negative`` (N,) counts of events after the start up to the end, and the
            ``channel`` (N,) of its filter.
        """
        return self._batch(self._draw(num_rays // 2))


class PatchSampler(WindowSampler):
    """Samples windows of time, and in each of them patches of 2 x 2 pixels by the number of their active pixels.

    The image is divided into patches that do not overlap. A pixel is active if its polarities do not add up to zero in
    the window. If no patch has some number of active pixels, patches of any number take its share.

    Args:
        config: the options. ``share_of_all_pixels`` has no effect.
        dataset: the training data.
        supervision: a :class:`WindowSupervision`.
        device: of the batches.

    Raises:
        DataError: an option is out of range, or no patch can be used.
    """

    def __init__(
        self, config: WindowSamplerConfig, dataset: EventDataset, supervision: Supervision, device: torch.device | str
    ) -> None:
        super().__init__(config, dataset, supervision, device)
        usable = self._pixel_rays.usable
        height, width = usable.shape
        numbers = np.arange(height * width).reshape(height, width)[: height // 2 * 2, : width // 2 * 2]
        patches = numbers.reshape(height // 2, 2, width // 2, 2).swapaxes(1, 2).reshape(-1, 4)
        self._patches = patches[usable.ravel()[patches].all(1)]
        if len(self._patches) == 0:
            raise DataError("the lens model", "it gives no patch of 2 x 2 pixels a direction", "check its parameters")

    def _draw_pixels(self, counts: NDArray[np.int64], num_pixels: int) -> NDArray[np.int64]:
        """Return the numbers (N,) of pixels, patch by patch, given the events (2, pixels) of a window."""
        num_active = (counts[0] != counts[1])[self._patches].sum(1)
        # Whole patches for every number, which add up to all.
        ends = np.rint(np.cumsum(_PATCH_SHARES) * (num_pixels // 4)).astype(int)
        drawn = []
        for number, share in enumerate(np.diff(ends, prepend=0)):
            chosen_from = np.flatnonzero(num_active == number)
            drawn.append(_drawn_from(chosen_from if len(chosen_from) else np.arange(len(self._patches)), share))
        return self._patches[np.concatenate(drawn)].ravel()

    def _draw(self, num_pixels: int, patch_size: int = 4) -> list[DrawnWindow]:
        return super()._draw(num_pixels, patch_size)


def _drawn_from(numbers: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return (count,) of the numbers, drawn uniformly with replacement."""
    return numbers[torch.randint(max(len(numbers), 1), (count,)).numpy()]
