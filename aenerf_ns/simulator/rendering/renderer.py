"""Pictures of a lit mesh: Embree casts the primary rays, compiled code shades the hits.

The light that a surface receives does not depend on the view. `lighting` computes that light once, and diffuse surfaces
need primary rays only. Glossy surfaces take a second ray each (`reflections`). Radiance is linear RGB, lengths are
meters, and the world's z axis points up. A camera has OpenCV axes (x right, y down, z forward). The center of pixel
(x, y) lies at (x + 0.5, y + 0.5), as in Nerfstudio.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aenerf_ns.simulator.arrays import Array
from aenerf_ns.simulator.rendering.embree import NOTHING, RayCaster
from aenerf_ns.simulator.rendering.environment import Environment
from aenerf_ns.simulator.rendering.mip_maps import MipMaps, mip_maps, panorama
from aenerf_ns.simulator.rendering.reflections import Reflections, add_reflections
from aenerf_ns.simulator.rendering.surface import FOOTPRINT, MeshArrays, diffuse_radiance

POINT_SPREAD = 0.5
"""Standard deviation of a pixel's Gaussian point-spread function, in pixels."""


# Not parallel: starting threads for this little work takes longer than the work, above all on a busy machine.
@numba.njit(cache=True, error_model="numpy")
def _camera_rays(rotation, center, intrinsics, offsets, window, rays):
    """Fill the rays (N, 6) of a window of the picture. Directions reach one meter along the optical axis."""
    fx, fy, cx, cy = intrinsics
    samples = len(offsets)
    left, right, top, bottom = window
    for y in range(top, bottom):
        for x in range(left, right):
            for s in range(samples):
                u = (x + 0.5 + offsets[s, 0] - cx) / fx
                v = (y + 0.5 + offsets[s, 1] - cy) / fy
                ray = rays[((y - top) * (right - left) + x - left) * samples + s]
                for axis in range(3):
                    ray[axis] = center[axis]
                    ray[3 + axis] = rotation[axis, 0] * u + rotation[axis, 1] * v + rotation[axis, 2]


