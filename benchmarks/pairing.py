"""Measure throughput and peak memory of pairing events, beside sorting them with NumPy.

    python -m benchmarks.pairing --output benchmarks/results/NAME.json

Each measurement has a process of its own, and so its own peak memory. The events come in chunks, as from a file. The
time of making them is measured alone and subtracted.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from aenerf_ns.events.pairs import pair_events
from aenerf_ns.events.stream import EventStream
from benchmarks.common import in_own_process, peak_mib, write_result

_WIDTH, _HEIGHT = 1280, 720
_CHUNK = 1 << 22


def stream(num_events: int) -> Iterator[EventStream]:
    """Yield events at random pixels of a 1280 x 720 sensor in chunks, one event each 100 ns on average."""
    rng = np.random.default_rng(0)
    start = 0
    for begin in range(0, num_events, _CHUNK):
        count = min(_CHUNK, num_events - begin)
        t = start + np.cumsum(rng.integers(0, 200, count))
        start = int(t[-1])
        x = rng.integers(0, _WIDTH, count, dtype=np.uint16)
        y = rng.integers(0, _HEIGHT, count, dtype=np.uint16)
        p = (2 * rng.integers(0, 2, count, dtype=np.int8) - 1).astype(np.int8)
        yield EventStream(x, y, t, p, _WIDTH, _HEIGHT)


def with_numpy(num_events: int) -> int:
    """Pair events as one would with NumPy: sort by pixel, then by time, and take neighbours."""
    chunks = list(stream(num_events))
    x, y, t, p = (np.concatenate([getattr(chunk, name) for chunk in chunks]) for name in "xytp")
    del chunks
    pixel = y.astype(np.int64) * _WIDTH + x
    # A stable sort by pixel is enough, because the events are sorted by time.
    order = np.argsort(pixel, kind="stable")
    same = pixel[order][1:] == pixel[order][:-1]
    previous, time, polarity = t[order][:-1][same], t[order][1:][same], p[order][1:][same]
    assert len(previous) == len(time) == len(polarity)
    return len(time)


def measure(what: Literal["stream", "pair_events", "numpy"], num_events: int) -> dict[str, float]:
    """Return seconds, peak memory of this process and the number of pairs."""
    # Compile before the measurement.
    pair_events(stream(10))
    begin = time.perf_counter()
    if what == "stream":
        pairs = sum(len(chunk) for chunk in stream(num_events))
    elif what == "numpy":
        pairs = with_numpy(num_events)
    else:
        pairs = len(pair_events(stream(num_events), expected_events=num_events))
    seconds = time.perf_counter() - begin
    return {"seconds": seconds, "peak_gib": peak_mib() / 2**10, "pairs": pairs}


@dataclass
class Pairing:
    """Measure pairing."""

    output: Path
    """JSON file to write."""
    sizes: tuple[int, ...] = (10_000_000, 100_000_000)
    """Numbers of events."""

    def main(self) -> None:
        """Measure and write the figures."""
        rows = []
        for size in self.sizes:
            results = {what: in_own_process(measure, what, size) for what in ("stream", "pair_events", "numpy")}
            idle = results["stream"]["seconds"]
            own, numpy = (results[what]["seconds"] - idle for what in ("pair_events", "numpy"))
            row = {
                "events": size,
                "pairs": results["pair_events"]["pairs"],
                "million_events_per_second": size / own / 1e6,
                "numpy_million_events_per_second": size / numpy / 1e6,
                "times_faster_than_numpy": numpy / own,
                "peak_gib": results["pair_events"]["peak_gib"],
                "numpy_peak_gib": results["numpy"]["peak_gib"],
                "peak_gib_of_the_process_without_pairs": results["stream"]["peak_gib"],
                "seconds_making_the_stream": idle,
            }
            rows.append(row)
        write_result(self.output, {"sensor": [_WIDTH, _HEIGHT], "rows": rows})


if __name__ == "__main__":
    tyro.cli(Pairing).main()
