"""A lit mesh: primary rays by Embree, shading by compiled code.

Everything is Lambertian, and the light that the surfaces receive is computed beforehand, by `mesh_lighting`: see
`raycast`, which does the same for analytic primitives, also for the conventions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aenerf_ns.simulator.rendering.embree import NOTHING, RayCaster
from aenerf_ns.simulator.rendering.environment import Environment
from aenerf_ns.simulator.rendering.mesh_loading import Array, Mesh
from aenerf_ns.simulator.rendering.mip_maps import MipMaps, lookup, mip_maps, panorama
from aenerf_ns.simulator.rendering.renderer import sample_offsets

_FOOTPRINT = 0.5
"""Side of the texture region a sample averages, in pixels: about the distance between the samples of a pixel."""


class MeshArrays(NamedTuple):
    """What the compiled functions read: V vertices, F faces, G points that light is known at."""

    vertices: Array  # (V, 3)
    faces: NDArray[np.int32]  # (F, 3)
    uv: Array  # (V, 2)
    colour: NDArray[np.float32]  # (V, 3)
    texture: NDArray[np.int32]  # (F,) -1 for none
    density: NDArray[np.float32]  # (F,) texels per metre
    light_point: NDArray[np.int32]  # (F, 3) of each corner


def mesh_arrays(mesh: Mesh, light_point: NDArray[np.integer]) -> MeshArrays:
    """The arrays of a mesh, with the light points (F, 3) of its faces' corners."""
    a, b, c = mesh.vertices[mesh.faces.T]
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    p, q, r = mesh.uv[mesh.faces.T]
    in_texture = np.abs((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0])
    texels = np.array([*(len(image) * image.shape[1] for image in mesh.textures), 0.0])
    return MeshArrays(
        mesh.vertices,
        mesh.faces.astype(np.int32),
        mesh.uv,
        mesh.colour.astype(np.float32),
        mesh.texture.astype(np.int32),
        np.sqrt(in_texture * texels[mesh.texture] / np.maximum(area, 1e-300)).astype(np.float32),
        light_point.astype(np.int32),
    )


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _camera_rays(rotation, centre, intrinsics, offsets, width, height, rays):
    """Rays (height * width * samples, 6) whose directions reach one metre along the optical axis."""
    fx, fy, cx, cy = intrinsics
    samples = len(offsets)
    for y in numba.prange(height):
        for x in range(width):
            for s in range(samples):
                u = (x + 0.5 + offsets[s, 0] - cx) / fx
                v = (y + 0.5 + offsets[s, 1] - cy) / fy
                ray = rays[(y * width + x) * samples + s]
                for axis in range(3):
                    ray[axis] = centre[axis]
                    ray[3 + axis] = rotation[axis, 0] * u + rotation[axis, 1] * v + rotation[axis, 2]


