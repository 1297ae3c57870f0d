"""Triangle meshes with colors and textures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.simulator.arrays import Array, Texture
from aenerf_ns.simulator.rendering.embree import RayCaster


class Gloss(NamedTuple):
    """The glossy coat of a material."""

    specular: float = 0.0
    """Share of light that the coat reflects at normal incidence (F0), in all colors; 0 for a diffuse surface."""
    roughness: float = 0.0
    """Square root of the slopes' root mean square in the microfacet model (alpha = roughness^2); 0 for a mirror."""


DIFFUSE = Gloss()


@dataclass(frozen=True)
class Mesh:
    """Triangles in the world, z up, in meters once the mesh is `scaled`.

    The albedo of a surface point is its texture's value times the color interpolated between the vertices.

    Attributes:
        vertices: (V, 3). Surfaces of different materials share no vertices, nor do the two sides of a texture's seam.
        faces: (F, 3) vertices, counterclockwise seen from the front.
        uv: (V, 2) texture coordinates in widths and heights of the texture, from its lower left corner.
        color: (V, 3) linear RGB.
        texture: (F,) index into ``textures``, -1 for none.
        emission: (F,) irradiance / pi that a face seems to receive in addition. It makes the face glow and lights
            nothing else.
        gloss: (F, 2) `Gloss` of each face.
        textures: linear RGB, float32 (rows, columns, 3), the lowest row first. They repeat.
    """

    vertices: Array
    faces: NDArray[np.int64]
    uv: Array
    color: Array
    texture: NDArray[np.int64]
    emission: Array
    gloss: Array
    textures: tuple[Texture, ...]

    @cached_property
    def caster(self) -> RayCaster:
        """Casts rays against the mesh."""
        return RayCaster(self.vertices, self.faces)

    def with_faces_kept(self, kept: NDArray) -> Mesh:
        """Return the mesh with the faces that an index or a mask (F,) selects."""
        of_faces = {name: getattr(self, name)[kept] for name in ("faces", "texture", "emission", "gloss")}
        return replace(self, **of_faces)


def scaled(mesh: Mesh, scale: float) -> Mesh:
    """Scale a mesh by ``scale`` meters per unit. Round its vertices to float32, as the ray caster does."""
    return replace(mesh, vertices=(scale * mesh.vertices).astype(np.float32).astype(np.float64))


def normals_and_areas(mesh: Mesh) -> tuple[Array, Array]:
    """Return unit normals (F, 3), zero where a face is degenerate, and areas (F,)."""
    a, b, c = mesh.vertices[mesh.faces.T]
    cross = np.cross(b - a, c - a)
    norm = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(norm, 1e-300)[:, None], norm / 2


def position_ids(vertices: Array) -> NDArray[np.int64]:
    """Number (V,) the positions of vertices (V, 3): equal positions have the same number."""
    keys = np.ascontiguousarray(vertices.astype(np.float32) + np.float32(0)).view(np.uint32)  # -0 is 0
    # The numbers follow z, then y, then x.
    return np.unique(keys[:, ::-1], axis=0, return_inverse=True)[1].reshape(-1)
