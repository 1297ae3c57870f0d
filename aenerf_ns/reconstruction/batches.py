"""Batches of events: each batch gives one image."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from aenerf_ns.events.stream import EventStream

EVENTS_PER_PIXEL = 0.35
"""Events in a batch, as a share of the sensor's pixels, with which the authors of E2VID run it."""


def batches_of(chunks: Iterable[EventStream], num_events: int) -> Iterator[EventStream]:
    """Yield the events of a stream in disjoint batches of ``num_events``. A last batch of fewer events is left out.

    Args:
        chunks: the stream in pieces of any length, in the order of time, all of one sensor.
        num_events: at least 1.
    """
    kept: list[EventStream] = []
    lacking = num_events
    for chunk in chunks:
        begin = 0
        while len(chunk) - begin >= lacking:
            kept.append(chunk[begin : begin + lacking])
            yield _joined(kept)
            begin += lacking
            kept, lacking = [], num_events
        if begin < len(chunk):
            kept.append(chunk[begin:])
            lacking -= len(chunk) - begin


def _joined(parts: list[EventStream]) -> EventStream:
    if len(parts) == 1:
        return parts[0]
    x, y, t, p = (np.concatenate([getattr(part, name) for part in parts]) for name in "xytp")
    return EventStream(x, y, t, p, parts[0].width, parts[0].height, parts[0].source)
