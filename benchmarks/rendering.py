"""Speed of rendering frames: the built-in room beside meshes of about 10^5 and 10^6 triangles.

    python -m benchmarks.rendering --output benchmarks/results/NAME.json

CPU time of all threads, so that what else the machine does matters little; one frame of each in turns. The meshes are
procedural: a textured, dented sphere seen from inside by the room's camera, so that every ray hits it. The light of the
smaller one is computed and timed; that of the larger, which frames cost the same with, is left uniform.
"""

from __future__ import annotations

import json
import statistics
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numba
import numpy as np
import trimesh
import tyro

from aenerf_ns.simulator.open_scene import built_in_scene
from aenerf_ns.simulator.rendering.embree import RayCaster
from aenerf_ns.simulator.rendering.environment import sky
from aenerf_ns.simulator.rendering.light_baking import AreaLight
from aenerf_ns.simulator.rendering.mesh_lighting import baked_mesh, light_mesh, light_points
from aenerf_ns.simulator.rendering.mesh_loading import Mesh, scaled
from benchmarks.environment import environment


@dataclass
class Rendering:
    """Measure the rendering of frames."""

    output: Path
    """JSON file to write."""
    width: int = 346
    height: int = 260
    samples: int = 4
    """Rays a pixel."""
    frames: int = 20
    """Frames of each scene, spread over the room's path."""

    def main(self) -> None:
        """Times the scenes' frames in turns and writes the figures."""
        room = built_in_scene("room")
        seconds: dict[str, dict] = {}
        renderers: dict[str, object] = {"room": room.renderer}
        for name, subdivisions in (("mesh_1e5", 6), ("mesh_1e6", 8)):
            mesh = _cave(subdivisions)
            caster = RayCaster(mesh.vertices, mesh.faces)
            begin, wall = time.process_time(), time.perf_counter()
            if subdivisions == 6:
                lamp = AreaLight((0, 0, 2.2), (0.3, 0, 0), (0, -0.3, 0), (10.0, 9.0, 8.0))
                scene = light_mesh(mesh, caster, sky((0.1,) * 3, (0.1,) * 3), [lamp], np.zeros(3))
                light_cpu, light_wall = time.process_time() - begin, time.perf_counter() - wall
                seconds[name] = {"light_cpu": light_cpu, "light_wall": light_wall}
            else:
                scene = baked_mesh(mesh, caster, np.zeros(3))
                corner = light_points(mesh).corner
                light = np.ones((2, int(corner.max()) + 1, 3), np.float32)
                arrays = scene.arrays._replace(light_point=corner.astype(np.int32))
                scene = replace(scene, arrays=arrays, light=light)
            seconds.setdefault(name, {})
            seconds[name] |= {"faces": len(scene.arrays.faces), "light_points": scene.light.shape[1]}
            renderers[name] = scene
        size = (room.intrinsics(self.width, self.height), self.width, self.height, self.samples)
        times: dict[str, list[tuple[float, float]]] = {name: [] for name in renderers}
        for frame in range(self.frames + 1):
            for name, renderer in renderers.items():
                begin, wall = time.process_time(), time.perf_counter()
                renderer.render(room.path(frame / self.frames), *size)  # type: ignore[attr-defined]
                times[name].append((time.process_time() - begin, time.perf_counter() - wall))
        for name, pairs in times.items():
            cpu, wall_time = zip(*pairs[1:], strict=True)  # the first compiles
            seconds.setdefault(name, {}).update(
                frame_cpu=statistics.median(cpu), frame_cpu_most=max(cpu), frame_wall=statistics.median(wall_time)
            )
        result = {
            "seconds": seconds,
            "frame": {"width": self.width, "height": self.height, "samples": self.samples, "frames": self.frames},
            "numba_threads": numba.get_num_threads(),
            **environment(),
        }
        self.output.write_text(json.dumps(result, indent=2) + "\n")
        print(json.dumps(result, indent=2))


def _cave(subdivisions: int) -> Mesh:
    """A dented sphere of 20 x 4^subdivisions faces with a texture of 2048 x 2048."""
    shape = trimesh.creation.icosphere(subdivisions)
    direction = np.asarray(shape.vertices)
    dents = np.sin(7 * direction[:, 0] + 3) * np.sin(9 * direction[:, 1]) * np.sin(8 * direction[:, 2] + 1)
    vertices = (2.2 + 0.35 * dents)[:, None] * direction + [0, 0, 1.3]
    # From above, so that no face has a seam of the texture in it.
    uv = 0.4 * vertices[:, :2] + 0.3 * vertices[:, 2:]
    picture = np.random.default_rng(0).uniform(0.1, 0.8, (2048, 2048, 3)).astype(np.float32)
    faces = np.asarray(shape.faces)[:, ::-1]
    mesh = Mesh(vertices, faces, uv, np.ones((len(vertices), 3)), np.zeros(len(faces), np.int64), (picture,))
    return scaled(mesh, 1.0)


if __name__ == "__main__":
    tyro.cli(Rendering).main()
