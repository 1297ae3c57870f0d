"""Writing models to GLB files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from benchmarks.scenes.meshes import Model, Part


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
