"""How far the contrast thresholds of each pixel are from those of the sensor, from the events alone.

The thresholds of a real sensor's pixels differ. Where a pixel's C+ is too small beside its C−, positive events prevail,
however long the pixel watches: their surplus grows with the number of events. What the scene does to a pixel does not
grow, because radiance stays within bounds. So the surplus that a pixel gains with each event, its *drift*, tells of its
thresholds.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.events.pair_store import EventPairs
from aenerf_ns.events.pairing import pair_events, surplus_slopes
from aenerf_ns.events.stream import EventStream

# Of the numbers 1, 2, ..., 6 around their mean. Pixels with fewer events in a half say nothing of their own.
_MIN_SQUARES = 17.5
# Of the drift over the pixels: where a tenth is the standard deviation of thresholds, and where it is 3 %, which is
# less than sensors have.
_TYPICAL_VARIANCE, _MIN_VARIANCE = 0.005, 0.0004
# A pixel whose events are three quarters of one polarity is broken: how much thresholds differ is not asked of it.
_MAX_DRIFT = 0.5
# Fewer say too little of how much thresholds differ.
_MIN_PIXELS = 100
# Of a stream: they say enough of the pixels of any sensor, and take 1 GB of memory.
_MAX_EVENTS = 2**25


@dataclass(frozen=True)
class PolarityDrift:
    """The drift of each pixel.

    Attributes:
        drift: (height, width) float32, positive less negative events that a pixel gains with each event, less what
            pixels gain on average, shrunk to what is known. (C− − C+) / (C+ + C−) of the pixel.
        variance: (height, width) float32, of its error.
        spread: standard deviation of the drift over the pixels; half of the relative one of C+ / C−.
    """

    drift: NDArray[np.float32]
    variance: NDArray[np.float32]
    spread: float

    def summary(self) -> str:
        """Return one line that says how thresholds differ."""
        return (
            f"C+ / C- of the pixels differs by {2 * self.spread:.1%} (standard deviation), by the drift of their events"
        )

    def picture(self) -> NDArray[np.uint8]:
        """Draw the map: gray for a pixel like the others, black and white from three standard deviations of C+ / C−."""
        shown = np.clip(self.drift / max(3 * self.spread, 1e-6), -1, 1)
        return np.rint(127.5 - 127.5 * shown).astype(np.uint8)


def polarity_drift(pairs: EventPairs) -> PolarityDrift:
    """Estimate the drift of each pixel.

    The drift of a pixel is the slope of a line through its surplus over its number of events. The slopes in the first
    and in the second half of the events share the pixel's thresholds, and not what it saw: their covariance over the
    pixels is the variance of the drift. What neighbors share is left out of it, because it is of the scene.
    """
    shape = (pairs.height, pairs.width)
    num_rows = len(pairs) + pairs.num_first + pairs.num_within_refractory_period
    slopes, squares = surplus_slopes(pairs.rows[:num_rows], pairs.height * pairs.width)
    known = (squares[1:] >= _MIN_SQUARES).all(0)
    typical = known & (np.abs(slopes) < _MAX_DRIFT).all(0)
    if typical.sum() < _MIN_PIXELS:
        return PolarityDrift(np.zeros(shape, np.float32), np.zeros(shape, np.float32), 0.0)
    # The errors of the slopes, in squared thresholds of what was seen.
    error, *errors_of_halves = 1 / np.maximum(squares, _MIN_SQUARES)
    variance, seen = _TYPICAL_VARIANCE, 1.0
    for _ in range(20):
        # No pixel counts for many others, however many events it has.
        weight = typical / (max(variance, _TYPICAL_VARIANCE) + seen * sum(errors_of_halves)) ** 2
        weight /= weight.sum()
        whole, first, second = slopes - (slopes * weight).sum(1, keepdims=True)
        product, near = weight * first * second, weight * np.roll(weight, 1)
        shared = (near * (first * np.roll(second, 1) + second * np.roll(first, 1))).sum() / (2 * near.sum() or 1.0)
        # Two standard errors, so that equal thresholds are found equal.
        variance = max(product.sum() - shared - 2 * np.sqrt((product**2).sum()), 0.0)
        seen = max((weight * (first - second) ** 2).sum() / (weight * sum(errors_of_halves)).sum(), 1e-6)
    # Parts of the scene that are seen in both halves make a little of it.
    variance *= variance > _MIN_VARIANCE
    share = known * variance / (variance + seen * error)
    return PolarityDrift(
        drift=(share * whole).astype(np.float32).reshape(shape),
        variance=((1 - share) * variance).astype(np.float32).reshape(shape),
        spread=float(np.sqrt(variance)),
    )


def drift_of_events(chunks: Iterable[EventStream], refractory_period: int) -> NDArray[np.float32]:
    """Return the (height, width) drift of each pixel, from the first 34 million events of a stream.

    Args:
        chunks: the stream in pieces, in the order of time, all of one sensor, at least one event.
        refractory_period: of the sensor, in nanoseconds.
    """
    return polarity_drift(pair_events(_beginning(chunks), refractory_period=refractory_period)).drift


def _beginning(chunks: Iterable[EventStream]) -> Iterator[EventStream]:
    count = 0
    for chunk in chunks:
        yield chunk
        count += len(chunk)
        if count >= _MAX_EVENTS:
            return
