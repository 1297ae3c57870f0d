"""Log-intensity from events without a network: a high-pass filter that runs forwards and backwards."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial

import numba
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream

# The backward filter starts about this number of events per pixel after the image, but at most this number of images.
# More costs memory and improves little.
_LOOK_AHEAD, _MAX_IMAGES_AHEAD = 25.0, 200
# Events per pixel by which an image shows the past. Light that has changed by less than a threshold has no event yet. A
# time in place of a number of events would depend on the camera's speed.
_LAG = 0.1


def log_intensities(
    batches: Iterable[EventStream], sensor: SensorModel, decay: float, drift: NDArray[np.float32] | None = None
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Yield for each batch of a stream the time in nanoseconds, its end less a lag, and the (height, width) changes of
    log-intensity that the picture shows.

    A pixel's state adds up contrast thresholds, forwards up to the image and backwards, with reversed polarities, down
    to it; both forget with the number of events in the picture. Their mean weighs each direction by how much it has
    seen. It has no ghosts of what was seen before. FIBAR (arXiv 2510.20071) is a published filter of the forward kind,
    with a decay in events and a blur where events are few.

    A pixel is blind for the refractory period τ after an event. Where an event of the same polarity follows after an
    interval dt, the pixel is taken to have missed τ / (dt − τ) thresholds, at most 7/8.

    Args:
        batches: the stream in consecutive pieces, in the order of time, all of one sensor.
        sensor: the contrast thresholds and the refractory period.
        decay: share of a pixel's state that is forgotten while the picture gets one event per pixel. It does not depend
            on time, so neither do the images on the camera's speed.
        drift: (height, width), how the thresholds of the pixels differ (:mod:`aenerf_ns.events.polarity_drift`). Where
            it is not taken off, a pixel grows brighter or darker with each event, and the images show grain that stands
            still. None: they do not differ.
    """
    surplus = np.zeros(()) if drift is None else drift.astype(np.float64)
    rise, fall = sensor.positive_contrast_threshold * (1 - surplus), -sensor.negative_contrast_threshold * (1 + surplus)
    filter_of = partial(_Filter, changes=(rise, fall), decay=decay, refractory_period=sensor.refractory_period)
    held: list[tuple[EventStream, NDArray[np.float32], float]] = []
    forward: _Filter | None = None
    # The latest batches whose images wait for what follows: as many again are yielded at a time.
    num_ahead = 0
    for batch in batches:
        forward = forward or filter_of(batch)
        forward.add(batch)
        held.append((batch, forward.state(), forward.weight))
        num_ahead = min(math.ceil(_LOOK_AHEAD * batch.width * batch.height / len(batch)), _MAX_IMAGES_AHEAD)
        if len(held) >= 2 * num_ahead:
            yield from _finish(held, filter_of)[:num_ahead]
            held = held[num_ahead:]
    yield from _finish(held, filter_of)


def _finish(
    held: list[tuple[EventStream, NDArray[np.float32], float]], filter_of: Callable[[EventStream], _Filter]
) -> list[tuple[int, NDArray[np.float32]]]:
    """Return the times, and the weighted means of the states of the forward and the backward filter."""
    both: list[tuple[int, NDArray[np.float32]]] = []
    backward: _Filter | None = None
    for batch, state, weight in reversed(held):
        backward = backward or filter_of(batch)
        mean = (weight * state + backward.weight * backward.state()) / (weight + backward.weight)
        # An image of a batch shorter than the lag is dated to the batch's start.
        lag = round(_LAG * batch.width * batch.height)
        both.append((int(batch.t[max(len(batch) - 1 - lag, 0)]), mean))
        backward.add(batch, -1)
    return both[::-1]


class _Filter:
    """The asynchronous high-pass filter of Scheerlinck, Barnes and Mahony, "Continuous-time Intensity Estimation Using
    Event Cameras" (ACCV 2018), in the time that counts the events of the picture.

    A pixel's state adds up the changes of log-intensity that its events stand for. It begins as zero, and decays while
    the picture gets events.
    """

    def __init__(
        self, batch: EventStream, changes: Sequence[NDArray[np.float64]], decay: float, refractory_period: int
    ) -> None:
        shape = batch.height, batch.width
        # The change of log-intensity with a positive and with a negative event of each pixel, or of any.
        self._rise, self._fall = (np.broadcast_to(change, shape) for change in changes)
        self._decay = decay / math.prod(shape)
        self._refractory_period = refractory_period
        self._state, self._last = np.zeros(shape), np.zeros(shape, np.int64)
        # Of the last event of each pixel. A polarity of 0 stands for none.
        self._time, self._polarity = np.zeros(shape, np.int64), np.zeros(shape, np.int8)
        self._count = 0

    def add(self, events: EventStream, step: int = 1) -> None:
        """Take the next events. With a step of -1 they go back in time, so that a rise of light is a fall."""
        columns = (events.x[::step], events.y[::step], events.t[::step], events.p[::step])
        states = (self._state, self._last, self._time, self._polarity)
        changes = (step * self._rise, step * self._fall)
        _integrate(*states, *columns, self._count, self._decay, *changes, self._refractory_period)
        self._count += len(events)

    @property
    def weight(self) -> float:
        """The share of a state that has been forgotten: at first, a state tells less than it will."""
        return 1 - math.exp(-self._decay * self._count)

    def state(self) -> NDArray[np.float32]:
        """Return the (height, width) states."""
        return (self._state * np.exp(-self._decay * (self._count - self._last))).astype(np.float32)


@numba.njit(cache=True)
def _integrate(state, last, time, polarity, x, y, t, p, count, decay, rise, fall, refractory_period):
    for event in range(len(p)):
        row, column = y[event], x[event]
        change = rise[row, column] if p[event] > 0 else fall[row, column]
        interval = abs(t[event] - time[row, column])
        if polarity[row, column] == p[event] and interval > refractory_period:
            change *= 1 + min(refractory_period / (interval - refractory_period), 7 / 8)
        kept = np.exp(-decay * (count + event - last[row, column])) * state[row, column]
        state[row, column] = kept + change
        last[row, column] = count + event
        time[row, column], polarity[row, column] = t[event], p[event]
