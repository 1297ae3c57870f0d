"""The ratio of the contrast thresholds, from the balance of the polarities."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.events.stream import EventStream
from aenerf_ns.files.event_reader import EventFile

# Parts of the recording at whose ends the balance is compared, and blocks along each side of the sensor.
_NUM_PARTS, _NUM_BLOCKS = 60, 8
_MIN_EVENTS = 2_000
# Share of the ratio by which thresholds that differ between pixels, and noise, may bias it.
_BIAS = 0.03


class PolarityBalance:
    """Weigh the polarities against each other.

    The light at a pixel does not keep rising or falling. So over a recording, C+ times the number of positive events is
    C− times the number of negative events. A pixel is blind for the refractory period after each event. While
    its brightness goes on to change, an event after an interval dt stands for dt / (dt − refractory period) thresholds.
    """

    def __init__(self, file: EventFile, refractory_period: int) -> None:
        self._refractory_period = refractory_period
        self._last_time = np.zeros((file.height, file.width), np.int64)
        self._last_polarity = np.zeros((file.height, file.width), np.int8)
        self._ends = np.linspace(*file.time_span(), _NUM_PARTS + 1).astype(np.int64)[1:-1]
        self._size = file.height, file.width
        # Thresholds by polarity, part and block.
        self._sums = np.zeros((2, _NUM_PARTS, _NUM_BLOCKS**2))

    def add(self, events: EventStream) -> NDArray[np.float64]:
        """Add a piece of the stream of events, and return for how many thresholds each event stands."""
        weights = _weigh(
            events.x, events.y, events.t, events.p, self._last_time, self._last_polarity, self._refractory_period
        )
        place = np.searchsorted(self._ends, events.t)
        for coordinates, side in zip((events.y, events.x), self._size, strict=True):
            place = place * _NUM_BLOCKS + coordinates.astype(np.int64) * _NUM_BLOCKS // side
        for sums, polarity in zip(self._sums, (1, -1), strict=True):
            sums += np.bincount(place, weights * (events.p == polarity), sums.size).reshape(sums.shape)
        return weights

    def ratio(self) -> tuple[float, float] | None:
        """Return C+ / C− and its uncertainty, or None if there are hardly any events.

        The brightness of what is seen at the end differs from that at the beginning about as it does in between, and in
        blocks of the sensor it differs independently. The uncertainty has three parts: twice the standard deviation of
        the balance over time, the root of the blocks' summed squares, and 3 % of the ratio for sensors' faults.
        """
        positive, negative = self._sums.sum(2).cumsum(1)
        if min(positive[-1], negative[-1]) < _MIN_EVENTS:
            return None
        ratio = negative[-1] / positive[-1]
        drift = 2 * (negative - ratio * positive).std() / positive[-1]
        of_blocks = np.linalg.norm(self._sums.sum(1).T @ [-ratio, 1]) / positive[-1]
        return float(ratio), float(np.linalg.norm([drift, of_blocks, _BIAS * ratio]))


@numba.njit(cache=True)
def _weigh(x, y, t, p, last_time, last_polarity, refractory_period):
    weights = np.ones(len(t))
    for i in range(len(t)):
        interval = t[i] - last_time[y[i], x[i]]
        if refractory_period > 0 and last_polarity[y[i], x[i]] == p[i]:
            # No event stands for more than two thresholds, however exactly the refractory period is known.
            weights[i] = interval / (interval - refractory_period) if interval > 2 * refractory_period else 2.0
        last_time[y[i], x[i]], last_polarity[y[i], x[i]] = t[i], p[i]
    return weights
