"""Whether the events rise where the frames become brighter, and by how much for each event."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.camera.image_encoding import decode
from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.events.stream import EventStream
from aenerf_ns.recording.images import check_image, read_image
from aenerf_ns.recording.recording import Capture

# Pairs of frames that are compared. More do not change the result.
_MAX_PAIRS = 8
# The gray level whose radiance is added before the logarithm, because the black level of a frame is not known, and two
# others, which give the range of the thresholds.
_GRAY, _GRAY_RANGE = 4, (1, 10)
_MIN_PIXELS = 100


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
        times = sorted(files) if capture.frame_camera == capture.event_camera else []
        starts = np.unique(np.linspace(0, len(times) - 2, _MAX_PAIRS).astype(int)) if len(times) > 1 else []
        self._spans = [(times[i], times[i + 1]) for i in starts]
        self._files, self._camera = files, capture.event_camera
        self._encoding = capture.image_encoding
        # Of the frames that were read, by their times.
        self._levels: dict[int, NDArray[np.uint8]] = {}
        # Of the positive and of the negative events.
        self._sums = np.zeros((len(self._spans), 2, self._camera.height, self._camera.width))

    def add(self, events: EventStream, weights: NDArray[np.float64]) -> None:
        """Add a piece of the stream of events. The (N,) weights say for how many thresholds each event stands."""
        for sums, (start, end) in zip(self._sums, self._spans, strict=True):
            part = slice(*np.searchsorted(events.t, (start, end), side="right"))
            np.add.at(sums, ((events.p[part] < 0).astype(int), events.y[part], events.x[part]), weights[part])

    def correlation(self) -> float | None:
        """Return the correlation of the sums of polarities with the changes of the frames, from −1 to 1.

        None if there are no such frames, or hardly any events between them.
        """
        events, frames = self._changes(1.0, _GRAY)
        events, frames = events[events != 0], frames[events != 0]
        if len(events) < _MIN_PIXELS or frames.std() == 0 or events.std() == 0:
            return None
        return float(np.corrcoef(events, frames)[0, 1])

    def negative_threshold(self, ratio: float) -> tuple[float, float, float]:
        """Return C−, given C+ / C−, and its range for the black levels that frames may have.

        The :meth:`correlation` must be positive.
        """
        value, *ends = (_robust_slope(*self._changes(ratio, gray)) for gray in (_GRAY, *_GRAY_RANGE))
        return value, min(ends), max(ends)

    def _changes(self, ratio: float, gray: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the change of log-radiance by the events, in C−, and by the frames, where there are events."""
        levels = decode(np.arange(256) / 255, self._encoding)
        logs = np.log(levels + levels[gray])
        changes = [np.empty((2, 0))]
        for (positive, negative), span in zip(self._sums, self._spans, strict=True):
            seen = positive + negative > 0
            if seen.any():
                before, after = (self._gray_levels(time) for time in span)
                changes.append(np.stack([ratio * positive - negative, logs[after] - logs[before]])[:, seen])
        events, frames = np.concatenate(changes, 1)
        return events, frames

    def _gray_levels(self, time: int) -> NDArray[np.uint8]:
        if time not in self._levels:
            check_image(self._files[time], self._camera)
            self._levels[time] = np.asarray(read_image(self._files[time]).convert("L"))
        return self._levels[time]


def _robust_slope(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Return the slope of a line through the origin, with Huber's loss."""
    weights, slope = np.ones(len(x)), 0.0
    for _ in range(20):
        slope = float((weights * x * y).sum() / (weights * x * x).sum())
        residuals = np.abs(y - slope * x)
        weights = 1 / np.maximum(residuals / (1.5 * 1.48 * np.median(residuals) + 1e-9), 1)
    return slope
