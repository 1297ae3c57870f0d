"""Supervision by pairs of events of a pixel (paper, eq. 4, 5, 11 and 12): how they are drawn and compared."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray
from torch import Tensor, nn

from aenerf_ns.camera.ray_tags import CAMERA_DIRECTIONS
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.supervision.base import Sampler, SamplerConfig, Supervision, SupervisionConfig
from aenerf_ns.supervision.losses import log_radiance_change, reconstruction_loss, silent_change, temporal_loss
from aenerf_ns.supervision.sensor_parameters import SensorParameters

if TYPE_CHECKING:
    from aenerf_ns.events.pairs import EventPairs, PairsInTime

# A pair spans an event only where the intervals on both sides of it are so many refractory periods long. At a steady
# rate, at most a twentieth of a contrast threshold then goes unseen, which is less than thresholds are known to.
_INTERVAL_TO_REFRACTORY_PERIOD = 20

# t_sam: a truncated normal distribution over the interval of the pair's last event.
_WITHIN_MEAN, _WITHIN_DEVIATION = 0.5, 0.25


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
        predicted, change = self._changes(outputs, batch)
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
        predicted, target = self._changes(outputs, batch)
        # Polarities that cancel have no sign. A change that is known to a threshold only may have either.
        signed = (target != 0) & ~batch["ends_between_events"]
        agreeing = (predicted.detach() * target > 0) & signed
        return {"polarity_agreement": agreeing.sum() / signed.sum().clamp_min(1)}

    def learned(self) -> dict[str, float]:
        """Return C+ / C- and the refractory period in nanoseconds, each where it is learned."""
        return self.sensor_parameters.learned()

    def _changes(self, outputs: Mapping[str, Any], batch: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
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
    """The most events of its pixel that a pair spans. 1: consecutive events, as in the paper. Pairs are of consecutive
    events wherever the refractory period is more than a twentieth of the interval between two events."""
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

    Draws from torch's global generator, which Nerfstudio seeds.

    Args:
        config: the options.
        dataset: the training data, whose pairs stay in host memory.
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
        if config.max_events_per_pair < 1:
            raise DataError("the sampler", f"max-events-per-pair is {config.max_events_per_pair}", "give 1 or more")
        if not 0 <= config.share_to_moments <= 1:
            raise DataError(
                "the sampler", f"share-to-moments is {config.share_to_moments}", "give a number from 0 to 1"
            )
        consecutive = supervision.config.learn_refractory_period
        self.max_events_per_pair = 1 if consecutive else config.max_events_per_pair
        self.share_to_moments = 0.0 if consecutive else config.share_to_moments
        self._needs_rates = supervision.needs_rates
        scene = dataset.scene
        self.sensor = scene.sensor
        self.trajectory = deepcopy(scene.trajectory).to(device)
        directions, has_direction = scene.event_camera.pixel_directions()
        if not has_direction.all():
            CONSOLE.print(
                f"[yellow]The lens model gives {(~has_direction).sum()} pixels no direction; their events are left out"
            )
        self._has_direction = has_direction
        self._directions = torch.from_numpy(directions).to(device)
        # Area of a pixel at distance one from the camera.
        self._pixel_area = 1 / (scene.event_camera.fx * scene.event_camera.fy)

    def prepare(self) -> None:
        """Read and link the events now rather than with the first batch.

        Raises:
            DataError: the events cannot be used.
        """
        _ = self.dataset.pairs, self._usable
        if self.max_events_per_pair > 1:
            _ = self._predecessors
        if self.share_to_moments > 0:
            _ = self._in_time

    def sample(self, num_rays: int, training: bool = True) -> tuple[RayBundle, dict[str, Any]]:
        """Draw a batch of pairs.

        Args:
            num_rays: the most rays. A pair takes two, or three when it is trained on and rates are needed.
            training: see :class:`Sampler`.

        Returns:
            The rays at the starts of the N intervals, then the rays at their ends, then those at t_sam if there are
            any: at a random time between the last two events of the pair, because over more events the mean rate tells
            little of a moment's. And for each pair: ``num_positive`` and ``num_negative`` (N,) counts of events after
            its earlier one up to its end, whether it ``ends_between_events`` (N,), and the ``channel`` (N,) of its
            pixel's filter. And of the event that it ends at, or that follows its end: ``last_num_positive`` and
            ``last_num_negative`` (N,) at its time and the ``last_interval`` (N,) in seconds from the event before.
        """
        with_time_within = training and self._needs_rates
        rays_per_pair = 3 if with_time_within else 2
        num_pairs = max(num_rays // rays_per_pair, 1)
        pairs, device = self.dataset.pairs, self._directions.device
        num_to_moments = round(self.share_to_moments * num_pairs)
        index = self._draw(pairs, num_to_moments, num_pairs - num_to_moments)
        x, y = pairs.x[index].astype(np.int64), pairs.y[index].astype(np.int64)
        first, num_positive, num_negative = self._extend(pairs, index)
        end, start, last_start = (
            self.trajectory.seconds(torch.from_numpy(t).to(device))
            for t in (
                pairs.time[index],
                pairs.previous_time[first] + self.sensor.refractory_period,
                pairs.previous_time[index] + self.sensor.refractory_period,
            )
        )
        last_interval = end - last_start
        to_moments = slice(num_to_moments)
        # Given the interval that it lies in, a uniform moment is uniform there.
        part = torch.rand(num_to_moments, dtype=torch.float64).to(device)
        end[to_moments] = last_start[to_moments] + part * last_interval[to_moments]
        num_positive[to_moments] -= pairs.num_positive[index[to_moments]]
        num_negative[to_moments] -= pairs.num_negative[index[to_moments]]
        times = [start, end]
        if with_time_within:
            within = torch.empty(num_pairs, dtype=torch.float64)
            nn.init.trunc_normal_(within, mean=_WITHIN_MEAN, std=_WITHIN_DEVIATION, a=0.0, b=1.0)
            times.append(last_start + within.to(device) * last_interval)
        seconds = torch.cat(times)

        def as_float(counts: NDArray) -> Tensor:
            return torch.from_numpy(counts.astype(np.float32)).to(device)

        rows, columns = torch.from_numpy(y).to(device), torch.from_numpy(x).to(device)
        in_camera = self._directions[rows, columns].repeat(rays_per_pair, 1)
        rays = RayBundle(
            origins=torch.zeros_like(in_camera).float(),
            directions=in_camera.float(),
            pixel_area=torch.full((len(seconds), 1), self._pixel_area, device=device),
            camera_indices=torch.zeros((len(seconds), 1), dtype=torch.long, device=device),
            times=seconds[:, None],
            metadata={CAMERA_DIRECTIONS: in_camera},
        )
        batch = {
            "num_positive": as_float(num_positive),
            "num_negative": as_float(num_negative),
            "ends_between_events": torch.arange(num_pairs, device=device) < num_to_moments,
            "last_num_positive": as_float(pairs.num_positive[index]),
            "last_num_negative": as_float(pairs.num_negative[index]),
            "last_interval": last_interval.float(),
            "channel": torch.from_numpy(self.sensor.channel(x, y)).to(device),
        }
        return rays, batch

    def _extend(
        self, pairs: EventPairs, last: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Return the pairs that the drawn ones begin with, and their counts of positive and negative events.

        Args:
            pairs: all pairs.
            last: (N,) indices of the pairs that the drawn ones end with.
        """
        first = last.copy()
        num_positive, num_negative = (
            counts[last].astype(np.int64) for counts in (pairs.num_positive, pairs.num_negative)
        )
        if self.max_events_per_pair == 1:
            return first, num_positive, num_negative
        spans = (self.max_events_per_pair + 1) ** torch.rand(len(last), dtype=torch.float64).numpy()
        # Each round goes on with the pairs that span more events: few are left for the last round.
        going = np.arange(len(last))
        for length in range(2, self.max_events_per_pair + 1):
            going = going[spans[going] >= length]
            earlier = self._predecessors[first[going]]
            going, earlier = going[earlier >= 0], earlier[earlier >= 0]
            first[going] = earlier
            num_positive[going] += pairs.num_positive[earlier]
            num_negative[going] += pairs.num_negative[earlier]
        return first, num_positive, num_negative

    @cached_property
    def _predecessors(self) -> NDArray[np.int32] | NDArray[np.int64]:
        return self.dataset.pairs.predecessors(_INTERVAL_TO_REFRACTORY_PERIOD * self.sensor.refractory_period)

    @cached_property
    def _usable(self) -> NDArray[np.int64] | None:
        """The indices of the pairs whose pixel has a direction, or None when all have."""
        if self._has_direction.all():
            return None
        pairs = self.dataset.pairs
        usable = np.flatnonzero(self._has_direction[pairs.y, pairs.x])
        if len(usable) == 0:
            raise DataError("the lens model", "no event lies on a pixel with a direction", "check the distortion")
        return usable

    @cached_property
    def _in_time(self) -> PairsInTime:
        from aenerf_ns.events.pairs import PairsInTime

        return PairsInTime(self.dataset.pairs, self._has_direction)

    def _draw(self, pairs: EventPairs, num_moments: int, num_events: int) -> NDArray[np.int64]:
        """Return indices of usable pairs: first pairs around uniform moments at uniform pixels, then uniform pairs."""
        count = len(pairs) if self._usable is None else len(self._usable)
        by_event = torch.randint(count, (num_events,)).numpy()
        if self._usable is not None:
            by_event = self._usable[by_event]
        if num_moments == 0:
            return by_event
        places = torch.rand(num_moments, dtype=torch.float64).numpy()
        return np.concatenate([self._in_time.at(places), by_event])
