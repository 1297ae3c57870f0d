"""The benchmark of pairing times batches of random events."""

from __future__ import annotations

import torch

from aenerf_ns.events.pairing import pair_events
from benchmarks.pairing import sample, stream


def test_batches_are_timed_on_one_thread_that_is_given_back() -> None:
    threads = torch.get_num_threads()
    figures = sample(pair_events(stream(20_000)))
    assert min(figures.values()) > 0
    assert torch.get_num_threads() == threads