@numba.njit(cache=True, error_model="numpy")
def _meet(vertices, a, b, c, ox, oy, oz, dx, dy, dz):
    """Barycentric coordinates of where a ray meets a triangle's plane, drawn to the nearest point of the triangle along
    its coordinates, and the normal, as long as twice the area (Möller and Trumbore, 1997)."""
    ax, ay, az = vertices[a, 0], vertices[a, 1], vertices[a, 2]
    ux, uy, uz = vertices[b, 0] - ax, vertices[b, 1] - ay, vertices[b, 2] - az
    vx, vy, vz = vertices[c, 0] - ax, vertices[c, 1] - ay, vertices[c, 2] - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    sx, sy, sz = ox - ax, oy - ay, oz - az
    determinant = -(nx * dx + ny * dy + nz * dz)
    qx, qy, qz = sy * dz - sz * dy, sz * dx - sx * dz, sx * dy - sy * dx
    second = (vx * qx + vy * qy + vz * qz) / determinant
    third = -(ux * qx + uy * qy + uz * qz) / determinant
    # A ray that all but lies in the plane may meet it anywhere, or nowhere.
    second = second if 0.0 <= second < 1e9 else 0.0
    third = third if 0.0 <= third < 1e9 else 0.0
    total = second + third
    if total > 1.0:
        second, third = second / total, third / total
    return second, third, nx, ny, nz


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _shade(
    arrays, textures, light, hits, rotation, centre, intrinsics, offsets, background, sky, limit, radiance, depth, alpha
):
    """Colours of the rays of `_camera_rays`. ``sky`` is a panorama behind the mesh, or empty: then ``background``."""
    vertices, faces, uv, colour, texture, density, light_point = arrays
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics
    samples = len(offsets)
    ox, oy, oz = centre[0], centre[1], centre[2]
    has_sky = len(sky.level) > 0
    for y in numba.prange(height):
        for x in range(width):
            red, green, blue, total_depth, found = 0.0, 0.0, 0.0, 0.0, 0
            for s in range(samples):
                u = (x + 0.5 + offsets[s, 0] - cx) / fx
                v = (y + 0.5 + offsets[s, 1] - cy) / fy
                dx = rotation[0, 0] * u + rotation[0, 1] * v + rotation[0, 2]
                dy = rotation[1, 0] * u + rotation[1, 1] * v + rotation[1, 2]
                dz = rotation[2, 0] * u + rotation[2, 1] * v + rotation[2, 2]
                face = hits[(y * width + x) * samples + s]
                if face == NOTHING:
                    if has_sky:
                        per_radian = sky.level[0, 2] / (2.0 * math.pi)
                        r, g, b = panorama(sky, dx, dy, dz, _FOOTPRINT / fx * per_radian)
                        red += min(r, limit)
                        green += min(g, limit)
                        blue += min(b, limit)
                    else:
                        red += background[0]
                        green += background[1]
                        blue += background[2]
                    continue
                i, j, k = faces[face, 0], faces[face, 1], faces[face, 2]
                wj, wk, nx, ny, nz = _meet(vertices, i, j, k, ox, oy, oz, dx, dy, dz)
                wi = 1.0 - wj - wk
                px = wi * vertices[i, 0] + wj * vertices[j, 0] + wk * vertices[k, 0] - ox
                py = wi * vertices[i, 1] + wj * vertices[j, 1] + wk * vertices[k, 1] - oy
                pz = wi * vertices[i, 2] + wj * vertices[j, 2] + wk * vertices[k, 2] - oz
                distance = rotation[0, 2] * px + rotation[1, 2] * py + rotation[2, 2] * pz
                facing = nx * dx + ny * dy + nz * dz
                side = 0 if facing < 0.0 else 1
                li, lj, lk = light_point[face, 0], light_point[face, 1], light_point[face, 2]
                r = wi * light[side, li, 0] + wj * light[side, lj, 0] + wk * light[side, lk, 0]
                g = wi * light[side, li, 1] + wj * light[side, lj, 1] + wk * light[side, lk, 1]
                b = wi * light[side, li, 2] + wj * light[side, lj, 2] + wk * light[side, lk, 2]
                r *= wi * colour[i, 0] + wj * colour[j, 0] + wk * colour[k, 0]
                g *= wi * colour[i, 1] + wj * colour[j, 1] + wk * colour[k, 1]
                b *= wi * colour[i, 2] + wj * colour[j, 2] + wk * colour[k, 2]
                if texture[face] >= 0:
                    # A pixel covers depth / focal length, stretched where the surface is seen at a slant; the geometric
                    # mean of its two sides keeps textures crisp there without aliasing.
                    lengths = math.sqrt((nx * nx + ny * ny + nz * nz) * (dx * dx + dy * dy + dz * dz))
                    slant = max(abs(facing) / lengths, 0.02)
                    tr, tg, tb = lookup(
                        textures,
                        texture[face],
                        wi * uv[i, 0] + wj * uv[j, 0] + wk * uv[k, 0],
                        wi * uv[i, 1] + wj * uv[j, 1] + wk * uv[k, 1],
                        _FOOTPRINT * distance / (fx * math.sqrt(slant)) * density[face],
                        True,
                    )
                    r, g, b = r * tr / 65535.0, g * tg / 65535.0, b * tb / 65535.0
                red += r
                green += g
                blue += b
                total_depth += distance
                found += 1
            radiance[y, x, 0] = red / samples
            radiance[y, x, 1] = green / samples
            radiance[y, x, 2] = blue / samples
            depth[y, x] = total_depth / found if found > 0 else math.inf
            alpha[y, x] = found / samples


@dataclass(frozen=True)
class MeshScene:
    """A mesh, the light on both its sides, and what is seen where a ray hits nothing.

    Attributes:
        arrays: the mesh.
        textures: its textures.
        caster: its rays.
        light: (2, G, 3) irradiance / pi at the light points: in front, behind.
        background: (3,) radiance that is seen where a ray hits nothing, unless there are
        surroundings: a panorama, which is seen there instead.
        limit: radiance that the surroundings are cut off at.
    """

    arrays: MeshArrays
    textures: MipMaps
    caster: RayCaster
    light: NDArray[np.float32]
    background: Array
    surroundings: MipMaps
    limit: float

    def render(
        self,
        camera_to_world: ArrayLike,
        intrinsics: Sequence[float],
        width: int,
        height: int,
        samples: int,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Picture through a pinhole camera: see :class:`~aenerf_ns.simulator.rendering.renderer.Renderer`."""
        pose = np.asarray(camera_to_world, np.float64)
        rotation, centre = np.ascontiguousarray(pose[:3, :3]), np.ascontiguousarray(pose[:3, 3])
        lens, offsets = np.asarray(intrinsics, np.float64), sample_offsets(samples)
        rays = np.empty((height * width * len(offsets), 6), np.float32)
        _camera_rays(rotation, centre, lens, offsets, width, height, rays)
        hits = self.caster.cast(rays)["primitive_ids"]
        radiance = np.empty((height, width, 3), np.float32)
        depth, alpha = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
        _shade(
            self.arrays,
            self.textures,
            self.light,
            hits,
            rotation,
            centre,
            lens,
            offsets,
            self.background,
            self.surroundings,
            self.limit,
            radiance,
            depth,
            alpha,
        )
        return radiance, depth, alpha


def surroundings(environment: Environment | None) -> MipMaps:
    """What is seen behind a mesh; empty for a uniform background."""
    return mip_maps([] if environment is None else [environment.radiance], bits16=False)
