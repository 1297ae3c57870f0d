"""Supervision by windows of time, in which the events of a pixel are counted: EventNeRF's and Ev-NeRF's.

A window begins and ends anywhere between two events of a pixel. So the events give the change only to within a contrast
threshold at either end, which is why methods differ in how they compare the two.
"""

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
from aenerf_ns.supervision.base import (
    ChangeBatch,
    ChangeSupervision,
    LossCoefficients,
    Sampler,
    SamplerConfig,
    Supervision,
    SupervisionConfig,
)
from aenerf_ns.supervision.losses import reconstruction_loss

# The inverse of softplus at 1.
_RAW_ONE = math.log(math.expm1(1))


class EventNeRFSupervision(ChangeSupervision):
    """Compares changes by their mean squared error, as EventNeRF does (Rudnev et al., CVPR 2023)."""

    batch_type = ChangeBatch

    def losses(self, outputs: Mapping[str, Any], batch: ChangeBatch) -> dict[str, Tensor]:
        """Return the mean squared error of the changes, in units of C̄²."""
        return {"reconstruction_loss": reconstruction_loss(*self.changes(outputs, batch), self.loss_unit(outputs))}


@dataclass
class EvNeRFLossCoefficients(LossCoefficients):
    """Weights of Ev-NeRF's losses."""

    threshold_bound_loss: float = 1000.0
    """Weight of the loss that holds the learned thresholds at the sensor's or above."""


