"""Measure how far an exported mesh is from the geometry of a simulated scene.

    python -m benchmarks.mesh --data data/room --scene room --run outputs/room/aenerf-small/... \\
        --output benchmarks/results/mesh_room_small_cpu.json

Exports the mesh of a trained run with ``aenerf export-mesh``, and carries it over to the world of the true poses by the
Sim(3) that best maps the corrected trajectory to the true one. Then measures, in meters:

- accuracy: the distance of points on the mesh, evenly spread over its area, from the nearest true surface;
- completeness: the distance of true points that the camera saw on its way from the mesh;
- chamfer distance: the mean of the two mean distances.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import trimesh

from aenerf_ns.camera.alignment import align
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.files.tum_trajectory import read_tum_trajectory
from aenerf_ns.simulator.open_scene import open_scene
from aenerf_ns.simulator.rendering.embree import RayCaster
from benchmarks.runs import run_benchmark, run_script, write_result

_NUM_POINTS = 100_000
_NUM_VIEWS = 100
# Meters within which a point counts as found.
_NEAR = (0.02, 0.05, 0.1)


@dataclass
class Mesh:
    """Measure the chamfer distance of a run's mesh."""

    data: Path
    """Dataset that aenerf simulate wrote, with true poses."""
    scene: str
    """Scene of the dataset, as aenerf simulate takes it."""
    run: Path
    """The run: its folder or its config.yml."""
    output: Path
    """JSON file to write."""
    resolution: int = 256
    """Of aenerf export-mesh."""
    num_views: int = 60
    """Of aenerf export-mesh."""
    seed: int = 0
    """Seed of the scene."""

    def main(self) -> None:
        """Export, measure and write."""
        with TemporaryDirectory() as name:
            folder = Path(name)
            mesh_file, poses_file = folder / "mesh.ply", folder / "corrected.txt"
            options = ("--resolution", str(self.resolution), "--num-views", str(self.num_views))
            seconds = run_script(Path(), "aenerf", "export-mesh", str(self.run), "--output", str(mesh_file), *options)
            run_script(Path(), "aenerf", "export-trajectory", str(self.run), "--output", str(poses_file))
            mesh = trimesh.load(mesh_file)
            assert isinstance(mesh, trimesh.Trimesh)
            corrected = read_tum_trajectory(poses_file)
        truth = read_tum_trajectory(self.data / "trajectory_ground_truth.txt")
        times = corrected.knots_covered_by(truth)
        to_true = align(corrected.interpolate(times), truth.interpolate(times))
        vertices = to_true.scale * torch.from_numpy(np.array(mesh.vertices)) @ to_true.rotation.mT + to_true.translation
        mesh = trimesh.Trimesh(vertices.numpy(), mesh.faces, process=False)
        caster = open_scene(self.scene, self.seed).renderer.caster
        on_mesh, _ = trimesh.sample.sample_surface(mesh, _NUM_POINTS, seed=0)
        accuracy = caster.distance(on_mesh)
        seen = self._seen(caster, truth.interpolate(times[:: max(len(times) // _NUM_VIEWS, 1)]).numpy())
        completeness = RayCaster(mesh.vertices, mesh.faces).distance(seen)
        run = self.run if self.run.is_dir() else self.run.parent
        write_result(
            self.output,
            {
                "scene": self.scene,
                "run": json.loads((run / "run.json").read_text("utf8"))["command"],
                "resolution": self.resolution,
                "num_views": self.num_views,
                "triangles": len(mesh.faces),
                "seconds": round(seconds, 1),
                "scale_of_alignment": float(to_true.scale),
                "accuracy": _summary(accuracy),
                "completeness": _summary(completeness),
                "chamfer_distance": float(accuracy.mean() + completeness.mean()) / 2,
            },
        )

    def _seen(self, caster: RayCaster, poses: np.ndarray) -> np.ndarray:
        """Return true points (N, 3) that cameras at poses (M, 3, 4) see, evenly spread over their pictures."""
        meta = json.loads((self.data / "transforms.json").read_text("utf8"))["event_camera"]
        intrinsics = (meta[name] for name in ("fl_x", "fl_y", "cx", "cy"))
        directions, _ = CameraIntrinsics(meta["width"], meta["height"], *intrinsics).pixel_directions()
        # OpenGL's axes become OpenCV's.
        in_camera = directions.reshape(-1, 3) * [1, -1, -1]
        generator = np.random.default_rng(0)
        points = []
        for pose in poses:
            chosen = in_camera[generator.choice(len(in_camera), _NUM_POINTS // len(poses), replace=False)]
            along = chosen @ pose[:, :3].T
            hits = caster.cast(np.hstack([np.broadcast_to(pose[:, 3], along.shape), along]).astype(np.float32))
            distance = hits.distance[:, None]
            points.append((pose[:, 3] + distance * along)[np.isfinite(distance[:, 0])])
        return np.concatenate(points)


def _summary(distances: np.ndarray) -> dict[str, Any]:
    """Return the mean and the median of distances in meters, and the shares below some."""
    return {
        "mean": float(distances.mean()),
        "median": float(np.median(distances)),
        **{f"share_within_{near:g}": float((distances < near).mean()) for near in _NEAR},
    }


if __name__ == "__main__":
    run_benchmark(Mesh)
