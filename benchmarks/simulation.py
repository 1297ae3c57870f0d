"""Measure frames and events a second of the simulator, and test its events, on any scenes.

    python -m benchmarks.simulation --scenes room scenes/*/scene.json --output benchmarks/results/simulation_cpu2.json

The first frames of each scene's path are rendered and turned into events, as ``aenerf simulate`` does. The self-test
takes the log-radiance of some pixels in every frame. It compares the change of log-radiance between two events of a
pixel with the contrast threshold. Times of events are rounded to whole nanoseconds, so the change may differ from the
threshold by what the log-radiance changes in half a nanosecond at each event. Beyond that rounding, an error must be
below 1e-6.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np
import tyro
from numpy.typing import NDArray

from aenerf_ns.camera.image_encoding import LUMINANCE
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.simulator.esim import EventSimulator
from aenerf_ns.simulator.frames import frame_parameters
from aenerf_ns.simulator.open_scene import open_scene
from aenerf_ns.simulator.simulation import RAYS_PER_PIXEL
from benchmarks.common import write_result
from benchmarks.paper.plan import scene_name

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
        """Measure and write the figures."""
        rows = [self._measure(name) for name in self.scenes]
        size = {"width": self.width, "height": self.height, "numba_threads": numba.get_num_threads()}
        write_result(self.output, {"rows": rows, **size})

    def _measure(self, name: str) -> dict[str, Any]:
        begin = time.process_time()
        scene = open_scene(name)
        opening = time.process_time() - begin
        camera = CameraIntrinsics(self.width, self.height, *scene.intrinsics(self.width, self.height))
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
            pose = scene.path(float(parameter))
            image = scene.renderer.render(pose, intrinsics, self.width, self.height, RAYS_PER_PIXEL)[0]
            middle = time.process_time()
            columns.append(simulator(image, int(stamp)))
            rendering, simulating = rendering + middle - begin, simulating + time.process_time() - middle
            seen = image.reshape(-1, 3)[tested].astype(np.float64) @ np.array(LUMINANCE)
            levels.append(np.log(seen + simulator.log_epsilon))
        wall = time.perf_counter() - wall
        x, y, t, p = (np.concatenate(column) for column in zip(*columns, strict=True))
        frames = len(levels)
        return {
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


def _self_test(
    levels: NDArray[np.float64],
    times: NDArray[np.int64],
    tested: NDArray[np.int64],
    pixels: NDArray[np.int64],
    event_times: NDArray[np.int64],
    polarities: NDArray[np.int8],
) -> dict[str, float]:
    """Compare the change of log-radiance between two events of a pixel with the contrast threshold.

    Args:
        levels: (F, P) log-radiance of the tested pixels in each frame.
        times: (F,) of the frames in nanoseconds.
        tested: (P,) indices of the tested pixels.
        pixels: (N,) indices of the events' pixels.
        event_times: (N,) in nanoseconds, in order.
        polarities: (N,) -1 or 1.
    """
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
            # An event comes at least 1 ns after a frame: rounding moves the earliest ones by up to 1 ns.
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
