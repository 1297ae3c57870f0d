"""Pictures of events."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.events.stream import EventStream

# Display value of a pixel without events, and what one positive or negative event adds to it.
_GRAY = 118
_POSITIVE_STEP = np.array([90, -60, -90])
_NEGATIVE_STEP = np.array([-90, -60, 90])


def polarity_picture(
    x: NDArray[np.integer], y: NDArray[np.integer], polarity: NDArray[np.integer], width: int, height: int
) -> NDArray[np.uint8]:
    """Add up polarities over pixels, and draw pixels red where positive events prevail, blue where negative ones do.

    Args:
        x: (N,) pixel columns.
        y: (N,) pixel rows.
        polarity: (N,) signed number of events.
        width: number of pixel columns.
        height: number of pixel rows.

    Returns:
        (height, width, 3) uint8 display colors; gray where there are no events.
    """
    net = np.zeros((height, width), dtype=np.int64)
    np.add.at(net, (y, x), polarity)
    steps = np.abs(net)[..., None] * np.where(net[..., None] > 0, _POSITIVE_STEP, _NEGATIVE_STEP)
    return np.clip(_GRAY + steps, 0, 255).astype(np.uint8)


class PolaritySums:
    """Add up the polarities of the events nearest to some times, while a stream passes.

    Args:
        times: (M,) nanoseconds.
        num_events: events before each time that are added up, and as many from the time on.
    """

    def __init__(self, times: Sequence[int], num_events: int) -> None:
        self._times = times
        self._num_events = num_events
        self._before: list[list[EventStream]] = [[] for _ in times]
        self._after: list[list[EventStream]] = [[] for _ in times]

    def watch(self, chunks: Iterable[EventStream]) -> Iterator[EventStream]:
        """Yield the chunks of a stream, in the order of time, and keep the events near the times."""
        for chunk in chunks:
            for time, before, after in zip(self._times, self._before, self._after, strict=True):
                middle = int(np.searchsorted(chunk.t, time))
                # By indices, because a slice would keep the whole chunk in memory.
                if middle > 0:
                    before.append(chunk[np.arange(max(middle - self._num_events, 0), middle)])
                while len(before) > 1 and sum(map(len, before[1:])) >= self._num_events:
                    before.pop(0)
                lacking = self._num_events - sum(map(len, after))
                if lacking > 0 and middle < len(chunk):
                    after.append(chunk[np.arange(middle, min(middle + lacking, len(chunk)))])
            yield chunk

    def sums(self, height: int, width: int) -> NDArray[np.int16]:
        """Return the (M, height, width) sums of polarities, at most 32767."""
        sums = np.zeros((len(self._times), height, width), np.int64)
        for net, before, after in zip(sums, self._before, self._after, strict=True):
            if before:
                x, y, p = (np.concatenate([getattr(part, name) for part in before]) for name in "xyp")
                begin = max(len(p) - self._num_events, 0)
                np.add.at(net, (y[begin:], x[begin:]), p[begin:])
            for part in after:
                np.add.at(net, (part.y, part.x), part.p)
        return np.clip(sums, -(2**15) + 1, 2**15 - 1).astype(np.int16)
