"""Measure pairing events, in memory and in a file, beside sorting them with NumPy, and drawing batches of pairs.

    python -m benchmarks.pairing --output benchmarks/results/NAME.json

Each measurement has a process of its own, and so its own peak memory. The events come in chunks, as from a file. The
time of making them is measured alone and subtracted. Figures of a batch are of one thread of the CPU.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO, Literal

import numpy as np
import torch

from aenerf_ns.camera.alignment import Similarity
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.events.pair_store import EventPairs
from aenerf_ns.events.pairing import EVENTS_IN_MEMORY, pair_events
from aenerf_ns.events.polarity_drift import polarity_drift
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.recording.scene import SceneRecording
from aenerf_ns.supervision.event_pairs import (
    PairLossCoefficients,
    PairSampler,
    PairSamplerConfig,
    PairSupervisionConfig,
)
from benchmarks.runs import in_own_process, peak_mib, run_benchmark, write_result

WIDTH, HEIGHT = 1280, 720
_CHUNK = 1 << 22
_BATCHES, _PAIRS = 100, 4096


def stream(num_events: int) -> Iterator[EventStream]:
    """Yield events at random pixels of a 1280 x 720 sensor in chunks, one event each 100 ns on average."""
    rng = np.random.default_rng(0)
    start = 0
    for begin in range(0, num_events, _CHUNK):
        count = min(_CHUNK, num_events - begin)
        t = start + np.cumsum(rng.integers(0, 200, count))
        start = int(t[-1])
        x = rng.integers(0, WIDTH, count, dtype=np.uint16)
        y = rng.integers(0, HEIGHT, count, dtype=np.uint16)
        p = (2 * rng.integers(0, 2, count, dtype=np.int8) - 1).astype(np.int8)
        yield EventStream(x, y, t, p, WIDTH, HEIGHT)


def with_numpy(num_events: int) -> int:
    """Pair events as one would with NumPy: sort by pixel, then by time, and take neighbors."""
    chunks = list(stream(num_events))
    x, y, t, p = (np.concatenate([getattr(chunk, name) for chunk in chunks]) for name in "xytp")
    del chunks
    pixel = y.astype(np.int64) * WIDTH + x
    # A stable sort by pixel is enough, because the events are sorted by time.
    order = np.argsort(pixel, kind="stable")
    same = pixel[order][1:] == pixel[order][:-1]
    previous, later, polarity = t[order][:-1][same], t[order][1:][same], p[order][1:][same]
    assert len(previous) == len(later) == len(polarity)
    return len(later)


def sampler(pairs: EventPairs) -> PairSampler:
    """Return the sampler of ``aenerf`` for these pairs, with a camera that stands still."""
    sensor = SensorModel()
    end = 200 * pairs.num_events
    scene = SceneRecording(
        frame=Similarity(torch.ones(()), torch.eye(3), torch.zeros(3)),
        trajectory=Trajectory([0, end], torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)),
        ground_truth=None,
        event_camera=CameraIntrinsics(WIDTH, HEIGHT, 1000.0, 1000.0, WIDTH / 2, HEIGHT / 2),
        event_file=SimpleNamespace(),  # type: ignore[arg-type]
        sensor=sensor,
        window=TimeWindow(),
        camera_times=torch.zeros(0, dtype=torch.int64),
        has_image=[],
        image_encoding="srgb",
        bounded=False,
    )
    return PairSamplerConfig().setup(
        dataset=SimpleNamespace(scene=scene, pairs=pairs, polarity_drift=polarity_drift(pairs)),
        supervision=PairSupervisionConfig().setup(sensor=sensor, loss_coefficients=PairLossCoefficients()),
        device="cpu",
    )


def sample(pairs: EventPairs) -> dict[str, float]:
    """Return figures of batches of 4096 pairs, one thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        begin = time.perf_counter()
        source = sampler(pairs)
        source.prepare()
        prepared = time.perf_counter() - begin
        wall, cpu = [], []
        for _ in range(_BATCHES):
            begin, begin_cpu = time.perf_counter(), time.thread_time()
            source.sample(2 * _PAIRS)
            wall.append(time.perf_counter() - begin)
            cpu.append(time.thread_time() - begin_cpu)
    finally:
        torch.set_num_threads(threads)
    return {
        "seconds_until_the_first": prepared,
        "batch_ms": 1e3 * float(np.median(wall)),
        "batch_cpu_ms": 1e3 * float(np.median(cpu)),
        "batch_ms_of_the_fastest_tenth": 1e3 * float(np.quantile(wall, 0.1)),
    }


