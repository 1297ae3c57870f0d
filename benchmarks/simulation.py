"""Frames and events a second of the simulator, and its self-test, on whatever scene.

    python benchmarks/simulation.py --scenes room scenes/*/scene.json --output benchmarks/results/simulation_cpu2.json

The first frames of each scene's path are rendered and turned into events, as ``aenerf simulate`` does. The self-test
takes the log-radiance of some pixels in every frame, and compares how much it moved between two events of a pixel with
the contrast threshold. Times are whole nanoseconds, so a pair may be off by what the log-radiance moves within the half
nanosecond by which each of its events was rounded; what an error has beyond that must be below 1e-6.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np
import tyro

from aenerf_ns.bench.environment import environment
from aenerf_ns.bench.plan import scene_name
from aenerf_ns.camera.lens import EventCamera
from aenerf_ns.events.sensor import LUMINANCE, SensorModel
from aenerf_ns.simulator.esim import EventSimulator
from aenerf_ns.simulator.frames import frame_parameters
from aenerf_ns.simulator.open_scene import open_scene

_TESTED_PIXELS = 2000


@dataclass
class SimulationCost:
    """Measure the simulator."""

    output: Path
    """JSON file to write."""
    scenes: tuple[str, ...] = ("room", "object")
    """Scenes as aenerf simulate takes them."""
    frames: int = 1000
    """Frames of each scene, from the beginning of its path."""
    width: int = 346
    """Pixel columns."""
    height: int = 260
    """Pixel rows."""

    def main(self) -> None:
        """Measures and writes the figures."""
        rows = [self._measure(name) for name in self.scenes]
        size = {"width": self.width, "height": self.height, "numba_threads": numba.get_num_threads()}
        self.output.write_text(json.dumps({"rows": rows, **size, **environment()}, indent=2) + "\n")

    def _measure(self, name: str) -> dict[str, Any]:
        begin = time.process_time()
        scene = open_scene(name)
        opening = time.process_time() - begin
        camera = EventCamera(self.width, self.height, *scene.intrinsics(self.width, self.height))
        intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
        begin = time.process_time()
        parameters = frame_parameters(scene, intrinsics, self.width, self.height, 0.5)
        spacing = time.process_time() - begin
        times = np.rint(parameters * scene.duration * 1e9).astype(np.int64)
        sensor = SensorModel()
        simulator = EventSimulator(self.width, self.height, sensor)
        tested = np.random.default_rng(0).choice(self.width * self.height, _TESTED_PIXELS, replace=False)
        levels, columns, rendering, simulating = [], [], 0.0, 0.0
        wall = time.perf_counter()
        for parameter, stamp in zip(parameters[: self.frames], times, strict=False):
            begin = time.process_time()
            image = scene.renderer.render(scene.path(float(parameter)), intrinsics, self.width, self.height, 4)[0]
            middle = time.process_time()
            columns.append(simulator(image, int(stamp)))
            rendering, simulating = rendering + middle - begin, simulating + time.process_time() - middle
            seen = image.reshape(-1, 3)[tested].astype(np.float64) @ np.array(LUMINANCE)
            levels.append(np.log(seen + simulator.log_epsilon))
        wall = time.perf_counter() - wall
        x, y, t, p = (np.concatenate(column) for column in zip(*columns, strict=True))
        frames = len(levels)
        row = {
            "scene": scene_name(name),
            "frames": frames,
            "frames_of_the_path": len(parameters),
            "events": len(t),
            "cpu_seconds": {"opening": opening, "spacing": spacing, "rendering": rendering, "events": simulating},
            "wall_seconds": wall,
            "frames_per_wall_second": frames / wall,
            "events_per_wall_second": len(t) / wall,
            "self_test": _self_test(
                np.array(levels), times[:frames], tested, y.astype(np.int64) * self.width + x, t, p
            ),
        }
        print(json.dumps(row), flush=True)
        return row


def _self_test(levels, times, tested, pixels, event_times, polarities) -> dict[str, float]:  # type: ignore[no-untyped-def]
    """How far the change of log-radiance between two events of a pixel is from the contrast threshold."""
    threshold, errors, excesses = SensorModel().positive_contrast_threshold, [], []
    order = np.argsort(pixels, kind="stable")
    firsts = np.searchsorted(pixels[order], tested)
    lasts = np.searchsorted(pixels[order], tested, side="right")
    for index, (first, last) in enumerate(zip(firsts, lasts, strict=True)):
        mine = order[first:last]
        if len(mine) > 1:
            stamps = event_times[mine]
            level = np.interp(stamps, times, levels[:, index])
            error = np.abs(np.diff(level) - threshold * polarities[mine][1:].astype(np.float64))
            before = np.searchsorted(times, stamps) - 1
            slope = np.abs(levels[before + 1, index] - levels[before, index]) / (times[before + 1] - times[before])
            # An event is at least 1 ns later than a frame: one whose time is rounded to the frame's moves by up to 1.
            rounding = slope * np.where(stamps == times[before] + 1, 1.0, 0.5)
            errors.append(error)
            excesses.append(error - rounding[1:] - rounding[:-1])
    error = np.concatenate(errors)
    return {
        "pairs": len(error),
        "largest_error": float(error.max()),
        "largest_error_beyond_rounding": max(float(np.concatenate(excesses).max()), 0.0),
        "99.9_percentile": float(np.quantile(error, 0.999)),
        "median_error": float(np.median(error)),
    }


if __name__ == "__main__":
    tyro.cli(SimulationCost).main()
