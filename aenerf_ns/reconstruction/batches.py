"""Batches of events: each batch gives one image."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

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
