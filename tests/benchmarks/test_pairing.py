"""The benchmark of pairing times batches of random events."""

from __future__ import annotations

from benchmarks.pairing import in_memory, with_numpy


def test_pairs_are_as_many_as_by_numpy() -> None:
    # Of so few events no two are of one pixel and time.
    assert in_memory(20_000)["pairs"] == with_numpy(20_000) > 100
