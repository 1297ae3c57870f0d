"""Surfaces as the compiled functions see them: the arrays of a mesh, and the light that its surfaces reflect evenly."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.simulator.arrays import Array
from aenerf_ns.simulator.rendering.mesh import Mesh, normals_and_areas
from aenerf_ns.simulator.rendering.mip_maps import MipMaps, lookup, mip_maps
from aenerf_ns.simulator.rendering.vectors import cross, interpolate, row, subtract

FOOTPRINT = 0.5
"""Side of the texture region that a sample averages, in pixels: about the distance between the samples of a pixel."""


class Surface(NamedTuple):
    """The arrays of a mesh that the compiled functions read: V vertices, F faces, G light points."""

    vertices: Array  # (V, 3)
    faces: NDArray[np.int32]  # (F, 3)
    uv: Array  # (V, 2)
    color: NDArray[np.float32]  # (V, 3)
    texture: NDArray[np.int32]  # (F,) -1 for none
    density: NDArray[np.float32]  # (F,) texels per meter
    light_point: NDArray[np.int32]  # (F, 3) light point of each corner
    textures: MipMaps

    @property
    def ray_offset(self) -> float:
        """Distance in meters before the surface at which a ray that leaves it must start."""
        return max(1e-4, 2e-5 * float(np.abs(self.vertices).max()))


def make_surface(mesh: Mesh, light_point: NDArray[np.integer]) -> Surface:
    """Build the arrays of a mesh, given the light points (F, 3) of its faces' corners."""
    area = 2 * normals_and_areas(mesh)[1]
    p, q, r = mesh.uv[mesh.faces.T]
    in_texture = np.abs((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0])
    texels = np.array([*(len(image) * image.shape[1] for image in mesh.textures), 0.0])
    return Surface(
        mesh.vertices,
        mesh.faces.astype(np.int32),
        mesh.uv,
        mesh.color.astype(np.float32),
        mesh.texture.astype(np.int32),
        np.sqrt(in_texture * texels[mesh.texture] / np.maximum(area, 1e-300)).astype(np.float32),
        light_point.astype(np.int32),
        mip_maps(mesh.textures, bits16=True),
    )


@numba.njit(cache=True, error_model="numpy")
def face_normal(surface, face):
    """Return the vector along a face's normal whose length is twice the face's area."""
    a, b, c = row(surface.faces, face)
    origin = row(surface.vertices, a)
    return cross(subtract(row(surface.vertices, b), origin), subtract(row(surface.vertices, c), origin))


@numba.njit(cache=True, error_model="numpy")
def diffuse_radiance(surface, light, face, side, weights, footprint):
    """Return the light that a point of a face reflects evenly: its albedo times the light that it receives.

    ``light`` (2, G, 3) is that of the light points, ``side`` 0 for the front and 1 for the back, ``weights`` are the
    point's barycentric coordinates, and ``footprint`` is the side of the texture region to average, in meters.
    """
    corners, uv = row(surface.faces, face), surface.uv
    r, g, b = interpolate(light[side], row(surface.light_point, face), weights)
    red, green, blue = interpolate(surface.color, corners, weights)
    r, g, b = r * red, g * green, b * blue
    if surface.texture[face] >= 0:
        (i, j, k), (wi, wj, wk) = corners, weights
        u = wi * uv[i, 0] + wj * uv[j, 0] + wk * uv[k, 0]
        v = wi * uv[i, 1] + wj * uv[j, 1] + wk * uv[k, 1]
        red, green, blue = lookup(
            surface.textures, surface.texture[face], u, v, footprint * surface.density[face], True
        )
        r, g, b = r * red / 65535.0, g * green / 65535.0, b * blue / 65535.0
    return r, g, b
