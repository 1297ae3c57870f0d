"""Statistics of a stream of events, in one pass and bounded memory."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.events.stream import EventStream

_NEVER = np.iinfo(np.int64).min
# Size of the sample of pairs. Every pair is kept until there are twice as many, then every second, every fourth ...
_MAX_PAIRS = 100_000


@dataclass(frozen=True)
class EventStatistics:
    """Counts over a stream.

    Attributes:
        counts: (height, width) int64 number of events of every pixel.
        num_positive: number of events of polarity +1.
        num_repeated: number of events that have the pixel and the time of an earlier event.
        rate: (N,) int64 number of events in each of N equal parts of the time span.
        pair_times: (M, 2) int64 times in nanoseconds of pairs of consecutive events of a pixel. The pairs are an even
            sample of all pairs.
        start: time of the first event in nanoseconds.
        end: time of the last event in nanoseconds.
    """

    counts: NDArray[np.int64]
    num_positive: int
    num_repeated: int
    rate: NDArray[np.int64]
    pair_times: NDArray[np.int64]
    start: int
    end: int

    @property
    def num_events(self) -> int:
        """Number of events in the stream."""
        return int(self.counts.sum())


def event_statistics(
    chunks: Iterable[EventStream], width: int, height: int, time_span: tuple[int, int], num_parts: int
) -> EventStatistics:
    """Read a stream to its end and count.

    Args:
        chunks: the stream in pieces, in the order of time.
        width, height: size of the sensor in pixels.
        time_span: times of the first and the last event in nanoseconds.
        num_parts: parts of the time span in which events are counted.
    """
    counts, last_time = np.zeros((height, width), np.int64), np.full((height, width), _NEVER)
    rate = np.zeros(num_parts, np.int64)
    sample, state = np.empty((2 * _MAX_PAIRS, 2), np.int64), np.array([0, 0, 1], np.int64)
    start, end = time_span
    num_positive = num_repeated = 0
    for chunk in chunks:
        num_positive += int((chunk.p > 0).sum())
        num_repeated += _count(chunk.x, chunk.y, chunk.t, counts, last_time, sample, state)
        # Integers are exact up to 292 years. Seconds since 1970 in float64 would put events into other parts.
        part = (chunk.t - start) // max(-(-(end - start + 1) // num_parts), 1)
        rate += np.bincount(part.clip(0, num_parts - 1), minlength=num_parts)
    pair_times = sample[: state[1]].copy()
    return EventStatistics(counts, num_positive, num_repeated, rate, pair_times, start, end)


@numba.njit(cache=True)
def _count(x, y, t, counts, last_time, sample, state):
    """Continue the counts with one chunk, and return the number of repeated events.

    ``state`` holds the number of pairs, the number of sampled pairs, and the step from one sampled pair to the next.
    """
    repeated = 0
    for i in range(t.shape[0]):
        pixel = y[i], x[i]
        counts[pixel] += 1
        previous = last_time[pixel]
        last_time[pixel] = t[i]
        if previous == t[i]:
            repeated += 1
        elif previous != _NEVER:
            if state[0] % state[2] == 0:
                if state[1] == sample.shape[0]:
                    state[1] //= 2
                    state[2] *= 2
                    sample[: state[1]] = sample[::2]
                sample[state[1]] = previous, t[i]
                state[1] += 1
            state[0] += 1
    return repeated
