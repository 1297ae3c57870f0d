"""Small meshes for the tests of the simulator."""

import json
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from aenerf_ns.simulator.rendering.environment import sky
from aenerf_ns.simulator.rendering.mesh import Mesh, scaled

OVERHEAD = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 3], [0, 0, 0, 1]])
"""A camera 3 m above the origin that looks down, its x axis along the world's."""
BLACK = np.zeros(3)
NIGHT = sky(BLACK, BLACK)
WALK = {
    "kind": "walk",
    "positions": [[1.5, 0, 0.3], [0, 1.4, 0.5], [-1.6, 0, 0.2], [0, -1.3, 0.4]],
    "targets": [[0, 0, 0], [0.1, 0, 0], [0, 0, 0.1], [0, 0.1, 0]],
}


def mesh_of(shape: trimesh.Trimesh, color: object = (0.5, 0.5, 0.5)) -> Mesh:
    colors = np.tile(np.asarray(color, np.float64), (len(shape.vertices), 1))
    uv, texture = np.zeros((len(shape.vertices), 2)), np.full(len(shape.faces), -1)
    glow, coat = np.zeros(len(shape.faces)), np.zeros((len(shape.faces), 2))
    return scaled(Mesh(np.array(shape.vertices), np.array(shape.faces), uv, colors, texture, glow, coat, ()), 1.0)


def plate(half: float, picture: np.ndarray | None = None, tiles: float = 1.0) -> Mesh:
    """A square in the plane z = 0 with its front up, and a picture on it."""
    corners = half * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    uv = tiles * np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    textures = () if picture is None else (np.asarray(picture, np.float32),)
    color = np.full((4, 3), 0.5 if picture is None else 1.0)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    texture = np.full(2, len(textures) - 1)
    return scaled(Mesh(corners, faces, uv, color, texture, np.zeros(2), np.zeros((2, 2)), textures), 1.0)


def joined(*meshes: Mesh) -> Mesh:
    vertices, faces = trimesh.util.append_faces([mesh.vertices for mesh in meshes], [mesh.faces for mesh in meshes])
    names = ("uv", "color", "texture", "emission", "gloss")
    parts = {name: np.concatenate([getattr(mesh, name) for mesh in meshes]) for name in names}
    return Mesh(vertices, faces, textures=(), **parts)


def ray_directions(intrinsics: tuple[float, ...], width: int, height: int) -> np.ndarray:
    fx, fy, cx, cy = intrinsics
    y, x = np.mgrid[:height, :width]
    return np.stack([(x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, np.ones((height, width))], axis=-1)


def painted_box() -> trimesh.Trimesh:
    """A box of 1.2 x 0.8 x 0.6 m, each side with vertices of its own and a picture of its own part of a texture."""
    body = trimesh.creation.box((1.2, 0.8, 0.6))
    body.unmerge_vertices()
    normal = np.repeat(body.face_normals, 3, axis=0)
    axis = np.abs(normal).argmax(axis=1)
    rows = np.arange(len(body.vertices))
    uv = (
        np.stack([body.vertices[rows, (axis + 1) % 3], body.vertices[rows, (axis + 2) % 3]], axis=1)
        + 0.1 * axis[:, None]
    )
    picture = np.random.default_rng(0).integers(40, 220, (12, 16, 3)).astype(np.uint8)
    material = trimesh.visual.material.PBRMaterial(
        name="paint", baseColorTexture=Image.fromarray(picture), baseColorFactor=[0.8, 1.0, 0.6, 1.0]
    )
    body.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return body


def scene_file(beside: Path, **values: object) -> str:
    path = beside.with_name("scene.json")
    path.write_text(json.dumps({"mesh": beside.name, "light": "baked", "up": "z", **values}))
    return str(path)
