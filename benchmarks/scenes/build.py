"""Build the benchmark's scenes from assets of package registries.

    python -m benchmarks.scenes.build --output FOLDER [--scenes NAME ...] [--assets FOLDER]

Each scene becomes FOLDER/NAME/scene.json with its mesh and environment, for `aenerf simulate`. The same assets and
libraries give the same bytes. CREDITS.md names the makers of the assets.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from aenerf_ns.errors import DataError
from benchmarks.runs import run_benchmark
from benchmarks.scenes.assets import Library, cv2
from benchmarks.scenes.catalog import SCENES
from benchmarks.scenes.meshes import Model, Part

_BRIGHTEST = 300.0
"""Upper limit of an environment's radiance: a sun of a few texels would make hard shadows and leave the rest dark."""


@dataclass
class Build:
    """Build benchmark scenes."""

    output: Path
    """Folder in which each scene gets a folder of its own."""
    scenes: tuple[str, ...] = tuple(SCENES)
    """Names of the scenes to build."""
    assets: Path = field(default_factory=lambda: Path.home() / ".cache" / "aenerf-ns" / "scene-assets")
    """Folder that keeps the fetched packages."""

    def main(self) -> None:
        """Fetch missing packages and write the scenes."""
        for name in self.scenes:
            if name not in SCENES:
                raise DataError("--scenes", f"no scene is called {name!r}", f"choose among {', '.join(SCENES)}")
        for name in self.scenes:
            build_scene(name, Library(self.assets), self.output / name)


def build_scene(name: str, library: Library, folder: Path) -> None:
    """Write a scene's mesh, environment and scene.json into a folder.

    Raises:
        DataError: if an asset is missing and cannot be fetched.
    """
    scene = SCENES[name]
    panorama = np.clip(library.environment(scene.environment), 0, _BRIGHTEST)
    model = scene.model(library)
    folder.mkdir(parents=True, exist_ok=True)
    write_glb(folder / "scene.glb", model)
    _, encoded = cv2.imencode(".hdr", panorama[..., ::-1])
    (folder / f"{scene.environment}.hdr").write_bytes(encoded.tobytes())
    credits = [library.credits[asset] for asset in sorted(library.credits)]
    description = scene.description("scene.glb", f"{scene.environment}.hdr", credits)
    (folder / "scene.json").write_text(json.dumps(description, indent=1) + "\n")
    print(f"{folder}: {len(model.triangles):,} triangles, {len(credits)} assets")


def write_glb(path: Path, model: Model) -> None:
    """Write a model to a binary glTF 2.0 file, y up: a mesh for each material, with its picture as PNG.

    The same model gives the same bytes.

    Raises:
        ValueError: if two different materials share a name.
    """
    by_name: dict[str, list[Part]] = {}
    for part in model.parts:
        parts = by_name.setdefault(part.material.name, [])
        if parts and not np.array_equal(parts[0].material.picture, part.material.picture):
            raise ValueError(f'two materials are called "{part.material.name}"')
        parts.append(part)
    scene = trimesh.Scene()
    # trimesh reads the meshes of a scene in the reverse of the order in which they were added.
    for name, parts in reversed(by_name.items()):
        corners = np.concatenate([np.concatenate([part.points, part.uv], axis=2).reshape(-1, 5) for part in parts])
        # The file's y axis points up, its v axis down. trimesh turns v itself.
        corners = corners[:, [0, 2, 1, 3, 4]] * (1, 1, -1, 1, -1) + (0, 0, 0, 0, 1)
        unique, faces = np.unique(corners.astype(np.float32), axis=0, return_inverse=True)
        material = trimesh.visual.material.PBRMaterial(
            name=name,
            baseColorTexture=Image.fromarray(np.ascontiguousarray(parts[0].material.picture)),
            metallicFactor=0,
            roughnessFactor=1,
            doubleSided=True,
        )
        uv = unique[:, 3:].astype(np.float64) * (1, -1) + (0, 1)
        visual = trimesh.visual.TextureVisuals(uv, material)
        mesh = trimesh.Trimesh(unique[:, :3], faces.reshape(-1, 3), visual=visual, process=False)
        scene.add_geometry(mesh, node_name=name)
    path.write_bytes(scene.export(file_type="glb"))


if __name__ == "__main__":
    run_benchmark(Build)
