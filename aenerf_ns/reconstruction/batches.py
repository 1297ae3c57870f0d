"""Batches of events, and the voxel grids that E2VID and FireNet take. Each batch gives one image."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.events.stream import EventStream

EVENTS_PER_PIXEL = 0.35
"""Events in a batch, as a share of the sensor's pixels, with which the authors of E2VID run it."""


def batches_of(chunks: Iterable[EventStream], num_events: int) -> Iterator[EventStream]:
    """Cut a stream into disjoint batches of ``num_events``. A last batch of fewer events is left out.

    Args:
        chunks: the stream in pieces of any length, in the order of time, all of one sensor.
        num_events: at least 1.
    """
    waiting: list[EventStream] = []
    for chunk in chunks:
        waiting.append(chunk)
        num_batches = sum(map(len, waiting)) // num_events
        if num_batches:
            events = EventStream.concatenate(waiting)
            for begin in range(0, num_batches * num_events, num_events):
                yield events[begin : begin + num_events]
            waiting = [events[num_batches * num_events :]]


def voxel_grid(events: EventStream, num_bins: int) -> NDArray[np.float32]:
    """Add up the polarities of events over pixels and over bins of time.

    The first event is at the first bin and the last event at the last bin. In between, each polarity is shared between
    the two nearest bins, linearly in time (Rebecq et al., "High Speed and High Dynamic Range Video with an Event
    Camera", TPAMI 2021, eq. 1).

    Args:
        events: of one batch, at least one.
        num_bins: at least 2.

    Returns:
        (num_bins, height, width) sums.
    """
    grid = np.zeros((num_bins, events.height, events.width))
    elapsed = (events.t - events.t[0]).astype(np.float64)
    # Events that are all of one time are in the first bin.
    position = (num_bins - 1) * elapsed / max(elapsed[-1], 1.0)
    lower = np.minimum(position.astype(np.int64), num_bins - 2)
    share = position - lower
    np.add.at(grid, (lower, events.y, events.x), events.p * (1 - share))
    np.add.at(grid, (lower + 1, events.y, events.x), events.p * share)
    return grid.astype(np.float32)


def normalize(grid: NDArray[np.float32]) -> NDArray[np.float32]:
    """Bring the values of a voxel grid other than zero to mean 0 and standard deviation 1; zeros stay zero.

    Values that are all equal have no deviation: only the mean is subtracted from them.
    """
    active = grid != 0
    if not active.any():
        return grid
    values = grid[active].astype(np.float64)
    result = np.zeros_like(grid)
    result[active] = (values - values.mean()) / (values.std() or 1.0)
    return result
