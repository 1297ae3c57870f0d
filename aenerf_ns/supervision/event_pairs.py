"""Supervision by pairs of events of a pixel (paper, eq. 4, 5, 11 and 12): how they are drawn and compared."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray
from torch import Tensor

from aenerf_ns.errors import DataError
from aenerf_ns.events.pair_store import (
    BLOCK,
    MAX_SPAN,
    EventPairs,
    chain_index,
    event_counts,
    is_pair,
    max_span,
    pixel_index,
)
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.supervision.base import Sampler, SamplerConfig, Supervision, SupervisionConfig
from aenerf_ns.supervision.losses import log_radiance_change, reconstruction_loss, silent_change, temporal_loss
from aenerf_ns.supervision.pixel_rays import PixelRays
from aenerf_ns.supervision.sensor_parameters import SensorParameters

# Share of a device's free memory that the table of pairs may take. The rest is for the model and its gradients.
_SHARE_OF_FREE_MEMORY = 0.5

# t_sam: a truncated normal distribution over the interval of the pair's last event.
_WITHIN_MEAN, _WITHIN_DEVIATION = 0.5, 0.25
# Share of the distribution before it is cut.
_WITHIN_MASS = math.erf(_WITHIN_MEAN / (_WITHIN_DEVIATION * math.sqrt(2)))


@dataclass
class PairSupervisionConfig(SupervisionConfig):
    """Pairs of events of a pixel."""

    _target: type = field(default_factory=lambda: PairSupervision)
    learn_contrast_threshold_ratio: bool = False
    """Learn C+ / C-, from the dataset's values. C- keeps the dataset's value."""
    learn_refractory_period: bool = False
    """Learn the time for which a pixel is blind after each event, from the dataset's value. It can be at most the
    shortest interval between two events of a pixel. All pairs are then of consecutive events."""


class PairSupervision(Supervision):
    """Compares the rendered change of log-radiance between the two times of a pair with the events between them.

    Args:
        config: what is learned of the sensor.
        sensor: see :class:`Supervision`.
        loss_coefficients: see :class:`Supervision`. Rates are rendered where ``temporal_loss`` has a weight above 0.
    """

    batch = "pairs"
    config: PairSupervisionConfig

    def __init__(
        self, config: PairSupervisionConfig, sensor: SensorModel, loss_coefficients: Mapping[str, float]
    ) -> None:
        super().__init__(config, sensor, loss_coefficients)
        self.sensor_parameters = SensorParameters(
            sensor, config.learn_contrast_threshold_ratio, config.learn_refractory_period
        )

    @property
    def needs_rates(self) -> bool:
        """Whether training batches hold a third ray for each pair, for the temporal loss."""
        return self.loss_coefficients.get("temporal_loss", 0) > 0

    def prepare(self, dataset: EventDataset) -> None:
        """Bound the refractory period, where it is learned, by the shortest interval between events of a pixel."""
        if self.config.learn_refractory_period:
            self.sensor_parameters.bound_refractory_period(dataset.pairs.shortest_interval)

    def place(self, rays: RayBundle) -> dict[str, Tensor]:
        """Move the starts of the intervals to the end of the learned refractory period, and return what is learned.

        Returns:
            ``positive_contrast_threshold`` and ``interval_change`` (seconds that intervals are longer than in the
            batch), scalars, each where it is learned.
        """
        learned: dict[str, Tensor] = {}
        ratio = self.sensor_parameters.contrast_threshold_ratio
        if ratio is not None:
            learned["positive_contrast_threshold"] = ratio * self.sensor.negative_contrast_threshold
        period = self.sensor_parameters.refractory_period
        if period is not None:
            assert rays.times is not None
            learned["interval_change"] = change = self.sensor.refractory_period * 1e-9 - period
            start, end, *within = rays.times.chunk(3 if self.training and self.needs_rates else 2)
            # t_sam keeps its place in the interval.
            within = [end - (end - t) * (1 + change / (end - start)) for t in within]
            rays.times = torch.cat([start - change, end, *within])
        return learned

    def num_rate_rays(self, num_rays: int) -> int:
        """Return the number of third rays: one for each pair."""
        return num_rays // 3 if self.needs_rates else 0

    def unit(self, outputs: Mapping[str, Any]) -> Tensor | float:
        """Return C̄, the mean of the two contrast thresholds."""
        return (self._positive_threshold(outputs) + self.sensor.negative_contrast_threshold) / 2

    def losses(self, outputs: Mapping[str, Any], batch: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return the reconstruction loss (eq. 11), and while training the temporal loss (eq. 12) where it is on."""
        predicted, change = self.changes(outputs, batch)
        silent = silent_change(
            predicted, change, self._positive_threshold(outputs), self.sensor.negative_contrast_threshold
        )
        target = torch.where(batch["ends_between_events"], silent, change)
        losses = {"reconstruction_loss": reconstruction_loss(predicted, target, self.unit(outputs))}
        if self.training and "log_radiance_rate" in outputs:
            rate = outputs["log_radiance_rate"].gather(1, batch["channel"][:, None])[:, 0]
            interval = batch["last_interval"] + outputs.get("interval_change", 0.0)
            last_change = self._change(outputs, batch["last_num_positive"], batch["last_num_negative"])
            losses["temporal_loss"] = temporal_loss(rate, last_change, interval)
        return losses

    def metrics(self, outputs: Mapping[str, Any], batch: Mapping[str, Any]) -> dict[str, Any]:
        """Return the share of the pairs whose rendered change has the sign of the events."""
        predicted, target = self.changes(outputs, batch)
        # Polarities that cancel have no sign. A change that is known to a threshold only may have either.
        signed = (target != 0) & ~batch["ends_between_events"]
        agreeing = (predicted.detach() * target > 0) & signed
        return {"polarity_agreement": agreeing.sum() / signed.sum().clamp_min(1)}

    def learned(self) -> dict[str, float]:
        """Return C+ / C- and the refractory period in nanoseconds, each where it is learned."""
        return self.sensor_parameters.learned()

    def changes(self, outputs: Mapping[str, Any], batch: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
        """Return the (N,) changes over a batch's intervals: as rendered in the pixel's channel, and as events tell."""
        start, end = outputs["log_radiance"].split(len(batch["channel"]))[:2]
        predicted = (end - start).gather(1, batch["channel"][:, None])[:, 0]
        return predicted, self._change(outputs, batch["num_positive"], batch["num_negative"])

    def _change(self, outputs: Mapping[str, Any], num_positive: Tensor, num_negative: Tensor) -> Tensor:
        """Return the (N,) changes of log-radiance that counts of events tell of."""
        return log_radiance_change(
            num_positive, num_negative, self._positive_threshold(outputs), self.sensor.negative_contrast_threshold
        )

    def _positive_threshold(self, outputs: Mapping[str, Any]) -> Tensor | float:
        """Return C+, learned or given."""
        return outputs.get("positive_contrast_threshold", self.sensor.positive_contrast_threshold)


@dataclass
class PairSamplerConfig(SamplerConfig):
    """Pairs of events of a pixel."""

    _target: type = field(default_factory=lambda: PairSampler)
    max_events_per_pair: int = 64
    """The most events of its pixel that a pair spans, up to 255. 1: consecutive events, as in the paper. Pairs are of
    consecutive events wherever the refractory period is more than a twentieth of the interval between two events."""
    share_to_moments: float = 0.25
    """Share of the pairs of a batch that end at a random moment at a random pixel, between two events. The others end
    at a random event. 0: all of them, as in the paper."""


class PairSampler(Sampler):
    """Samples pairs of events of a pixel and gives each pair its rays.

    A pair's later event is drawn uniformly, as in the paper. Events are where the edges are, so a pair may instead end
    at a uniform moment at a uniform pixel, between two events: since the first of the two, log-radiance has changed by
    less than a contrast threshold.

    How many events of its pixel a pair spans is drawn from 1 to ``max_events_per_pair`` with log-uniform probability:
    1 is the paper's pair of consecutive events (eq. 4). Consecutive events tell where an edge is, but little of how the
    edge compares with the rest of the scene: a change that is seen at a slightly wrong time is as large an error as the
    change itself. Over many events that error is a small part.

    A pair's interval is [earlier time + refractory period, time of the later event or of the moment]. A pixel records
    no event of what changes while it is blind, so a longer pair would miss that change: pairs reach back only over
    events beside which the refractory period is short. A learned refractory period needs pairs of consecutive events
    and none that end at moments, because the pixel may be blind at a moment.

    Draws from torch's global generator of the device that holds the pairs, which Nerfstudio seeds. That is the device
    of the batches if the pairs take at most half of the device's free memory. Otherwise the pairs stay in host memory,
    or in their file, and a step copies one pinned array to the device without waiting.

    Args:
        config: the options.
        dataset: the training data.
        supervision: tells whether rates are needed and whether the refractory period is learned.
        device: of the batches.

    Raises:
        DataError: an option is out of range.

    Attributes:
        max_events_per_pair: the most events that a pair spans.
        share_to_moments: share of the pairs of a batch that end at a moment.
        trajectory: the estimated trajectory, which times count from; on the device of the batches.
    """

    batch = "pairs"

    def __init__(
        self,
        config: PairSamplerConfig,
        dataset: EventDataset,
        supervision: PairSupervision,
        device: torch.device | str,
    ) -> None:
        super().__init__(config, dataset, supervision, device)
        if not 1 <= config.max_events_per_pair <= MAX_SPAN:
            raise DataError(
                "the sampler",
                f"max-events-per-pair is {config.max_events_per_pair}",
                f"give a number from 1 to {MAX_SPAN}",
            )
        if not 0 <= config.share_to_moments <= 1:
            raise DataError(
                "the sampler", f"share-to-moments is {config.share_to_moments}", "give a number from 0 to 1"
            )
        consecutive = supervision.config.learn_refractory_period
        self.max_events_per_pair = 1 if consecutive else config.max_events_per_pair
        self.share_to_moments = 0.0 if consecutive else config.share_to_moments
        self._needs_rates = supervision.needs_rates
        self.sensor = dataset.scene.sensor
        self._pixel_rays = PixelRays(dataset.scene, device)
        self.trajectory = self._pixel_rays.trajectory

    def prepare(self) -> None:
        """Read the events now rather than with the first batch.

        Raises:
            DataError: the events cannot be used.
        """
        _ = self._table

    @cached_property
    def _table(self) -> _PairTable:
        return _PairTable(self.dataset.pairs, self.device)

    def sample(self, num_rays: int, training: bool = True) -> tuple[RayBundle, dict[str, Any]]:
        """Draw a batch of pairs.

        Args:
            num_rays: the most rays. A pair takes two, or three when it is trained on and rates are needed.
            training: see :class:`Sampler`.

        Returns:
            The rays at the starts of the N intervals, then the rays at their ends, then those at t_sam if there are
            any: at a random time between the last two events of the pair, because over more events the mean rate tells
            little of a moment's. And for each pair: ``num_positive`` and ``num_negative`` (N,) counts of events after
            its earlier one up to its end, whether it ``ends_between_events`` (N,), its ``pixel`` (N,), counted row by
            row, and the ``channel`` (N,) of the pixel's filter. And of the event that it ends at, or that follows its
            end: ``last_num_positive`` and ``last_num_negative`` (N,) at its time and the ``last_interval`` (N,) in
            seconds from the event before.
        """
        with_time_within = training and self._needs_rates
        rays_per_pair = 3 if with_time_within else 2
        num_pairs = max(num_rays // rays_per_pair, 1)
        device = self._pixel_rays.channels.device
        num_to_moments = round(self.share_to_moments * num_pairs)
        rows = self._table.draw(num_to_moments, num_pairs - num_to_moments, self.max_events_per_pair)
        times, numbers = rows.permute(2, 1, 0)
        end = self.trajectory.seconds(times[0])
        last_start, start = self.trajectory.seconds(times[1:] + self.sensor.refractory_period)
        last_interval = end - last_start
        # Given the interval that it lies in, a uniform moment is uniform there.
        part = torch.rand(num_to_moments, dtype=torch.float64, device=device)
        end[:num_to_moments] = last_start[:num_to_moments] + part * last_interval[:num_to_moments]
        seconds = [start, end]
        if with_time_within:
            # From the distribution's inverse, because torch's own function waits for a GPU.
            within = torch.rand(num_pairs, dtype=torch.float64, device=device).mul_(2).sub_(1).mul_(_WITHIN_MASS)
            within.erfinv_().mul_(_WITHIN_DEVIATION * math.sqrt(2)).add_(_WITHIN_MEAN)
            seconds.append(last_start + within * last_interval)
        # From the pair's last event but one, and from its first event.
        last_count, count = torch.stack(event_counts(numbers[:1], numbers[1:])).float().unbind(1)
        # A pair that ends at a moment has not seen its last event.
        count[:, :num_to_moments] -= last_count[:, :num_to_moments]
        pixel = pixel_index(numbers[0])
        rays = self._pixel_rays.rays(pixel, seconds)
        batch = {
            "num_positive": count[0],
            "num_negative": count[1],
            "ends_between_events": torch.arange(num_pairs, device=device) < num_to_moments,
            "last_num_positive": last_count[0],
            "last_num_negative": last_count[1],
            "last_interval": last_interval.float(),
            "pixel": pixel,
            "channel": self._pixel_rays.channels.index_select(0, pixel),
        }
        return rays, batch


class _PairTable:
    """Draw pairs on the device that holds them.

    Args:
        pairs: all pairs.
        device: of the batches. It also holds the pairs, if they take at most half of its free memory.
    """

    def __init__(self, pairs: EventPairs, device: torch.device | str) -> None:
        self._batch_device = torch.device(device)
        arrays = (pairs.rows, pairs.replacement_rows, pairs.block_ends)
        size = sum(array.nbytes for array in arrays)
        self._device = self._batch_device if _fits(size, self._batch_device) else torch.device("cpu")
        if self._device != self._batch_device:
            CONSOLE.print(
                f"The pairs take {size / 1e9:.1f} GB, more than half of the GPU's free memory: they stay outside"
            )
        self._num_pairs = len(pairs)
        # Known here, because reading it from a GPU in a step would wait for the GPU.
        self._duration = int(pairs.block_ends[-1])
        self._find_rows: Callable[[Tensor, Tensor, Tensor], Tensor]
        if self._device.type == "cpu":
            self._find_rows = _CpuTable(*arrays).find_rows
        else:
            with warnings.catch_warnings():
                # Torch warns of rows that are mapped read-only. They are only copied.
                warnings.simplefilter("ignore", UserWarning)
                self._find_rows = partial(find_rows, *(torch.from_numpy(array).to(self._device) for array in arrays))

    def draw(self, num_moments: int, num_events: int, max_events: int) -> Tensor:
        """Draw pairs: first around uniform moments at uniform pixels, then pairs that end at uniform events.

        Args:
            num_moments: number of pairs around moments.
            num_events: number of pairs that end at events.
            max_events: the most events that a pair spans.

        Returns:
            (N, 3, 2) int64 rows of the table on the device of the batches: of the event that the pair ends with, of the
            event of its pixel before, and of the event that the pair begins with.
        """
        device = self._device
        moments = torch.randint(self._duration, (num_moments,), device=device)
        events = torch.randint(self._num_pairs, (num_events,), device=device)
        if max_events == 1:
            spans = torch.ones(num_moments + num_events, dtype=torch.int64, device=device)
        else:
            spans = (max_events + 1) ** torch.rand(num_moments + num_events, dtype=torch.float64, device=device)
            spans = spans.long().clamp_(max=max_events)
        rows = self._find_rows(moments, events, spans)
        if device != self._batch_device:
            rows = rows.pin_memory().to(self._batch_device, non_blocking=True)
        return rows


class _CpuTable:
    """Find rows as :func:`find_rows` does, in less time on a CPU.

    Args:
        arrays: the first three arguments of :func:`find_rows`.
    """

    def __init__(self, *arrays: NDArray[np.int64]) -> None:
        # Imported lazily: every ns-* command imports this module, and numba is slow to import.
        from aenerf_ns.events import pairing

        self._find = pairing.find_rows
        self._table = (*arrays, *pairing.near_blocks(arrays[2]))

    def find_rows(self, moments: Tensor, events: Tensor, spans: Tensor) -> Tensor:
        found = torch.empty((len(spans), 3, 2), dtype=torch.int64)
        self._find(*self._table, *(array.numpy() for array in (moments, events, spans, found)))
        return found


def find_rows(
    rows: Tensor, replacement_rows: Tensor, block_ends: Tensor, moments: Tensor, events: Tensor, spans: Tensor
) -> Tensor:
    """Find the rows of pairs in a table of pairs, without waiting for a GPU.

    Args:
        rows: see :class:`~aenerf_ns.events.pair_store.EventPairs`.
        replacement_rows: see there.
        block_ends: see there.
        moments: (M,) int64 nanoseconds along the intervals of all pairs, laid end to end. Each finds its pair.
        events: (N - M,) int64 numbers below the number of pairs. Each finds a pair of its own.
        spans: (N,) int64, how many consecutive pairs to join that end with the found one, if so many may be joined.

    Returns:
        (N, 3, 2) int64 rows: of the event that the pair ends with, of the event of its pixel before, and of the event
        that the pair begins with.
    """
    number = rows[:, 1][events]
    starts_chain = ~is_pair(number)
    by_event = torch.where(starts_chain, replacement_rows[torch.where(starts_chain, chain_index(number), 0)], events)
    block = torch.searchsorted(block_ends, moments, right=True) - 1
    time, number = rows.view(-1, BLOCK, 2)[block].unbind(-1)
    # From the block's end backwards, because the row before its first belongs to another block.
    elapsed = F.pad(time.diff().masked_fill_(~is_pair(number[:, 1:]), 0).cumsum(1), (1, 0))
    ends = block_ends[block + 1][:, None] - elapsed[:, -1:] + elapsed
    row = torch.cat([BLOCK * block + (ends <= moments[:, None]).sum(1), by_event])
    spans = spans.minimum(max_span(rows[:, 1][row]))
    return rows[torch.stack([row, row - 1, row - spans], 1)]


def _fits(size: int, device: torch.device) -> bool:
    """Return whether a table of so many bytes has a place on a device."""
    return device.type == "cpu" or size <= _SHARE_OF_FREE_MEMORY * torch.cuda.mem_get_info(device)[0]