class EvNeRFSupervision(ChangeSupervision):
    """Compares changes with a dead zone of one threshold, as Ev-NeRF does (Hwang et al., WACV 2023).

    The thresholds B₊ and B₋ are learned, one pair for the whole recording. They begin as the sensor's. The smaller they
    are, the smaller the changes that they ask for, down to a scene without contrast: a second loss holds them at the
    sensor's or above.
    """

    batch_type = ChangeBatch

    def __init__(self, config: SupervisionConfig, sensor: SensorModel, loss_coefficients: LossCoefficients) -> None:
        super().__init__(config, sensor, loss_coefficients)
        # Softplus keeps the thresholds positive.
        self.raw_factors = nn.Parameter(torch.full((2,), _RAW_ONE))
        self._minimum: Tensor = nn.Buffer(torch.tensor(self.sensor_thresholds), persistent=False)

    def shift_ray_times(self, rays: RayBundle) -> dict[str, Tensor]:
        """Return the ``thresholds`` (2,), of positive and of negative events. Rays keep their times."""
        return {"thresholds": self._learned_thresholds()}

    def thresholds(self, outputs: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
        """Return the learned B₊ and B₋."""
        positive, negative = outputs["thresholds"]
        return positive, negative

    def loss_unit(self, outputs: Mapping[str, Any]) -> float:
        """Return the mean of the sensor's thresholds: learned ones would rise, because losses are divided by it."""
        return sum(self.sensor_thresholds) / 2

    def losses(self, outputs: Mapping[str, Any], batch: ChangeBatch) -> dict[str, Tensor]:
        """Return how far changes are outside the dead zone, and thresholds below the sensor's, in units of C̄."""
        thresholds = outputs["thresholds"]
        rendered, change = self.changes(outputs, batch)
        error = rendered - change
        excess = F.relu(error - thresholds[0]) + F.relu(-thresholds[1] - error)
        return {
            "reconstruction_loss": excess.mean() / self.loss_unit(outputs),
            "threshold_bound_loss": F.relu(self._minimum - thresholds).sum() / self.loss_unit(outputs),
        }

    def learned_values(self) -> dict[str, float]:
        """Return B₊ and B₋, a positive number too."""
        positive, negative = self._learned_thresholds().tolist()
        return {"positive_threshold": positive, "negative_threshold": negative}

    def _learned_thresholds(self) -> Tensor:
        return F.softplus(self.raw_factors) * self._minimum


@dataclass
class WindowSamplerConfig(SamplerConfig):
    """Windows of time, in which the events of a pixel are counted."""

    _target: type = field(default_factory=lambda: WindowSampler)
    shortest_window: float = 0.0
    """Length of the shortest window, as a share of the intervals between the poses of the recording. It has at least
    one interval."""
    longest_window: float = 0.1
    """Length of the longest window, as a share of the intervals between the poses of the recording. A window has at
    least one interval. Lengths are drawn uniformly from the shortest to the longest."""
    share_of_all_pixels: float = 0.1
    """Share of the pixels of a window that are drawn from all pixels. The others are drawn from the pixels whose
    polarities do not add up to zero in the window."""
    pixels_per_window: int = 1024
    """Pixels that are drawn in a window. A batch has as many windows as it takes to fill it."""


class WindowSampler(Sampler):
    """Samples windows of time, and in each of them pixels with the events that the pixel had.

    A window begins and ends at poses, at the recording's ends or at the ends of pose gaps. It contains no gap. Its end
    is drawn uniformly, then its length, as far as there are poses before its end.

    Draws from torch's global generator of the CPU, which Nerfstudio seeds. Events stay in host memory, where they are
    counted.

    Args:
        config, dataset, device: see :class:`Sampler`.
        supervision: compares a :class:`~aenerf_ns.supervision.base.ChangeBatch`.

    Raises:
        DataError: an option is out of range.
    """

    batch_type = ChangeBatch
    config: WindowSamplerConfig
    pixels_per_draw = 1
    """Pixels that are drawn together."""

    def __init__(
        self, config: WindowSamplerConfig, dataset: EventDataset, supervision: Supervision, device: torch.device | str
    ) -> None:
        super().__init__(config, dataset, supervision, device)
        self.require_between(0, 1, "shortest_window", "longest_window", "share_of_all_pixels")
        if config.shortest_window > config.longest_window:
            problem = f"shortest-window is {config.shortest_window}, longest-window {config.longest_window}"
            raise DataError("the sampler", problem, "give a longest window that is no shorter")
        if config.pixels_per_window < 1:
            raise DataError("the sampler", f"pixels-per-window is {config.pixels_per_window}", "give at least 1")
        self._usable = np.flatnonzero(self.pixel_rays.usable)

    def prepare(self) -> None:
        """See :meth:`Sampler.prepare`. It is an error, too, if no two poses follow each other without a gap."""
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

    def draw_pixels(self, counts: NDArray[np.int64], num_draws: int) -> NDArray[np.int64]:
        """Return the (N,) pixels of some draws, given the positive and negative events (2, pixels) of a window."""
        active = np.flatnonzero(counts[0] != counts[1])
        num_active = int(num_draws * (1 - self.config.share_of_all_pixels)) if len(active) else 0
        return np.concatenate([draw(active, num_active), draw(self._usable, num_draws - num_active)])

    def draw_windows(self, num_pixels: int) -> list[NDArray[np.int64]]:
        """Return windows with their pixels, ``num_pixels`` in all, or fewer if that is no whole number of draws.

        A window is (5, N): pixel, counted row by row, its positive and negative events, start and end in nanoseconds.
        """
        drawn = []
        num_draws = max(num_pixels // self.pixels_per_draw, 1)
        num_windows = min(max(round(num_pixels / self.config.pixels_per_window), 1), num_draws)
        for part in np.array_split(np.arange(num_draws), num_windows):
            start, end = self._draw_window()
            counts = self.dataset.windows.counts(start, end)
            pixels = self.draw_pixels(counts, len(part))
            times = (np.full_like(pixels, time) for time in (start, end))
            drawn.append(np.stack([pixels, *counts[:, pixels], *times]))
        return drawn

    def rays_and_batch(self, drawn: Sequence[NDArray[np.int64]]) -> tuple[RayBundle, ChangeBatch]:
        """Return the rays of windows, and what the sensor recorded of them."""
        # In one piece, because every copy to a GPU takes its time.
        rows = torch.from_numpy(np.concatenate(drawn, 1)).to(self.device)
        pixel, positive, negative, *times = rows
        rays = self.pixel_rays.rays(pixel, [self.pixel_rays.trajectory.seconds(time) for time in times])
        channel = self.pixel_rays.channels.index_select(0, pixel)
        return rays, ChangeBatch(positive.float(), negative.float(), channel)

    def sample(self, num_rays: int, training: bool = True) -> tuple[RayBundle, ChangeBatch]:
        """Draw pixels in windows, which take two rays each; see :meth:`Sampler.sample`."""
        return self.rays_and_batch(self.draw_windows(num_rays // 2))


def draw(values: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return (count,) of the values, drawn uniformly with replacement."""
    return values[torch.randint(max(len(values), 1), (count,)).numpy()]
