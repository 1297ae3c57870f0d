"""Whether the events rise where the frames become brighter."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.events.stream import EventStream
from aenerf_ns.recording.images import check_image, read_image
from aenerf_ns.recording.recording import Recording

# Pairs of frames that are compared. More do not change the result.
_MAX_PAIRS = 8
# Added to display values, 0 to 255, before the logarithm.
_EPSILON = 4.0
_MIN_PIXELS = 100


class FrameChanges:
    """Compare the events between consecutive frames with the change of the frames, at each pixel.

    Only frames that the event camera's own lens took, at known times within the window, are compared. Between two of
    them, the sum of a pixel's polarities is the change of its log-radiance in contrast thresholds, however far the
    camera moved.
    """

    def __init__(self, recording: Recording, window: TimeWindow) -> None:
        views = [view for split in recording.reference_views.values() for view in split]
        files = {view.time: view.file for view in views if view.time is not None and window.contains(view.time)}
        times = sorted(files) if recording.frame_camera == recording.event_camera else []
        starts = np.unique(np.linspace(0, len(times) - 2, _MAX_PAIRS).astype(int)) if len(times) > 1 else []
        self._spans = [(times[i], times[i + 1]) for i in starts]
        self._files, self._camera = files, recording.event_camera
        self._sums = np.zeros((len(self._spans), self._camera.height, self._camera.width))

    def add(self, events: EventStream) -> None:
        """Add a piece of the stream of events."""
        for sums, (start, end) in zip(self._sums, self._spans, strict=True):
            part = events.between(start, end)
            np.add.at(sums, (part.y, part.x), part.p)

    def correlation(self) -> float | None:
        """Return the correlation of the sums of polarities with the changes of the frames, from −1 to 1.

        None if there are no such frames, or hardly any events between them.
        """
        pairs = [(sums, self._change(*span)) for sums, span in zip(self._sums, self._spans, strict=True) if sums.any()]
        if not pairs:
            return None
        events, frames = (np.concatenate([part.ravel() for part in parts]) for parts in zip(*pairs, strict=True))
        seen = events != 0
        if seen.sum() < _MIN_PIXELS or frames[seen].std() == 0 or events[seen].std() == 0:
            return None
        return float(np.corrcoef(events[seen], frames[seen])[0, 1])

    def _change(self, start: int, end: int) -> NDArray[np.float64]:
        for time in (start, end):
            check_image(self._files[time], self._camera)
        before, after = (
            np.log(np.asarray(read_image(self._files[time]).convert("L"), np.float64) + _EPSILON)
            for time in (start, end)
        )
        return after - before
