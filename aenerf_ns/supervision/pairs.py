"""The event ray sampler: random pairs of events, as rays at both ends of their intervals."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray
from torch import Tensor, nn

from aenerf_ns.camera.lens import EventCamera
from aenerf_ns.camera.ray_tags import CAMERA_DIRECTIONS
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel

if TYPE_CHECKING:
    from aenerf_ns.events.pairs import EventPairs, PairsInTime

# A pair spans an event only where the intervals on its two sides are so many refractory periods long: at a steady rate,
# a twentieth of a contrast threshold goes unseen at most, which is less than thresholds are known to.
_INTERVAL_TO_REFRACTORY_PERIOD = 20

# t_sam: a truncated normal distribution over the interval of the pair's last event.
_WITHIN_MEAN, _WITHIN_DEVIATION = 0.5, 0.25


class EventRaySampler:
    """Samples pairs of events and gives each one's rays.

    A pair's later event is drawn uniformly, as in the paper. Events are where the edges are, so a pair may instead end
    at a uniform moment at a uniform pixel, between two events: since the first of them, log-radiance has changed by
    less than a contrast threshold.

    How many events of its pixel a pair spans is drawn from 1 to ``max_events_per_pair`` with log-uniform probability:
    1 is the paper's pair of consecutive events (eq. 4). Those say where there is an edge, but little of how it compares
    with the rest of the scene: a change that is seen at a slightly wrong time is as large an error as the change
    itself. Over many events it is a small part.

    A pair's interval is [earlier time + refractory period, time of the later event or of the moment]. What changes
    while a pixel is blind is in no event, and is missing within a longer pair: pairs reach back only over events beside
    which the refractory period is short.

    Draws from torch's global generator, which Nerfstudio seeds.

    Args:
        pairs: gives the pairs to sample from, which stay in host memory; asked when the first batch is drawn.
        camera: the lens, for the exact direction of each raw pixel.
        sensor: for the refractory period and the pixels' colour filters.
        trajectory: whose start times count from; on the device of the rays.
        num_rays_per_batch: rays of a batch; a pair takes two, or three with a time within its interval.
        max_events_per_pair: the most events that a pair spans.
        share_to_moments: part of the pairs of a batch that end at a moment.

    Attributes:
        max_events_per_pair: see above.
        share_to_moments: see above.
        with_time_within: whether batches for training have a third ray for each pair, for the temporal loss, at a
            random time t_sam between the last two of its events: over more, the mean rate tells little of a moment's.
    """

    def __init__(
        self,
        pairs: Callable[[], EventPairs],
        camera: EventCamera,
        sensor: SensorModel,
        trajectory: Trajectory,
        num_rays_per_batch: int,
        max_events_per_pair: int,
        share_to_moments: float,
    ) -> None:
        self.sensor = sensor
        self.trajectory = trajectory
        self.num_rays_per_batch = num_rays_per_batch
        self.max_events_per_pair = max_events_per_pair
        self.share_to_moments = share_to_moments
        directions, has_direction = camera.pixel_directions()
        if not has_direction.all():
            CONSOLE.print(
                f"[yellow]The lens model gives {(~has_direction).sum()} pixels no direction; their events are left out"
            )
        self.with_time_within = False
        self._has_direction = has_direction
        self._directions = torch.from_numpy(directions).to(trajectory.times.device)
        # Area of a pixel at distance one from the camera.
        self._pixel_area = 1 / (camera.fx * camera.fy)
        self._pairs = pairs

    def sample(self, num_pairs: int | None = None) -> tuple[RayBundle, dict[str, Any]]:
        """Draws a batch.

        Args:
            num_pairs: number of pairs to draw without a time within their intervals; by default as many as a batch
                for training holds.

        Returns:
            The rays at the starts of the N intervals, then those at their ends, then those at t_sam if there are any.
            They are in the camera's frame: pose correction moves them to the world by their ``times``, in float64
            seconds since the trajectory's start, and the ``camera_directions`` among their metadata, in float64. And
            for each pair ``num_positive`` and ``num_negative`` (N,) counts of events after its earlier one up to its
            end, whether it ``ends_between_events`` (N,), and the ``channel`` (N,) of its pixel's filter. And of the
            event that it ends at, or that follows its end: ``last_num_positive`` and ``last_num_negative`` (N,) at its
            time and the ``last_interval`` (N,) in seconds from the event before.
        """
        with_time_within = self.with_time_within and num_pairs is None
        rays_per_pair = 3 if with_time_within else 2
        num_pairs = num_pairs or max(self.num_rays_per_batch // rays_per_pair, 1)
        pairs, device = self._pairs(), self._directions.device
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
        """For pairs that end with the given ones, the pairs they begin with and their counts of events."""
        first = last.copy()
        num_positive, num_negative = (
            counts[last].astype(np.int64) for counts in (pairs.num_positive, pairs.num_negative)
        )
        if self.max_events_per_pair == 1:
            return first, num_positive, num_negative
        spans = (self.max_events_per_pair + 1) ** torch.rand(len(last), dtype=torch.float64).numpy()
        # The shortest are done after one round, so that few are left for the last.
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
        return self._pairs().predecessors(_INTERVAL_TO_REFRACTORY_PERIOD * self.sensor.refractory_period)

    @cached_property
    def _usable(self) -> NDArray[np.int64] | None:
        """Indices of the pairs whose pixel has a direction, or None when all have."""
        if self._has_direction.all():
            return None
        pairs = self._pairs()
        usable = np.flatnonzero(self._has_direction[pairs.y, pairs.x])
        if len(usable) == 0:
            raise DataError("the lens model", "no event lies on a pixel with a direction", "check the distortion")
        return usable

    def prepare(self) -> None:
        """Reads the events now rather than with the first batch.

        Raises:
            DataError: the events cannot be used.
        """
        _ = self._pairs(), self._usable
        if self.max_events_per_pair > 1:
            _ = self._predecessors
        if self.share_to_moments > 0:
            _ = self._in_time

    @cached_property
    def _in_time(self) -> PairsInTime:
        from aenerf_ns.events.pairs import PairsInTime

        return PairsInTime(self._pairs(), self._has_direction)

    def _draw(self, pairs: EventPairs, num_moments: int, num_events: int) -> NDArray[np.int64]:
        """Indices of usable pairs: first those around uniform moments at uniform pixels, then uniform ones."""
        count = len(pairs) if self._usable is None else len(self._usable)
        by_event = torch.randint(count, (num_events,)).numpy()
        if self._usable is not None:
            by_event = self._usable[by_event]
        if num_moments == 0:
            return by_event
        places = torch.rand(num_moments, dtype=torch.float64).numpy()
        return np.concatenate([self._in_time.at(places), by_event])
