"""Supervision by pairs of events of a pixel (paper, eq. 4, 5, 11 and 12): how they are drawn and compared."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
import torch.nn.functional as F
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn

from aenerf_ns.events.pair_store import MAX_SPAN, event_counts, is_pair, own_counts, pixel_index
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.supervision.base import (
    ChangeBatch,
    ChangeSupervision,
    LossCoefficients,
    Sampler,
    SamplerConfig,
    SupervisionConfig,
)
from aenerf_ns.supervision.losses import reconstruction_loss, temporal_loss
from aenerf_ns.supervision.pair_table import PairTable

# Variance of rendered changes, in squared contrast thresholds, around what a pixel whose thresholds are right tells.
_RENDERED_VARIANCE = 0.25
# Of what a blind pixel misses, in squared contrast thresholds, for each threshold that it is taken to miss.
_MISSED_VARIANCE = 0.25
# The most contrast thresholds that log-radiance is taken to be ahead of a slow pixel's signal.
_MAX_LAG = 4.0

# t_sam: a truncated normal distribution over the interval of the pair's last event.
_WITHIN_MEAN, _WITHIN_DEVIATION = 0.5, 0.25
# Share of the distribution before it is cut.
_WITHIN_MASS = math.erf(_WITHIN_MEAN / (_WITHIN_DEVIATION * math.sqrt(2)))


@dataclass
class PairBatch(ChangeBatch):
    """Pairs of events of a pixel, each of which may span several events.

    Counts of pairs may be fractional: they include what the pixel missed while it was blind.

    Rays at the starts of the intervals come first, then rays at their ends, then, if rates are needed, rays at t_sam: a
    random time between the last two events of the pair, because over more events the mean rate says little of a moment.

    Attributes:
        ends_between_events: (N,) whether a pair ends at a random moment before its last event, which is not counted.
        last_num_positive: (N,) float, positive events at the time of the last event.
        last_num_negative: (N,) float, negative events at the time of the last event.
        last_interval: (N,) float, seconds from the event before to the last event.
        pixel: (N,) pixels, counted row by row.
        drift: (N,) float, how much of the change that the events tell of is due to the pixel's thresholds, in units of
            the mean contrast threshold.
        weight: (N,) float, the variance of a rendered change over that of its difference from the events' change.
        start_rate: (N,) float, contrast thresholds that the pixel's signal rises by in a second at the first time.
        end_rate: (N,) float, the same at the second time.
    """

    ends_between_events: Tensor
    last_num_positive: Tensor
    last_num_negative: Tensor
    last_interval: Tensor
    pixel: Tensor
    drift: Tensor
    weight: Tensor
    start_rate: Tensor
    end_rate: Tensor


@dataclass
class PairLossCoefficients(LossCoefficients):
    """Weights of the losses on pairs of events (paper, eq. 14)."""

    temporal_loss: float = 0.0
    """Weight of the loss on rates of log-radiance (paper: beta, 0.001). 0 turns it off. On hash grids it has not been
    seen to help."""


@dataclass
class PairSupervisionConfig(SupervisionConfig):
    """Pairs of events of a pixel."""

    _target: type = field(default_factory=lambda: PairSupervision)
    learn_contrast_threshold_ratio: bool = False
    """Learn C+ / C-, from the dataset's values. C- keeps the dataset's value."""
    learn_refractory_period: bool = False
    """Learn the time for which a pixel is blind after each event, from the dataset's value. It can be at most the
    shortest interval between two events of a pixel. All pairs are then of consecutive events."""
    allow_for_bandwidth: bool = True
    """Allow for the lag of slow pixels, where the dataset states a bandwidth."""


class PairSupervision(ChangeSupervision):
    """Compares the rendered change of log-radiance between the two times of a pair with the events between them.

    Events leave the scale of log-radiance open, so of the contrast thresholds only the ratio C+ / C− can be learned. C−
    keeps the given value. The ratio is a softplus, so it is positive. The refractory period τ is a sigmoid times the
    shortest interval between two events of a pixel, because no refractory period can exceed that interval.

    Args:
        config: what is learned of the sensor.
        sensor: see :class:`Supervision`.
        loss_coefficients: weights of the losses. Rates are rendered where ``temporal_loss`` is above 0.
    """

    batch_type = PairBatch
    config: PairSupervisionConfig
    loss_coefficients: PairLossCoefficients

    def __init__(
        self, config: PairSupervisionConfig, sensor: SensorModel, loss_coefficients: PairLossCoefficients
    ) -> None:
        super().__init__(config, sensor, loss_coefficients)
        self.raw_ratio: nn.Parameter | None = None
        self.raw_refractory_period: nn.Parameter | None = None
        if config.learn_contrast_threshold_ratio:
            ratio = sensor.positive_contrast_threshold / sensor.negative_contrast_threshold
            # The inverse of softplus, exact for large ratios too.
            self.raw_ratio = nn.Parameter(torch.tensor(ratio + math.log(-math.expm1(-ratio))))
        if config.learn_refractory_period:
            self.raw_refractory_period = nn.Parameter(torch.tensor(0.0))
            # Kept in checkpoints, because events are read for training only.
            self._longest_refractory_period: Tensor = nn.Buffer(torch.tensor(torch.nan, dtype=torch.float64))

    @property
    def contrast_threshold_ratio(self) -> Tensor | None:
        """C+ / C−, a scalar with a gradient, or None where it is not learned."""
        return None if self.raw_ratio is None else F.softplus(self.raw_ratio)

    @property
    def refractory_period(self) -> Tensor | None:
        """τ in seconds, a float64 scalar with a gradient, or None where it is not learned."""
        if self.raw_refractory_period is None:
            return None
        return self._longest_refractory_period * torch.sigmoid(self.raw_refractory_period.double())

    @property
    def needs_rates(self) -> bool:
        """Whether training batches hold a third ray for each pair, for the temporal loss."""
        return self.loss_coefficients.temporal_loss > 0

    def prepare(self, dataset: EventDataset) -> None:
        """Bound the refractory period, where it is learned, by the shortest interval between events of a pixel.

        It starts at the sensor's value where that is positive, else at half of the bound.
        """
        if self.raw_refractory_period is not None:
            # Longer than the sensor's refractory period.
            shortest_interval = dataset.pairs.shortest_interval
            self._longest_refractory_period.fill_(shortest_interval * 1e-9)
            part = self.sensor.refractory_period / shortest_interval
            self.raw_refractory_period.data.fill_(math.log(part / (1 - part)) if part > 0 else 0.0)

    def shift_ray_times(self, rays: RayBundle) -> dict[str, Tensor]:
        """Move the starts of the intervals to the end of the learned refractory period, and return what is learned.

        Returns:
            ``positive_contrast_threshold`` and ``interval_change`` (seconds that intervals are longer than in the
            batch), scalars, each where it is learned.
        """
        learned: dict[str, Tensor] = {}
        ratio = self.contrast_threshold_ratio
        if ratio is not None:
            learned["positive_contrast_threshold"] = ratio * self.sensor.negative_contrast_threshold
        period = self.refractory_period
        if period is not None:
            learned["interval_change"] = change = self.sensor.refractory_period * 1e-9 - period
            start, end, *within = rays.times.chunk(3 if self.training and self.needs_rates else 2)
            # t_sam keeps its relative position in the interval.
            within = [end - (end - t) * (1 + change / (end - start)) for t in within]
            rays.times = torch.cat([start - change, end, *within])
        return learned

    def num_rate_rays(self, num_rays: int) -> int:
        """Return the number of third rays: one for each pair."""
        return num_rays // 3 if self.needs_rates else 0

    def thresholds(self, outputs: Mapping[str, Any]) -> tuple[Tensor | float, float]:
        """Return C+, learned or given, and C−."""
        positive = outputs.get("positive_contrast_threshold", self.sensor.positive_contrast_threshold)
        return positive, self.sensor.negative_contrast_threshold

    def changes(self, outputs: Mapping[str, Any], batch: PairBatch) -> tuple[Tensor, Tensor]:
        """Return the (N,) changes as rendered, and as the events say, less the drift and the lag of their pixels."""
        rendered, change = super().changes(outputs, batch)
        change = change - batch.drift * self.loss_unit(outputs)
        if self.uses_bandwidth:
            change = change + self._lag_change(outputs, batch)
        return rendered, change

    @property
    def uses_bandwidth(self) -> bool:
        """Whether the lag of slow pixels is allowed for, which takes the rates of their signals."""
        return self.config.allow_for_bandwidth and self.sensor.bandwidth > 0

    def _lag_change(self, outputs: Mapping[str, Any], batch: PairBatch) -> Tensor:
        """Return the (N,) changes of what log-radiance is ahead of the signals that fire events.

        The signal s follows log-radiance x through a low-pass filter of first order, ds/dt = (x − s) / T. So x is ahead
        by T ds/dt, and ds/dt is the rate at which events follow each other. The rendered radiance gives T.
        """
        positive, negative = self.thresholds(outputs)
        ends = outputs["log_radiance"].detach().split(len(batch))[:2]
        radiance = torch.stack([end.gather(1, batch.channel[:, None])[:, 0] for end in ends]).exp()
        # Pairs that end at a moment are uniform over pixels and time. Without such pairs all are taken.
        uniform = batch.ends_between_events | ~batch.ends_between_events.any()
        mean = (radiance[1] * uniform).sum() / uniform.sum()
        rates = torch.stack([batch.start_rate, batch.end_rate])
        # Noise right after a blindness has any rate.
        ahead = (rates * self.sensor.time_constant(radiance / mean)).clamp(-_MAX_LAG, _MAX_LAG)
        ahead = ahead * torch.where(rates > 0, positive, negative)
        return ahead[1] - ahead[0]

    def losses(self, outputs: Mapping[str, Any], batch: PairBatch) -> dict[str, Tensor]:
        """Return the reconstruction loss (eq. 11), and while training the temporal loss (eq. 12) where it is on."""
        rendered, change = self.changes(outputs, batch)
        positive, negative = self.thresholds(outputs)
        # Between two events a pixel's log-radiance is within a threshold of that at its last event.
        nearest = rendered.clamp(change - negative, change + positive).detach()
        target = torch.where(batch.ends_between_events, nearest, change)
        unit, weight = self.loss_unit(outputs), batch.weight
        if isinstance(unit, Tensor):
            # Silent pairs tell nothing of a learned threshold, but it would rise because their loss is divided by it.
            weight = torch.where(batch.ends_between_events, weight * (unit / unit.detach()).square(), weight)
        losses = {"reconstruction_loss": reconstruction_loss(rendered, target, unit, weight)}
        if self.training and "log_radiance_rate" in outputs:
            rate = outputs["log_radiance_rate"].gather(1, batch.channel[:, None])[:, 0]
            interval = batch.last_interval + outputs.get("interval_change", 0.0)
            last_change = batch.last_num_positive * positive - batch.last_num_negative * negative
            losses["temporal_loss"] = temporal_loss(rate, last_change, interval)
        return losses

    def has_sign(self, change: Tensor, batch: PairBatch) -> Tensor:
        """Return whether the signs of (N,) changes are known. A change known to a threshold only may have either."""
        return ((batch.num_positive - batch.num_negative).abs() >= 1) & ~batch.ends_between_events

    def learned_values(self) -> dict[str, float]:
        """Return C+ / C- and the refractory period in nanoseconds, each where it is learned."""
        values = {}
        if self.contrast_threshold_ratio is not None:
            values["contrast_threshold_ratio"] = self.contrast_threshold_ratio.item()
        if self.refractory_period is not None:
            values["refractory_period_ns"] = 1e9 * self.refractory_period.item()
        return values


@dataclass
class PairSamplerConfig(SamplerConfig):
    """Pairs of events of a pixel."""

    _target: type = field(default_factory=lambda: PairSampler)
    max_events_per_pair: int = 64
    """The most events of its pixel that a pair spans, up to 255. 1: consecutive events, as in the paper."""
    silent_pair_share: float = 0.25
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

    A pair of n events carries a difference of its pixel's thresholds n-fold. It is taken off as far as the events tell
    of it (:mod:`aenerf_ns.events.polarity_drift`), and pairs count less, the more is left of it.

    A pair's interval is [earlier time + refractory period, time of the later event or of the moment]. What a pixel
    misses while it is blind, between the two, is taken from the rates of events around it
    (:func:`~aenerf_ns.events.pair_store.event_counts`), and pairs count less, the more they miss. A learned refractory
    period needs pairs of consecutive events and none that end at moments, because the pixel may be blind at a moment.

    Draws from torch's global generator of the device that holds the pairs (:class:`.PairTable`), which Nerfstudio
    seeds.

    Args:
        config, dataset, device: see :class:`Sampler`.
        supervision: tells whether rates are needed and whether the refractory period is learned.

    Raises:
        DataError: an option is out of range.
    """

    batch_type = PairBatch

    def __init__(
        self, config: PairSamplerConfig, dataset: EventDataset, supervision: PairSupervision, device: torch.device | str
    ) -> None:
        super().__init__(config, dataset, supervision, device)
        self.require_between(1, MAX_SPAN, "max_events_per_pair")
        self.require_between(0, 1, "silent_pair_share")
        consecutive = supervision.config.learn_refractory_period
        self._max_events_per_pair = 1 if consecutive else config.max_events_per_pair
        self._silent_pair_share = 0.0 if consecutive else config.silent_pair_share
        self._needs_rates = supervision.needs_rates
        self._refractory_period = dataset.scene.sensor.refractory_period
        self._needs_signal_rates = supervision.uses_bandwidth

    def prepare(self) -> None:
        """See :meth:`Sampler.prepare`."""
        _ = self._table, self._drift

    @cached_property
    def _table(self) -> PairTable:
        return PairTable(self.dataset.pairs, self.device)

    @cached_property
    def _drift(self) -> tuple[Tensor, Tensor, float]:
        """Each pixel's drift, the variance of its error, and of drifts: none where all pairs are of one event."""
        device = self.pixel_rays.channels.device
        if self._max_events_per_pair == 1:
            nothing = torch.zeros(len(self.pixel_rays.channels), device=device)
            return nothing, nothing, 0.0
        found = self.dataset.polarity_drift
        if found.spread > 0:
            CONSOLE.print(f"{found.summary()}: pairs allow for it", soft_wrap=True)
        drift, variance = (torch.from_numpy(array.ravel()).to(device) for array in (found.drift, found.variance))
        return drift, variance, found.spread**2

    def sample(self, num_rays: int, training: bool = True) -> tuple[RayBundle, PairBatch]:
        """Draw pairs, which take two rays each, or three when trained on with rates; see :meth:`Sampler.sample`."""
        with_time_within = training and self._needs_rates
        num_pairs = max(num_rays // (3 if with_time_within else 2), 1)
        device = self.pixel_rays.channels.device
        num_silent = round(self._silent_pair_share * num_pairs)
        rows, spans = self._table.draw(num_silent, num_pairs - num_silent, self._max_events_per_pair)
        times, packed = rows.permute(3, 2, 1, 0)
        # Of the first event, of the event before the last one, and of the last one.
        first, before, last = packed[1, 0], packed[0, 1], packed[1, 1]
        seconds_of = self.pixel_rays.trajectory.seconds
        end = seconds_of(times[1, 1])
        start, last_start = seconds_of(torch.stack([times[1, 0], times[0, 1]]) + self._refractory_period)
        last_interval = end - last_start
        # Given the interval that it lies in, a uniform moment is uniform there.
        part = torch.rand(num_silent, dtype=torch.float64, device=device)
        end[:num_silent] = last_start[:num_silent] + part * last_interval[:num_silent]
        seconds = [start, end]
        if with_time_within:
            # From the distribution's inverse, because torch's own function waits for a GPU.
            within = torch.rand(num_pairs, dtype=torch.float64, device=device).mul_(2).sub_(1).mul_(_WITHIN_MASS)
            within.erfinv_().mul_(_WITHIN_DEVIATION * math.sqrt(2)).add_(_WITHIN_MEAN)
            seconds.append(last_start + within * last_interval)
        # The pair ends with its last event, so the change that the pixel misses after that event does not count.
        last_count = torch.stack(own_counts(last, before))
        count = torch.stack(event_counts(before, first))
        # Events that share a pixel and a time are rare where there is a refractory period.
        missed = count.sum(0) - (spans - 1) if self._refractory_period > 0 else 0.0
        # A pair that ends at a moment has not seen its last event.
        count[:, num_silent:] += last_count[:, num_silent:]
        start_rate = end_rate = torch.zeros(num_pairs, device=device)
        if self._needs_signal_rates:
            start_rate, end_rate = self._signal_rates(times, packed, num_silent)
        pixel = pixel_index(last)
        drift, variance, variance_of_all = self._drift
        num_events, surplus = count.sum(0), count[0] - count[1]
        # Thresholds that are both too large or too small make no drift, and differ between pixels as much.
        unknown = variance[pixel] * num_events**2 + variance_of_all * surplus**2 + _MISSED_VARIANCE * missed
        batch = PairBatch(
            num_positive=count[0],
            num_negative=count[1],
            channel=self.pixel_rays.channels.index_select(0, pixel),
            ends_between_events=torch.arange(num_pairs, device=device) < num_silent,
            last_num_positive=last_count[0],
            last_num_negative=last_count[1],
            last_interval=last_interval.float(),
            pixel=pixel,
            drift=drift[pixel] * num_events,
            weight=_RENDERED_VARIANCE / (_RENDERED_VARIANCE + unknown),
            start_rate=start_rate,
            end_rate=end_rate,
        )
        return self.pixel_rays.rays(pixel, seconds), batch

    def _signal_rates(self, times: Tensor, packed: Tensor, num_silent: int) -> tuple[Tensor, Tensor]:
        """Return the rates of the pixels' signals at the starts and at the ends of pairs.

        In an interval between two events the mean rate is known, without the time for which the pixel is blind. Rates
        lie on a line through the middles of the intervals before and after an event. Where only one of them is there,
        and at moments, the rate is that of the interval. A learned refractory period does not count.

        Args:
            times, packed: (3, 2, N) of the rows that :meth:`PairTable.draw` returns.
            num_silent: number of pairs that end at moments, which come first.

        Returns:
            (N,) thresholds a second at the starts, and at the ends.
        """
        is_interval = is_pair(packed[1:])
        positive, negative = own_counts(packed[1:], packed[:-1])
        intervals = times.diff(dim=0)
        rates = torch.where(is_interval, (positive - negative) / (intervals - self._refractory_period), 0) * 1e9
        # How far the pair's ends are from the middle of the interval before, doubled: a pair starts when the pixel is
        # no longer blind.
        beyond = intervals[0].double()
        beyond[0] += self._refractory_period
        beyond[1] -= self._refractory_period
        part = torch.where(is_interval.all(0), beyond / intervals.sum(0), is_interval[1].double())
        part[1, :num_silent] = 0
        start, end = torch.lerp(rates[0], rates[1], part.float())
        return start, end

    def residual_batch(self, num_rays: int) -> tuple[RayBundle, PairBatch]:
        """Draw a batch to look at, the same in every call, without the random numbers that training would draw next."""
        with torch.random.fork_rng([self.device] if torch.device(self.device).type == "cuda" else []):
            torch.manual_seed(0)
            return self.sample(num_rays, training=False)
