"""Measure throughput and peak memory of aenerf convert.

    python -m benchmarks.convert --output benchmarks/results/NAME.json

Each measurement has a process of its own, and so its own peak memory. The dataset holds uncompressed events at random
pixels of a 1280 x 720 sensor. Real recordings are easier to compress.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import numpy as np
import torch

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.cli.convert import Convert
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.files.event_hdf5 import Hdf5EventFile
from aenerf_ns.recording.writer import NativeDatasetWriter
from benchmarks.pairing import HEIGHT, WIDTH, stream
from benchmarks.runs import in_own_process, peak_mib, run_benchmark, write_result

_VARIANTS: dict[str, dict[str, Any]] = {
    "plain": {},
    "filtered": {"shortest_interval_ns": 1_000_000, "pixel_share": 0.5, "drop_hot_pixels": True},
}


def make_dataset(folder: Path, num_events: int) -> None:
    """Write a dataset of random events."""
    camera = CameraIntrinsics(WIDTH, HEIGHT, 1000.0, 1000.0, WIDTH / 2, HEIGHT / 2)
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, 0, 3] = 1
    with NativeDatasetWriter(folder, camera, SensorModel(), "srgb") as writer:
        writer.add_trajectories(Trajectory([0, 200 * num_events], poses))
        zero = np.zeros(1, np.uint16)
        writer.events.append(EventStream(zero, zero, zero.astype(np.int64), np.ones(1, np.int8), WIDTH, HEIGHT))
    dtypes = {"x": np.uint16, "y": np.uint16, "t": np.int64, "p": np.int8}
    with h5py.File(folder / "events.h5", "w") as file:
        columns = {name: file.create_dataset(f"events/{name}", (num_events,), dtypes[name]) for name in dtypes}
        begin = 0
        for chunk in stream(num_events):
            for name, column in columns.items():
                column[begin : begin + len(chunk)] = getattr(chunk, name)
            begin += len(chunk)


def measure(what: str, folder: Path) -> dict[str, float]:
    """Convert by a variant, or do "nothing". Return the times and the peak memory of this process."""
    wall, cpu = time.perf_counter(), time.process_time()
    written = 0
    if what != "nothing":
        output = folder.parent / what
        Convert(folder, output, **_VARIANTS[what]).main()
        written = Hdf5EventFile(output / "events.h5", WIDTH, HEIGHT).count() or 0
    return {
        "seconds": time.perf_counter() - wall,
        "cpu_seconds": time.process_time() - cpu,
        "peak_gib": peak_mib() / 2**10,
        "written_events": written,
    }


@dataclass
class ConvertBenchmark:
    """Measure aenerf convert."""

    output: Path
    """JSON file to write."""
    sizes: tuple[int, ...] = (10_000_000, 100_000_000)
    """Numbers of events."""

    def main(self) -> None:
        """Measure and write the figures."""
        rows = []
        for size in self.sizes:
            with TemporaryDirectory() as temporary:
                folder = Path(temporary) / "dataset"
                in_own_process(make_dataset, folder, size)
                results = {what: in_own_process(measure, what, folder) for what in ("nothing", *_VARIANTS)}
            idle = results.pop("nothing")
            for what, result in results.items():
                row = {
                    "events": size,
                    "variant": what,
                    "options": _VARIANTS[what],
                    **result,
                    "million_events_per_second": size / result["seconds"] / 1e6,
                    "million_events_per_cpu_second": size / result["cpu_seconds"] / 1e6,
                    "peak_gib_of_the_process_without_conversion": idle["peak_gib"],
                }
                rows.append(row)
        write_result(self.output, {"sensor": [WIDTH, HEIGHT], "rows": rows})


if __name__ == "__main__":
    run_benchmark(ConvertBenchmark)
