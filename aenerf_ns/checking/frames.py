"""Whether the events rise where the frames become brighter, and by how much for each event."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.camera.image_encoding import decode
from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.recording.images import check_image, read_image
from aenerf_ns.recording.recording import Capture

# Pairs of frames that are compared. More do not change the result.
_MAX_PAIRS = 8
# The gray level whose radiance is added before the logarithm, because the black level of a frame is not known, and two
# others, which give the range of the thresholds.
_GRAY, _GRAY_RANGE = 4, (1, 10)
_MIN_PIXELS = 100
_NEVER = np.iinfo(np.int64).min


class FrameChanges:
    """Compare the events between consecutive frames with the change of the frames, at each pixel.

    Only frames that the event camera's own lens took, at known times within the window, are compared. Between two of
    them, the sum of a pixel's polarities is the change of its log-radiance in contrast thresholds, however far the
    camera moved.

    Args:
        capture: the cameras.
        frames: times in nanoseconds and files.
        window: the time of the frames that are compared.
    """

    def __init__(self, capture: Capture, frames: Iterable[tuple[int, Path]], window: TimeWindow) -> None:
        files = {time: file for time, file in frames if window.contains(time)}
        times = sorted(files) if capture.has_own_frames else []
        starts = np.unique(np.linspace(0, len(times) - 2, _MAX_PAIRS).astype(int)) if len(times) > 1 else []
        self._spans = [(times[i], times[i + 1]) for i in starts]
        self._encoding = capture.image_encoding
        # Of the positive and of the negative events.
        size = (capture.event_camera.height, capture.event_camera.width)
        self._sums = np.zeros((len(self._spans), 2, *size))
        # Of the events around each frame, a second; the frames that each pixel has passed, and its last event.
        self._moments = np.unique(np.array(self._spans, np.int64))
        self._rates = np.zeros((len(self._moments), *size), np.float32)
        self._num_passed, self._last_time = np.zeros(size, np.int64), np.full(size, _NEVER)
        self._refractory_period = capture.sensor.refractory_period
        self._gray_levels: dict[int, NDArray[np.uint8]] = {}
        for time in self._moments.tolist():
            check_image(files[time], capture.event_camera)
            self._gray_levels[time] = _levels_of_pixels(files[time], capture.sensor)

    def add(self, events: EventStream, weights: NDArray[np.float64]) -> None:
        """Add a piece of the stream of events. The (N,) weights say for how many thresholds each event stands."""
        for sums, (start, end) in zip(self._sums, self._spans, strict=True):
            part = slice(*np.searchsorted(events.t, (start, end), side="right"))
            np.add.at(sums, ((events.p[part] < 0).astype(int), events.y[part], events.x[part]), weights[part])
        columns = events.x, events.y, events.t, events.p
        _find_rates(columns, self._moments, self._refractory_period, self._last_time, self._num_passed, self._rates)

    def correlation(self) -> float | None:
        """Return the correlation of the sums of polarities with the changes of the frames, from −1 to 1.

        None if there are no such frames, or hardly any events between them.
        """
        events, frames, _, _ = self._changes(1.0, _GRAY)
        events, frames = events[events != 0], frames[events != 0]
        if len(events) < _MIN_PIXELS or frames.std() == 0 or events.std() == 0:
            return None
        return float(np.corrcoef(events, frames)[0, 1])

    def negative_threshold(self, ratio: float) -> tuple[float, float, float]:
        """Return C−, given C+ / C−, and its range for the black levels that frames may have.

        The :meth:`correlation` must be positive.
        """
        changes = (self._changes(ratio, gray)[:2] for gray in (_GRAY, *_GRAY_RANGE))
        value, *ends = (_robust_fit(events[None], frames)[0] for events, frames in changes)
        return value, min(ends), max(ends)

    def bandwidth(self, ratio: float) -> tuple[float, float, float] | None:
        """Return the bandwidth in Hz at the mean radiance, given C+ / C−, and its range; None: no lag is seen.

        The signal that fires events lags behind the light by the rate at which it changes, times the time constant of
        the pixel's low-pass filter, which falls with the light. The frames may lag, too, but all pixels alike. The
        range is that of the black levels that frames may have, and of halves of the frames.
        """
        lags = []
        for gray, part in product((_GRAY, *_GRAY_RANGE), (slice(None), slice(0, None, 2), slice(1, None, 2))):
            events, frames, lag, delay = self._changes(ratio, gray, part)
            if len(events) < _MIN_PIXELS:
                return None
            threshold, ahead, _ = _robust_fit(np.stack([events, lag, delay]), frames)
            lags.append(ahead / threshold if threshold > 0 else 0.0)
        if not min(lags) > 0:
            return None
        return 1 / lags[0], 1 / max(lags), 1 / min(lags)

    def _changes(self, ratio: float, gray: int, part: slice = slice(None)) -> NDArray[np.float64]:
        """Return four changes between frames where there are events.

        Of log-radiance by the events, in C−, and by the frames; of what light is ahead of a pixel with a bandwidth of
        1 Hz, in C−; and of the rate of events, in C− a second.
        """
        levels = decode(np.arange(256) / 255, self._encoding)
        logs = np.log(levels + levels[gray])
        radiances = [levels[shown] + levels[gray] for shown in self._gray_levels.values()]
        mean = np.mean(radiances) if radiances else 1.0
        changes = [np.empty((4, 0))]
        for (positive, negative), span in zip(self._sums[part], self._spans[part], strict=True):
            seen = positive + negative > 0
            log = [logs[self._gray_levels[time]][seen] for time in span]
            rate = self._rates[np.searchsorted(self._moments, span)][:, seen]
            rate = np.where(rate > 0, ratio * rate, rate)
            lag = rate * SensorModel(bandwidth=1.0).time_constant(np.exp(log) / mean)
            events = ratio * positive - negative
            changes.append(np.stack([events[seen], log[1] - log[0], lag[1] - lag[0], rate[1] - rate[0]]))
        return np.concatenate(changes, 1)


def _levels_of_pixels(file: Path, sensor: SensorModel) -> NDArray[np.uint8]:
    """Read the (height, width) gray levels of an image; of a color sensor, those behind the filter of each pixel."""
    image = read_image(file)
    if not sensor.bayer_pattern:
        return np.asarray(image.convert("L"))
    channels = sensor.channels(image.width, image.height)
    return np.take_along_axis(np.asarray(image.convert("RGB")), channels[..., None], -1)[..., 0]


def _robust_fit(columns: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the coefficients of (K, N) columns that add up to y, with Huber's loss."""
    weights, coefficients = np.ones(len(y)), np.zeros(len(columns))
    for _ in range(20):
        coefficients = np.linalg.lstsq((weights * columns) @ columns.T, (weights * columns) @ y, rcond=None)[0]
        residuals = np.abs(y - coefficients @ columns)
        weights = 1 / np.maximum(residuals / (1.5 * 1.48 * np.median(residuals) + 1e-9), 1)
    return coefficients


@numba.njit(cache=True)
def _find_rates(columns, moments, refractory_period, last_time, num_passed, rates):
    """Continue with a piece of a stream: find events a second, with sign, in each pixel's interval around each moment.

    The interval is counted without the time for which the pixel is blind. Without an event before, the rate stays 0.
    """
    x, y, t, p = columns
    for i in range(len(t)):
        place = y[i], x[i]
        while num_passed[place] < len(moments) and t[i] > moments[num_passed[place]]:
            if last_time[place] != _NEVER:
                interval = max(t[i] - last_time[place] - refractory_period, 1000)
                rates[num_passed[place], y[i], x[i]] = 1e9 * p[i] / interval
            num_passed[place] += 1
        last_time[place] = t[i]
