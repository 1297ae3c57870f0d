"""Errors of the poses that COLMAP estimates from the frames of a simulated camera.

    python benchmarks/estimated_poses.py --output benchmarks/results/estimated_poses_cpu2.json
    python benchmarks/estimated_poses.py --scenes scenes/*/scene.json --output ...

What ``aenerf simulate --poses colmap`` does, without the events. A case in which COLMAP fails is written with what it
said.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import tyro

from aenerf_ns.bench.environment import environment
from aenerf_ns.bench.plan import scene_name
from aenerf_ns.camera.lens import EventCamera
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.simulator.open_scene import open_scene
from aenerf_ns.simulator.scene import SimulationScene
from aenerf_ns.simulator.simulated_poses import poses_from_frames
from aenerf_ns.simulator.simulation import Simulation


@dataclass
class EstimatedPoses:
    """Pose errors of COLMAP on simulated frames."""

    output: Path
    """JSON file to write, after every case."""
    scenes: tuple[str, ...] = ("room", "object")
    """Scenes as aenerf simulate takes them."""
    cases: tuple[tuple[Literal["easy", "hard"], float], ...] = (("easy", 25.0), ("hard", 25.0), ("hard", 125.0))
    """Speeds, and frames a second."""
    exposure: float = 0.003
    """Seconds for which a frame is exposed."""
    width: int = 240
    """Pixel columns."""
    height: int = 180
    """Pixel rows."""
    seed: int = 0
    """Of the scene and of COLMAP."""

    def main(self) -> None:
        """Measures and writes the figures."""
        where = environment()
        where["versions"]["pycolmap"] = version("pycolmap")
        settings = {"width": self.width, "height": self.height, "exposure_seconds": self.exposure, "seed": self.seed}
        rows: list[dict] = []
        for name in self.scenes:
            scene = open_scene(name, self.seed)
            for speed, rate in self.cases:
                row = {"scene": scene_name(name), "speed": speed, "frame_rate": rate}
                rows.append({**row, **self._measure(scene, speed, rate)})
                print(json.dumps(rows[-1]), flush=True)
                self.output.write_text(json.dumps({**settings, "rows": rows, **where}, indent=2) + "\n")

    def _measure(self, scene: SimulationScene, speed: Literal["easy", "hard"], rate: float) -> dict:
        camera = EventCamera(self.width, self.height, *scene.intrinsics(self.width, self.height))
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
