"""Surfaces as the compiled functions see them: the arrays of a mesh, and the light that its surfaces reflect evenly."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.simulator.arrays import Array
from aenerf_ns.simulator.rendering.mesh import Mesh
from aenerf_ns.simulator.rendering.mip_maps import lookup

FOOTPRINT = 0.5
"""Side of the texture region that a sample averages, in pixels: about the distance between the samples of a pixel."""


class MeshArrays(NamedTuple):
    """The arrays of a mesh that the compiled functions read: V vertices, F faces, G light points."""

    vertices: Array  # (V, 3)
    faces: NDArray[np.int32]  # (F, 3)
    uv: Array  # (V, 2)
    color: NDArray[np.float32]  # (V, 3)
    texture: NDArray[np.int32]  # (F,) -1 for none
    density: NDArray[np.float32]  # (F,) texels per meter
    light_point: NDArray[np.int32]  # (F, 3) light point of each corner


def mesh_arrays(mesh: Mesh, light_point: NDArray[np.integer]) -> MeshArrays:
    """Return the arrays of a mesh, given the light points (F, 3) of its faces' corners."""
    a, b, c = mesh.vertices[mesh.faces.T]
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    p, q, r = mesh.uv[mesh.faces.T]
    in_texture = np.abs((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0])
    texels = np.array([*(len(image) * image.shape[1] for image in mesh.textures), 0.0])
    return MeshArrays(
        mesh.vertices,
        mesh.faces.astype(np.int32),
        mesh.uv,
        mesh.color.astype(np.float32),
        mesh.texture.astype(np.int32),
        np.sqrt(in_texture * texels[mesh.texture] / np.maximum(area, 1e-300)).astype(np.float32),
        light_point.astype(np.int32),
    )


def ray_offset(arrays: MeshArrays) -> float:
    """Return how far before a surface, in meters, a ray must start that leaves the surface."""
    return max(1e-4, 2e-5 * float(np.abs(arrays.vertices).max()))


@numba.njit(cache=True, error_model="numpy")
def face_normal(arrays, face):
    """Return the vector along a face's normal whose length is twice the face's area."""
    v = arrays.vertices
    i, j, k = arrays.faces[face, 0], arrays.faces[face, 1], arrays.faces[face, 2]
    ax, ay, az = v[j, 0] - v[i, 0], v[j, 1] - v[i, 1], v[j, 2] - v[i, 2]
    bx, by, bz = v[k, 0] - v[i, 0], v[k, 1] - v[i, 1], v[k, 2] - v[i, 2]
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@numba.njit(cache=True, error_model="numpy")
def diffuse_radiance(arrays, textures, light, face, side, wi, wj, wk, footprint):
    """Return the light that a point of a face reflects evenly: its albedo times the light that it receives.

    ``side`` is 0 for the front and 1 for the back. ``wi``, ``wj`` and ``wk`` are the point's barycentric coordinates.
    ``footprint`` is the side of the texture region to average, in meters.
    """
    i, j, k = arrays.faces[face, 0], arrays.faces[face, 1], arrays.faces[face, 2]
    li, lj, lk = arrays.light_point[face, 0], arrays.light_point[face, 1], arrays.light_point[face, 2]
    color, uv = arrays.color, arrays.uv
    r = wi * light[side, li, 0] + wj * light[side, lj, 0] + wk * light[side, lk, 0]
    g = wi * light[side, li, 1] + wj * light[side, lj, 1] + wk * light[side, lk, 1]
    b = wi * light[side, li, 2] + wj * light[side, lj, 2] + wk * light[side, lk, 2]
    r *= wi * color[i, 0] + wj * color[j, 0] + wk * color[k, 0]
    g *= wi * color[i, 1] + wj * color[j, 1] + wk * color[k, 1]
    b *= wi * color[i, 2] + wj * color[j, 2] + wk * color[k, 2]
    if arrays.texture[face] >= 0:
        tr, tg, tb = lookup(
            textures,
            arrays.texture[face],
            wi * uv[i, 0] + wj * uv[j, 0] + wk * uv[k, 0],
            wi * uv[i, 1] + wj * uv[j, 1] + wk * uv[k, 1],
            footprint * arrays.density[face],
            True,
        )
        r, g, b = r * tr / 65535.0, g * tg / 65535.0, b * tb / 65535.0
    return r, g, b