@numba.njit(cache=True, error_model="numpy")
def _meet(vertices, a, b, c, ox, oy, oz, dx, dy, dz):
    """Intersect a ray with a triangle's plane (Möller and Trumbore, 1997).

    Returns:
        the second and third barycentric coordinates, clamped to the triangle, and the normal, whose length is twice the
        area.
    """
    ax, ay, az = vertices[a, 0], vertices[a, 1], vertices[a, 2]
    ux, uy, uz = vertices[b, 0] - ax, vertices[b, 1] - ay, vertices[b, 2] - az
    vx, vy, vz = vertices[c, 0] - ax, vertices[c, 1] - ay, vertices[c, 2] - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    sx, sy, sz = ox - ax, oy - ay, oz - az
    determinant = -(nx * dx + ny * dy + nz * dz)
    qx, qy, qz = sy * dz - sz * dy, sz * dx - sx * dz, sx * dy - sy * dx
    second = (vx * qx + vy * qy + vz * qz) / determinant
    third = -(ux * qx + uy * qy + uz * qz) / determinant
    # A ray nearly parallel to the plane may meet it anywhere or nowhere.
    second = second if 0.0 <= second < 1e9 else 0.0
    third = third if 0.0 <= third < 1e9 else 0.0
    total = second + third
    if total > 1.0:
        second, third = second / total, third / total
    return second, third, nx, ny, nz


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _shade(
    arrays,
    textures,
    light,
    hits,
    window,
    rotation,
    center,
    intrinsics,
    offsets,
    background,
    sky,
    limit,
    radiance,
    depth,
    alpha,
):
    """Shade the hits of `_camera_rays` and fill ``radiance``, ``depth`` and ``alpha``.

    A ray that hits nothing sees the panorama ``sky``, or ``background`` if ``sky`` is empty.
    """
    vertices, faces, texture = arrays.vertices, arrays.faces, arrays.texture
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics
    samples = len(offsets)
    ox, oy, oz = center[0], center[1], center[2]
    has_sky = len(sky.level) > 0
    left, right, top, bottom = window
    for y in numba.prange(height):
        for x in range(width):
            red, green, blue, total_depth, found = 0.0, 0.0, 0.0, 0.0, 0
            for s in range(samples):
                u = (x + 0.5 + offsets[s, 0] - cx) / fx
                v = (y + 0.5 + offsets[s, 1] - cy) / fy
                dx = rotation[0, 0] * u + rotation[0, 1] * v + rotation[0, 2]
                dy = rotation[1, 0] * u + rotation[1, 1] * v + rotation[1, 2]
                dz = rotation[2, 0] * u + rotation[2, 1] * v + rotation[2, 2]
                face = NOTHING
                if left <= x < right and top <= y < bottom:
                    face = hits[((y - top) * (right - left) + x - left) * samples + s]
                if face == NOTHING:
                    if has_sky:
                        per_radian = sky.level[0, 2] / (2.0 * math.pi)
                        r, g, b = panorama(sky, dx, dy, dz, FOOTPRINT / fx * per_radian)
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
                footprint = 0.0
                if texture[face] >= 0:
                    # A pixel covers depth / focal length, stretched where the surface is seen at a slant; the geometric
                    # mean of its two sides keeps textures crisp there without aliasing.
                    lengths = math.sqrt((nx * nx + ny * ny + nz * nz) * (dx * dx + dy * dy + dz * dz))
                    slant = max(abs(facing) / lengths, 0.02)
                    footprint = FOOTPRINT * distance / (fx * math.sqrt(slant))
                r, g, b = diffuse_radiance(arrays, textures, light, face, side, wi, wj, wk, footprint)
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
class Renderer:
    """Render a lit mesh.

    Attributes:
        arrays: the mesh.
        textures: textures of the mesh.
        caster: casts rays against the mesh.
        light: (2, G, 3) irradiance / pi at the light points, in front of the faces and behind them.
        background: (3,) radiance where a ray hits nothing and ``surroundings`` is empty.
        surroundings: panorama that is seen where a ray hits nothing, or empty.
        limit: the radiance of the surroundings and of glossy surfaces is clipped to this value.
        reflections: reflections of glossy surfaces, or None if all surfaces are diffuse.
    """

    arrays: MeshArrays
    textures: MipMaps
    caster: RayCaster
    light: NDArray[np.float32]
    background: Array
    surroundings: MipMaps
    limit: float
    reflections: Reflections | None

    def render(
        self,
        camera_to_world: ArrayLike,
        intrinsics: Sequence[float],
        width: int,
        height: int,
        samples: int,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Render a picture through a pinhole camera.

        Args:
            camera_to_world: (4, 4) or (3, 4), OpenCV axes.
            intrinsics: (fx, fy, cx, cy) in pixels, pixel centers at +0.5.
            width, height: size of the picture in pixels.
            samples: rays per pixel, 1 or at least 3. Every pixel of every frame has the same pattern of rays, which
                samples a Gaussian point-spread function. A single ray goes through the pixel's center.

        Returns:
            radiance (H, W, 3), linear RGB; depth (H, W) along the optical axis, the mean over the rays that hit, inf
            where none does; alpha (H, W), the fraction of rays that hit. All are float32.

        Raises:
            ValueError: `sample_offsets` has no pattern with this number of samples.
        """
        pose = np.asarray(camera_to_world, np.float64)
        rotation, center = np.ascontiguousarray(pose[:3, :3]), np.ascontiguousarray(pose[:3, 3])
        lens, offsets = np.asarray(intrinsics, np.float64), sample_offsets(samples)
        window = self._window(rotation, center, lens, offsets, width, height)
        left, right, top, bottom = window
        rays = np.empty(((bottom - top) * (right - left) * len(offsets), 6), np.float32)
        _camera_rays(rotation, center, lens, offsets, window, rays)
        hits = self.caster.cast(rays)
        radiance = np.empty((height, width, 3), np.float32)
        depth, alpha = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
        _shade(
            self.arrays,
            self.textures,
            self.light,
            hits["primitive_ids"],
            window,
            rotation,
            center,
            lens,
            offsets,
            self.background,
            self.surroundings,
            self.limit,
            radiance,
            depth,
            alpha,
        )
        if self.reflections is not None:
            add_reflections(
                self.reflections,
                self.arrays,
                self.textures,
                self.light,
                self.caster,
                rays,
                hits,
                lens[0],
                len(offsets),
                self.limit,
                radiance[top:bottom, left:right],
            )
        return radiance, depth, alpha

    @cached_property
    def _corners(self) -> Array:
        """The corners (8, 3) of the mesh's bounding box."""
        used = self.arrays.vertices[self.arrays.faces.reshape(-1)]
        return np.array(list(itertools.product(*np.stack([used.min(axis=0), used.max(axis=0)], axis=1))))

    def _window(
        self, rotation: Array, center: Array, lens: Array, offsets: Array, width: int, height: int
    ) -> tuple[int, int, int, int]:
        """Return left, right, top and bottom of the part of the picture outside which no ray hits the mesh."""
        corners = (self._corners - center) @ rotation
        if corners[:, 2].min() <= 0:
            return 0, width, 0, height
        pixels = lens[:2] * corners[:, :2] / corners[:, 2:] + lens[2:]
        # One pixel more than the rays' offsets, because the ray caster rounds to float32.
        reach = np.abs(offsets).max(axis=0) + 1.0
        left, top = np.floor((pixels.min(axis=0) - reach).clip(0, (width, height))).astype(int).tolist()
        right, bottom = np.ceil((pixels.max(axis=0) + reach).clip(0, (width, height))).astype(int).tolist()
        return left, right, top, bottom


def surroundings(environment: Environment | None) -> MipMaps:
    """Return the panorama behind a mesh, empty where there is no environment to be seen."""
    return mip_maps([] if environment is None else [environment.radiance], bits16=False)


def sample_offsets(samples: int) -> NDArray[np.float64]:
    """Return offsets (N, 2) in pixels of equally weighted rays that sample the point-spread function.

    The offsets lie on a spiral of golden angles, with radii at the quantiles of the Gaussian. A linear map then gives
    them exactly the Gaussian's mean and covariance. A single ray goes through the center.

    Raises:
        ValueError: fewer than one ray, or two, because two rays cannot spread in both directions.
    """
    if samples == 1:
        return np.zeros((1, 2))
    if samples < 3:
        raise ValueError(f"samples must be 1 or at least 3, got {samples}")
    rank = np.arange(samples)
    radius = np.sqrt(-2.0 * np.log(1.0 - (rank + 0.5) / samples))
    angle = np.pi * (3.0 - np.sqrt(5.0)) * rank
    offsets = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    offsets -= offsets.mean(axis=0)
    spread = np.linalg.cholesky(offsets.T @ offsets / samples)
    return np.ascontiguousarray(POINT_SPREAD * np.linalg.solve(spread, offsets.T).T)
