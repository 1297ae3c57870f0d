"""How many events a pixel fires by itself."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.events.stream import EventStream

# Edges pass from pixel to pixel, in less than this many nanoseconds unless they are slow.
_QUIET_TIME = 50_000_000
# Of quiet neighbors, over all pixels. Less says nothing.
_MIN_SECONDS = 30


class NoiseRate:
    """Count the events of pixels whose eight neighbors have long been quiet, and measure how often neighbors are quiet.

    Noise does not depend on the neighbors, and edges come from them. Slow edges pass for noise, so the rate is a bound.
    """

    def __init__(self, width: int, height: int) -> None:
        self._last_time = np.zeros((height, width), np.int64)
        self._counts = np.zeros((height, width), np.int64)
        self._end: int | None = None
        self._quiet_time = 0.0

    def add(self, events: EventStream) -> None:
        """Add a piece of the stream of events."""
        if len(events) == 0:
            return
        if self._end is None:
            self._end = int(events.t[0])
            # Nobody knows when the pixels fired before the first event, so they count as not quiet.
            self._last_time += self._end
        self._quiet_time += _count_isolated(events.x, events.y, events.t, self._end, self._last_time, self._counts)
        self._end = int(events.t[-1])

    def rate(self, is_hot: NDArray[np.bool_]) -> float | None:
        """Return the largest number of events of noise that a pixel fires in a second, but for hot pixels (H, W).

        None if neighbors are hardly ever quiet.
        """
        count, seconds = self._counts[~is_hot].sum(), self._quiet_time * (~is_hot).sum() * 1e-9
        return None if seconds < _MIN_SECONDS else float(count / seconds)


@numba.njit(cache=True)
def _is_quiet(x, y, time, last_time):
    height, width = last_time.shape
    for row in range(max(y - 1, 0), min(y + 2, height)):
        for column in range(max(x - 1, 0), min(x + 2, width)):
            if (row != y or column != x) and time - last_time[row, column] <= _QUIET_TIME:
                return False
    return True


@numba.njit(cache=True)
def _count_isolated(x, y, t, end, last_time, counts):
    """Count the events with quiet neighbors, and return for how many nanoseconds those of a pixel are quiet on average.

    Between any two events one pixel is looked at.
    """
    height, width = last_time.shape
    quiet_time = 0.0
    for i in range(len(t)):
        pixel = i * 2654435761 % (height * width)
        if _is_quiet(pixel % width, pixel // width, (end + t[i]) // 2, last_time):
            quiet_time += t[i] - end
        if _is_quiet(np.int64(x[i]), np.int64(y[i]), t[i], last_time):
            counts[y[i], x[i]] += 1
        last_time[y[i], x[i]] = end = t[i]
    return quiet_time
