"""Events between the frames of a video: as they were recorded, and as a rendering triggers them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventFile
from aenerf_ns.progress import tracked


def sum_recorded_events(events: EventFile, times: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Yield the (height, width) sums of polarities between each two of (N,) times in nanoseconds, the earlier included.

    The events are read once, in pieces.
    """
    shape = (events.height, events.width)
    net = np.zeros(shape, np.int64)
    index, last = 0, len(times) - 1
    for chunk in tracked(events.chunks(), f"Reading {events.path.name}", events.count()):
        edges = np.searchsorted(chunk.t, times)
        while index < last:
            inside = slice(edges[index], edges[index + 1])
            np.add.at(net, (chunk.y[inside], chunk.x[inside]), chunk.p[inside])
            if inside.stop == len(chunk):
                # The next chunk may continue this interval.
                break
            yield net
            net = np.zeros(shape, np.int64)
            index += 1
        if index == last:
            return
    for _ in range(index, last):
        yield net
        net = np.zeros(shape, np.int64)


class RenderedEvents:
    """Trigger events of consecutive renderings as the sensor does (paper, eq. 5), but without a refractory period."""

    def __init__(self, sensor: SensorModel, width: int, height: int) -> None:
        self._sensor = sensor
        rows, columns = np.divmod(np.arange(width * height), width)
        self._channel = sensor.channel(columns, rows).reshape(height, width, 1)
        self._reference: NDArray[np.float64] | None = None

    def __call__(self, log_radiance: NDArray[np.floating]) -> NDArray[np.int64]:
        """Return the (height, width) sums of polarities since the call before; none at the first call.

        ``log_radiance`` is (height, width, channels).
        """
        seen = np.take_along_axis(log_radiance.astype(np.float64), self._channel, -1)[..., 0]
        if self._reference is None:
            self._reference = seen
        change = seen - self._reference
        sensor = self._sensor
        threshold = np.where(change > 0, sensor.positive_contrast_threshold, sensor.negative_contrast_threshold)
        count = np.trunc(change / threshold)
        self._reference = self._reference + count * threshold
        return count.astype(np.int64)
