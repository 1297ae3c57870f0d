"""Measure frames and events a second of the simulator on any scenes.

    python -m benchmarks.simulation --scenes room scenes/*/scene.json --output benchmarks/results/simulation_cpu2.json

The first frames of each scene's path are rendered and turned into events, as ``aenerf simulate`` does.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.simulator.esim import EventSimulator
from aenerf_ns.simulator.frames import frame_parameters
from aenerf_ns.simulator.open_scene import open_scene
from aenerf_ns.simulator.simulation import RAYS_PER_PIXEL
from benchmarks.paper.plan import scene_name
from benchmarks.runs import run_benchmark, write_result


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
        simulator = EventSimulator(self.width, self.height, SensorModel())
        num_events, rendering, simulating = 0, 0.0, 0.0
        wall = time.perf_counter()
        for parameter, stamp in zip(parameters[: self.frames], times, strict=False):
            begin = time.process_time()
            pose = scene.path(float(parameter))
            image = scene.renderer.render(pose, intrinsics, self.width, self.height, RAYS_PER_PIXEL)[0]
            middle = time.process_time()
            num_events += len(simulator(image, int(stamp))[2])
            rendering, simulating = rendering + middle - begin, simulating + time.process_time() - middle
        wall = time.perf_counter() - wall
        frames = min(self.frames, len(parameters))
        return {
            "scene": scene_name(name),
            "frames": frames,
            "frames_of_the_path": len(parameters),
            "events": num_events,
            "cpu_seconds": {"opening": opening, "spacing": spacing, "rendering": rendering, "events": simulating},
            "wall_seconds": wall,
            "frames_per_wall_second": frames / wall,
            "events_per_wall_second": num_events / wall,
        }


if __name__ == "__main__":
    run_benchmark(SimulationCost)