def resident_gib() -> dict[str, float]:
    """Return the resident memory of this process: its own, and of mapped files, which the system can take back."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text("utf8").splitlines())
    own, mapped = (int(lines[name].split()[0]) / 2**20 for name in ("RssAnon", "RssFile"))
    return {"own_gib": own, "mapped_gib": mapped}


def in_file(num_events: int, folder: Path) -> dict[str, Any]:
    """Pair events into a file and draw batches from it, first with nothing of it in memory."""
    pair_events(stream(10))
    opened: list[BinaryIO] = []

    def open_file() -> tuple[BinaryIO, Path]:
        opened.append((folder / "rows").open("w+b"))
        return opened[0], folder

    begin = time.perf_counter()
    pairs = pair_events(
        stream(num_events),
        expected_events=num_events,
        open_file=open_file,
        # A recording that would stay in memory is cut into eight parts, too.
        events_in_memory=EVENTS_IN_MEMORY if num_events > EVENTS_IN_MEMORY else num_events // 8,
    )
    seconds = time.perf_counter() - begin
    peak = peak_mib() / 2**10
    with opened[0] as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    cold = sample(pairs)
    memory = resident_gib()
    size = (folder / "rows").stat().st_size
    (folder / "rows").unlink()
    return {
        "seconds": seconds,
        "peak_gib": peak,
        "bytes_per_event": size / num_events,
        "sampling_from_disk": cold,
        "sampling_again": sample(pairs),
        "memory_after_sampling": memory,
    }


def in_memory(num_events: int) -> dict[str, Any]:
    """Pair events in memory and draw batches."""
    pair_events(stream(10))
    begin = time.perf_counter()
    pairs = pair_events(stream(num_events), expected_events=num_events)
    seconds = time.perf_counter() - begin
    peak = peak_mib() / 2**10
    return {"seconds": seconds, "peak_gib": peak, "pairs": len(pairs), "sampling": sample(pairs)}


def measure(what: Literal["stream", "numpy"], num_events: int) -> dict[str, float]:
    """Return seconds and peak memory of this process."""
    begin = time.perf_counter()
    if what == "numpy":
        with_numpy(num_events)
    else:
        sum(map(len, stream(num_events)))
    return {"seconds": time.perf_counter() - begin, "peak_gib": peak_mib() / 2**10}


@dataclass
class Pairing:
    """Measure pairing."""

    output: Path
    """JSON file to write."""
    sizes: tuple[int, ...] = (10_000_000, 100_000_000)
    """Numbers of events. Beyond 134 million only the file is measured."""
    folder: Path | None = None
    """Folder for the file of pairs, which takes 32 bytes an event. By default the system's for temporary files."""

    def main(self) -> None:
        """Measure and write the figures."""
        rows = []
        for size in self.sizes:
            idle = in_own_process(measure, "stream", size)
            with tempfile.TemporaryDirectory(dir=self.folder) as folder:
                file = in_own_process(in_file, size, Path(folder))
            row = {
                "events": size,
                "seconds_making_the_stream": idle["seconds"],
                "peak_gib_of_the_process_without_pairs": idle["peak_gib"],
                "in_file": file | {"million_events_per_second": size / (file["seconds"] - idle["seconds"]) / 1e6},
            }
            if size <= EVENTS_IN_MEMORY:
                own, numpy = in_own_process(in_memory, size), in_own_process(measure, "numpy", size)
                rates = [size / (result["seconds"] - idle["seconds"]) / 1e6 for result in (own, numpy)]
                row["in_memory"] = own | {"million_events_per_second": rates[0]}
                row["numpy"] = numpy | {"million_events_per_second": rates[1]}
            rows.append(row)
        write_result(self.output, {"sensor": [WIDTH, HEIGHT], "pairs_in_a_batch": _PAIRS, "rows": rows})


if __name__ == "__main__":
    run_benchmark(Pairing)
