"""Measure the errors of the poses that COLMAP estimates from the frames of a simulated camera.

    python -m benchmarks.estimated_poses --output benchmarks/results/estimated_poses_cpu2.json
    python -m benchmarks.estimated_poses --scenes scenes/*/scene.json --output ...

Estimates poses as ``aenerf simulate --poses colmap`` does, without the events. Where COLMAP fails, the result has the
error message.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.simulator.open_scene import open_scene
from aenerf_ns.simulator.scene import SimulationScene
from aenerf_ns.simulator.simulated_poses import poses_from_frames
from aenerf_ns.simulator.simulation import Simulation
from benchmarks.common import write_result
from benchmarks.paper.plan import scene_name


@dataclass
class EstimatedPoses:
    """Measure the pose errors of COLMAP on simulated frames."""

    output: Path
    """JSON file to write after each case."""
    scenes: tuple[str, ...] = ("room", "object")
    """Scenes as aenerf simulate takes them."""
    cases: tuple[tuple[Literal["easy", "hard"], float], ...] = (("easy", 25.0), ("hard", 25.0), ("hard", 125.0))
    """Speeds, and frames a second."""
    exposure: float = 0.003
    """Exposure of a frame in seconds."""
    width: int = 240
    """Pixel columns."""
    height: int = 180
    """Pixel rows."""
    seed: int = 0
    """Seed of the scene and of COLMAP."""

    def main(self) -> None:
        """Measure and write the figures."""
        settings = {"width": self.width, "height": self.height, "exposure_seconds": self.exposure, "seed": self.seed}
        rows: list[dict] = []
        for name in self.scenes:
            scene = open_scene(name, self.seed)
            for speed, rate in self.cases:
                row = {"scene": scene_name(name), "speed": speed, "frame_rate": rate}
                rows.append({**row, **self._measure(scene, speed, rate)})
                write_result(self.output, {**settings, "rows": rows})

    def _measure(self, scene: SimulationScene, speed: Literal["easy", "hard"], rate: float) -> dict:
        camera = CameraIntrinsics(self.width, self.height, *scene.intrinsics(self.width, self.height))
        simulation = Simulation(scene, camera, SensorModel(), speed, scene.duration, 0.5, self.seed)
        begin = time.perf_counter()
        truth = simulation.trajectory(pose_rate=250)
        try:
            _, report, _ = poses_from_frames(simulation, camera, truth, rate, self.exposure, self.seed)
        except DataError as error:
            report = {"frames": len(simulation.frame_times(rate, self.exposure)), "failed": str(error)}
        return {**report, "seconds": round(time.perf_counter() - begin)}


if __name__ == "__main__":
    tyro.cli(EstimatedPoses).main()
