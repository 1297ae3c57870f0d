"""The asynchronous high-pass filter of events: a leaky integrator in every pixel (Scheerlinck et al., ACCV 2018)."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream

CUTOFF = 0.06
"""ω and ω_e of the authors' code, which calls them Hz and uses them as 1 / s."""

# Radiance of a pixel whose state is zero, as a share of display white: the photographers' middle gray.
_MIDDLE_GRAY = 0.18
# A state times this power is a display value. Then log-radiance is an exact multiple of the display value's logarithm.
_DISPLAY_POWER = 1 / 2.2


class HighPassFilter:
    """Add up the log-intensity changes that events stand for, and forget them with time.

    It is the complementary filter of Scheerlinck et al., "Continuous-time Intensity Estimation Using Event Cameras"
    (ACCV 2018), without frames. With C₊ or −C₋ for an event, its pixel's state s becomes

        s ← exp(−ω Δt − ω_e) s ± C

    with the time Δt since the pixel's event before. At a time t after a pixel's last event the state is
    s exp(−ω (t − t_last)). It begins as zero.

    Args:
        width: number of pixel columns.
        height: number of pixel rows.
        sensor: the contrast thresholds.
        cutoff: ω in 1 / s. It forgets what changes slowly, such as the wrong start and the drift of integration.
        cutoff_per_event: ω_e, the same for each event.
    """

    def __init__(
        self, width: int, height: int, sensor: SensorModel, cutoff: float = CUTOFF, cutoff_per_event: float = CUTOFF
    ) -> None:
        self._thresholds = sensor.positive_contrast_threshold, sensor.negative_contrast_threshold
        self._cutoffs = cutoff, cutoff_per_event
        self._state = np.zeros((height, width))
        self._last = np.zeros((height, width), np.int64)

    def add(self, events: EventStream) -> None:
        """Take the next events of the stream, in the order of time."""
        _integrate(self._state, self._last, events.x, events.y, events.t, events.p, *self._thresholds, *self._cutoffs)

    def log_intensity(self, time: int) -> NDArray[np.float64]:
        """Return the (height, width) states at a time in nanoseconds, not before the last event that was taken."""
        return self._state * np.exp(-self._cutoffs[0] * (time - self._last) * 1e-9)

    def image(self, events: EventStream) -> NDArray[np.uint8]:
        """Take the next events, and return the (height, width) display values at the last of them.

        A display value is (0.18 exp(s))^(1 / 2.2), clipped to [0, 1], times 255. The authors show 1.5 exp(s) − 1, which
        clips changes of more than 40 %.
        """
        self.add(events)
        radiance = _MIDDLE_GRAY * np.exp(self.log_intensity(int(events.t[-1])))
        return np.rint(np.clip(radiance, 0, 1) ** _DISPLAY_POWER * 255).astype(np.uint8)


@numba.njit(cache=True)
def _integrate(state, last, x, y, t, p, positive, negative, cutoff, cutoff_per_event):
    for event in range(len(t)):
        row, column = y[event], x[event]
        elapsed = (t[event] - last[row, column]) * 1e-9
        # A pixel's first event has no meaningful Δt, but the state before it is 0.
        kept = np.exp(-cutoff * elapsed - cutoff_per_event) * state[row, column]
        state[row, column] = kept + (positive if p[event] > 0 else -negative)
        last[row, column] = t[event]
