"""The benchmark of pairing times batches of random events."""

from __future__ import annotations

from aenerf_ns.events.pairing import pair_events
from benchmarks.pairing import sample, stream


def test_time_batches_of_random_events() -> None:
    figures = sample(pair_events(stream(20_000)))
    assert 0 < figures["batch_ms_of_the_fastest_tenth"] <= figures["batch_ms"]
    assert figures["seconds_until_the_first"] > 0
