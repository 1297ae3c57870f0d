"""Images of events without a network: a high-pass filter that runs forwards and backwards."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.reconstruction.high_pass import HighPassFilter

_DECAY = 0.12
"""Share of a pixel's state that is forgotten while the picture gets one event per pixel. It does not depend on time, so
neither do the images on the camera's speed."""
# The backward filter starts this number of events per pixel after the image: e^-3 of what lies further is left.
_LOOK_AHEAD = 25.0
# Events per pixel by which an image shows the past. Light that has changed by less than a threshold has no event yet. A
# time in place of a number of events would depend on the camera's speed.
_LAG = 0.1
# Pixels: standard deviation of a Gaussian, and the percentiles of the picture that are shown black and white.
_BLUR, _PERCENTILES = 0.8, (1.0, 99.0)


def two_sided_images(batches: Iterable[EventStream], sensor: SensorModel) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield the time in nanoseconds and the (height, width) image of each batch of a stream: at its end, less a lag.

    A pixel's state adds up contrast thresholds, forwards up to the image and backwards, with reversed polarities, down
    to it; both forget with the number of events in the picture. Their mean has no ghosts of what was seen before.
    FIBAR (arXiv 2510.20071) is a published filter of the forward kind, with a decay in events and a blur where events
    are few.

    Args:
        batches: the stream in consecutive pieces, in the order of time, all of one sensor.
        sensor: the contrast thresholds.
    """
    held: list[tuple[EventStream, NDArray[np.float32]]] = []
    forward: _EventClock | None = None
    # The latest batches whose images wait for what follows: as many again are yielded at a time.
    num_ahead = 0
    for batch in batches:
        if forward is None:
            forward = _EventClock(batch.width, batch.height, sensor)
        forward.add(batch)
        held.append((batch, forward.state()))
        num_ahead = math.ceil(_LOOK_AHEAD * batch.width * batch.height / len(batch))
        if len(held) == 2 * num_ahead:
            yield from _finish(held, sensor)[:num_ahead]
            held = held[num_ahead:]
    yield from _finish(held, sensor)


def _finish(
    held: list[tuple[EventStream, NDArray[np.float32]]], sensor: SensorModel
) -> list[tuple[int, NDArray[np.uint8]]]:
    """Add the states of the backward filter to those of the forward filter, and return times and images."""
    images: list[tuple[int, NDArray[np.uint8]]] = []
    backward: _EventClock | None = None
    for batch, state in reversed(held):
        if backward is None:
            backward = _EventClock(batch.width, batch.height, sensor)
            both = state
        else:
            both = (state + backward.state()) / 2
        lag = round(_LAG * batch.width * batch.height)
        images.append((int(batch.t[max(len(batch) - 1 - lag, 0)]), _display(both)))
        backward.add(batch, reverse=True)
    return images[::-1]


def _display(state: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return (height, width) display values of log-intensities."""
    smooth = cv2.GaussianBlur(state, (0, 0), _BLUR)
    low, high = np.percentile(smooth, _PERCENTILES)
    return np.rint(np.clip((smooth - low) / max(high - low, 1e-9), 0, 1) * 255).astype(np.uint8)


class _EventClock:
    """The high-pass filter, whose time is the number of events in the picture: a nanosecond each."""

    def __init__(self, width: int, height: int, sensor: SensorModel) -> None:
        self._filter = HighPassFilter(width, height, sensor, 1e9 * _DECAY / (width * height), cutoff_per_event=0.0)
        self._count = 0

    def add(self, events: EventStream, reverse: bool = False) -> None:
        counts = np.arange(self._count, self._count + len(events))
        if reverse:
            # A rise of light is a fall backwards.
            self._filter.add(replace(events, x=events.x[::-1], y=events.y[::-1], t=counts, p=-events.p[::-1]))
        else:
            self._filter.add(replace(events, t=counts))
        self._count += len(events)

    def state(self) -> NDArray[np.float32]:
        return self._filter.log_intensity(self._count).astype(np.float32)
