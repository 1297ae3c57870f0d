"""Leave events out of a stream: by time, by pixel, or because they follow another event too closely."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.camera.time_window import FIRST_TIME, LAST_TIME, TimeWindow
from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventStream

_NEVER = np.iinfo(np.int64).min

# A hot pixel has more events than its neighbors by this factor and by so many standard deviations.
_HOT_FACTOR = 4.0
_HOT_DEVIATIONS = 6.0
_MAX_SHOWN = 10


@dataclass(frozen=True)
class EventFilters:
    """The events of a stream that are kept.

    The filters are applied in this order: time window, hot pixels, region, share of the pixels, shortest interval.

    Attributes:
        start: nanoseconds; events before this time are left out.
        end: nanoseconds; events after this time are left out.
        region: x, y, width and height in pixels of the part of the sensor that is kept. The kept events' pixels are
            counted from the corner of the region.
        hot_pixels: whether the events of hot pixels (:func:`find_hot_pixels`) are left out.
        pixel_share: share of the pixels that are kept, chosen at random. All events of a kept pixel are kept.
        shortest_interval: nanoseconds; an event that follows the last kept event of its pixel by less is left out.
        seed: seed of the choice of pixels.

    Raises:
        ValueError: a value is out of range.
    """

    start: int | None = None
    end: int | None = None
    region: tuple[int, int, int, int] | None = None
    hot_pixels: bool = False
    pixel_share: float = 1.0
    shortest_interval: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.pixel_share <= 1:
            raise ValueError(f"the share of pixels must be above 0 and at most 1, not {self.pixel_share}")
        for what, time in (("begins", self.start), ("ends", self.end)):
            if time is not None and not FIRST_TIME <= time <= LAST_TIME:
                raise ValueError(f"the time window {what} at {time} ns, which must fit in 64 bits")
        if not 0 <= self.shortest_interval <= LAST_TIME:
            raise ValueError(f"the shortest interval must be from 0 to {LAST_TIME} ns, not {self.shortest_interval}")
        if self.window.start > self.window.end:
            raise ValueError(f"the time window ends at {self.end} ns, before it begins at {self.start} ns")
        if self.region is not None and (min(self.region[:2]) < 0 or min(self.region[2:]) <= 0):
            raise ValueError(f"the region of interest {self.region} must be x, y, width, height, of positive size")

    @property
    def window(self) -> TimeWindow:
        """Times of the events that are kept."""
        return TimeWindow(FIRST_TIME if self.start is None else self.start, LAST_TIME if self.end is None else self.end)


def count_events(chunks: Iterable[EventStream], height: int, width: int) -> NDArray[np.int64]:
    """Return the (height, width) int64 number of events of every pixel, in one pass over the stream."""
    counts = np.zeros(width * height, np.int64)
    for chunk in chunks:
        counts += np.bincount(chunk.y.astype(np.int64) * width + chunk.x, minlength=counts.size)
    return counts.reshape(height, width)


def find_hot_pixels(counts: NDArray[np.integer], bayer_pattern: str | None = None) -> NDArray[np.bool_]:
    """Find the pixels that fire by themselves.

    Edges pass over many pixels when the camera moves, so that a pixel has about as many events as the pixels around it.
    A hot pixel has more than four times the median of the 5 x 5 pixels around it, and exceeds the median by more than 6
    standard deviations. Deviations are taken after Anscombe's transformation 2 sqrt(n + 3/8), which gives the noise of
    a Poisson process a standard deviation of 1. The standard deviation used is 1.4826 times the median absolute
    deviation over the sensor, but at least 1.

    Args:
        counts: (height, width) number of events of every pixel.
        bayer_pattern: of a color sensor, on which a pixel is compared with those of its own filter.

    Returns:
        (height, width) bool, whether a pixel is hot.
    """
    step = 2 if bayer_pattern else 1
    around = np.zeros(counts.shape)
    for row, column in product(*(range(min(step, side)) for side in counts.shape)):
        around[row::step, column::step] = _median_around(counts[row::step, column::step])
    excess = 2 * (np.sqrt(counts + 0.375) - np.sqrt(around + 0.375))
    spread = max(1.4826 * float(np.median(np.abs(excess))), 1.0)
    return (counts > _HOT_FACTOR * around) & (excess > _HOT_DEVIATIONS * spread)


def _median_around(counts: NDArray[np.integer]) -> NDArray[np.float32]:
    """Return the median of the 5 x 5 pixels around each pixel.

    Most pixels around a pixel with events may have none, as where a share of the pixels was kept. The median is then
    that of the others around it that have events, or of the whole sensor's, if there are no others.
    """
    around = np.asarray(cv2.medianBlur(counts.astype(np.float32, order="C"), 5), np.float32)
    has_events = counts > 0
    between = has_events & (around == 0)
    if between.any():
        padded = np.pad(np.where(has_events, counts, np.nan), 2, constant_values=np.nan)
        near = np.lib.stride_tricks.sliding_window_view(padded, (5, 5))[between].reshape(-1, 25)
        others = np.delete(near, 12, axis=1)
        others[np.isnan(others).all(axis=1)] = np.median(counts[has_events])
        around[between] = np.nanmedian(others, axis=1)
    return around


def hot_pixel_summary(hot: NDArray[np.bool_], counts: NDArray[np.integer]) -> str:
    """Describe the hot pixels of :func:`find_hot_pixels` in one line, those with the most events by name."""
    if not hot.any():
        return "Hot pixels: none."
    rows, columns = np.nonzero(hot)
    order = np.argsort(-counts[hot], kind="stable")[:_MAX_SHOWN]
    named = ", ".join(f"({columns[i]}, {rows[i]}) {counts[rows[i], columns[i]]:,}" for i in order)
    more = f", and {len(rows) - len(order)} more" if len(rows) > len(order) else ""
    share = counts[hot].sum() / counts.sum()
    return f"Hot pixels: {len(rows)}, with {share:.2%} of the events. (x, y) and events: {named}{more}."


class EventSelection:
    """Keep only some of the events of a file.

    Args:
        source: the file, for messages.
        width, height: size of its sensor in pixels.
        filters: the events to keep.
        bayer_pattern: of a color sensor; see :func:`find_hot_pixels`.

    Raises:
        DataError: the region of interest is not on the sensor.
    """

    def __init__(
        self, source: Path, width: int, height: int, filters: EventFilters, bayer_pattern: str | None = None
    ) -> None:
        self._region = filters.region or (0, 0, width, height)
        if self._region[0] + self._region[2] > width or self._region[1] + self._region[3] > height:
            region = " ".join(map(str, self._region))
            raise DataError(
                source,
                f"the region of interest {region} (x, y, width, height) reaches beyond its {width} x {height} pixels",
                "give one on the sensor",
            )
        self._filters, self._bayer_pattern = filters, bayer_pattern
        x, y, columns, rows = self._region
        self._keep = np.zeros((height, width), bool)
        self._keep[y : y + rows, x : x + columns] = True
        if filters.pixel_share < 1:
            self._keep &= np.random.default_rng(filters.seed).random(self._keep.shape) < filters.pixel_share

    def find_hot_pixels(self, chunks: Iterable[EventStream]) -> str:
        """Find the hot pixels in all chunks of the source, if the filters leave them out, and describe them in a line.

        Returns:
            The line, which is empty if the filters keep hot pixels.
        """
        if not self._filters.hot_pixels:
            return ""
        counts = count_events(self._within(chunks), *self._keep.shape)
        hot = find_hot_pixels(counts, self._bayer_pattern)
        self._keep &= ~hot
        return hot_pixel_summary(hot, counts)

    def filtered(self, chunks: Iterable[EventStream]) -> Iterator[EventStream]:
        """Yield the kept events of each chunk. Pass every chunk of the source, in order. Find the hot pixels before."""
        x, y, width, height = self._region
        last_kept = np.full(self._keep.shape, _NEVER)
        for chunk in self._within(chunks):
            kept = _select(chunk.x, chunk.y, chunk.t, self._keep, self._filters.shortest_interval, last_kept)
            part = chunk[kept]
            yield replace(part, x=part.x - np.uint16(x), y=part.y - np.uint16(y), width=width, height=height)

    def _within(self, chunks: Iterable[EventStream]) -> Iterator[EventStream]:
        window = self._filters.window
        for chunk in chunks:
            yield chunk.between(window.start, window.end)


@numba.njit(cache=True)
def _select(x, y, t, keep, shortest_interval, last_kept):
    """Return (N,) bool, whether each event is kept. Updates ``last_kept``, which is passed on from chunk to chunk."""
    kept = np.zeros(x.shape[0], np.bool_)
    for i in range(x.shape[0]):
        pixel = y[i], x[i]
        if keep[pixel] and (last_kept[pixel] == _NEVER or t[i] - last_kept[pixel] >= shortest_interval):
            kept[i] = True
            last_kept[pixel] = t[i]
    return kept
