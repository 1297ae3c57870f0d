"""Errors of the poses that COLMAP estimates from the frames of a simulated camera.

    python benchmarks/estimated_poses.py --output benchmarks/results/estimated_poses_cpu2.json

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

import torch
import tyro

from aenerf_ns.bench.environment import environment
from aenerf_ns.errors import DataError
from aenerf_ns.event_camera import EventCamera
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.scenes import built_in_scene
from aenerf_ns.simulation import Simulation
from aenerf_ns.structure_from_motion import compare_with_truth, estimate_poses
from aenerf_ns.trajectory.alignment import pose_errors

Speed = Literal["easy", "hard"]


@dataclass
class EstimatedPoses:
    """Pose errors of COLMAP on simulated frames."""

    output: Path
    """JSON file to write, after every case."""
    cases: tuple[tuple[str, Speed, float, float], ...] = (
        ("room", "easy", 25.0, 0.003),
        ("object", "easy", 25.0, 0.003),
        ("object", "hard", 25.0, 0.003),
        ("room", "hard", 25.0, 0.003),
        ("object", "hard", 125.0, 0.003),
        ("room", "hard", 125.0, 0.003),
    )
    """Scene, speed, frames a second, and exposure in seconds."""
    width: int = 240
    """Pixel columns."""
    height: int = 180
    """Pixel rows."""
    duration: float = 4.0
    """Seconds that the path takes at constant speed."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the scene and of COLMAP."""

    def main(self) -> None:
        """Measures and writes the figures."""
        settings = {"width": self.width, "height": self.height, "duration": self.duration}
        where = environment()
        where["versions"]["pycolmap"] = version("pycolmap")
        rows: list[dict] = []
        for case in self.cases:
            for seed in self.seeds:
                rows.append(self._measure(*case, seed))
                print(json.dumps(rows[-1]), flush=True)
                self.output.write_text(json.dumps({**settings, "rows": rows, **where}, indent=2) + "\n")

    def _measure(self, name: str, speed: Speed, rate: float, exposure: float, seed: int) -> dict:
        row = {"scene": name, "speed": speed, "frame_rate": rate, "exposure_seconds": exposure, "seed": seed}
        scene = built_in_scene(name, seed)
        camera = EventCamera(self.width, self.height, *scene.intrinsics(self.width, self.height))
        simulation = Simulation(scene, camera, SensorModel(), speed, self.duration, 0.5, 0.0, seed)
        times = simulation.frame_times(rate, exposure)
        begin = time.perf_counter()
        frames = [simulation.blurred_frame(int(time), exposure) for time in times]
        row["seconds_rendering"] = time.perf_counter() - begin
        try:
            found = estimate_poses(frames, times, camera, "frames", seed)
        except DataError as error:
            return {**row, "frames": len(times), "failed": str(error)}
        true_poses = torch.stack([simulation.pose(time)[:3] for time in found.trajectory.times.tolist()])
        estimated, errors = compare_with_truth(found.trajectory, true_poses)
        truth = simulation.trajectory(pose_rate=250)
        knots = truth.knots_covered_by(estimated)
        between = pose_errors(estimated.interpolate(knots), truth.interpolate(knots))
        return {**row, **found.report(), "errors": errors, "errors_between_frames": between}


if __name__ == "__main__":
    tyro.cli(EstimatedPoses).main()
