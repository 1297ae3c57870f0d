"""Pictures of a lit mesh: Embree casts the primary rays, compiled code shades the hits.

The light that a surface receives does not depend on the view. `lighting` computes that light once, and diffuse surfaces
need primary rays only. Glossy surfaces take a second ray each (`reflections`). Radiance is linear RGB, lengths are
meters, and the world's z axis points up. A camera has OpenCV axes (x right, y down, z forward). The center of pixel
(x, y) lies at (x + 0.5, y + 0.5), as in Nerfstudio.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aenerf_ns.simulator.arrays import Array, Panorama
from aenerf_ns.simulator.rendering.embree import NOTHING, RayCaster
from aenerf_ns.simulator.rendering.mip_maps import MipMaps, mip_maps, panorama
from aenerf_ns.simulator.rendering.reflections import Reflections, add_reflections
from aenerf_ns.simulator.rendering.surface import FOOTPRINT, Surface, diffuse_radiance
from aenerf_ns.simulator.rendering.vectors import cross, dot, interpolate, row, subtract
from aenerf_ns.threads import run_ranges

POINT_SPREAD = 0.5
"""Standard deviation of a pixel's Gaussian point-spread function, in pixels."""


@numba.njit(cache=True, error_model="numpy")
def _direction(rotation, intrinsics, x, y, offset):
    """Return the direction of a ray, one meter long along the optical axis, ``offset`` pixels from a pixel's center."""
    fx, fy, cx, cy = intrinsics
    through = (x + 0.5 + offset[0] - cx) / fx, (y + 0.5 + offset[1] - cy) / fy, 1.0
    return dot(row(rotation, 0), through), dot(row(rotation, 1), through), dot(row(rotation, 2), through)


# Not parallel: starting threads for this little work takes longer than the work, above all on a busy machine.
@numba.njit(cache=True, error_model="numpy")
def _camera_rays(rotation, center, intrinsics, offsets, width, rays):
    """Fill the rays (rows * width * samples, 6) of a picture."""
    for i in range(len(rays)):
        pixel, sample = divmod(i, len(offsets))
        y, x = divmod(pixel, width)
        rays[i, 0], rays[i, 1], rays[i, 2] = center[0], center[1], center[2]
        rays[i, 3], rays[i, 4], rays[i, 5] = _direction(rotation, intrinsics, x, y, offsets[sample])


@numba.njit(cache=True, error_model="numpy")
def _intersect(surface, face, origin, direction):
    """Intersect a ray with the plane of a face (Möller and Trumbore, 1997).

    Returns:
        the barycentric coordinates, clamped to the face, and the normal, whose length is twice the area.
    """
    a, b, c = row(surface.faces, face)
    corner = row(surface.vertices, a)
    u, v = subtract(row(surface.vertices, b), corner), subtract(row(surface.vertices, c), corner)
    normal = cross(u, v)
    from_corner = subtract(origin, corner)
    determinant = -dot(normal, direction)
    q = cross(from_corner, direction)
    second, third = dot(v, q) / determinant, -dot(u, q) / determinant
    # A ray nearly parallel to the plane may meet it anywhere or nowhere.
    second = second if 0.0 <= second < 1e9 else 0.0
    third = third if 0.0 <= third < 1e9 else 0.0
    total = second + third
    if total > 1.0:
        second, third = second / total, third / total
    return (1.0 - second - third, second, third), normal


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shade(surface, light, hits, camera, offsets, background, sky, limit, radiance, depth, begin, end):
    """Shade rows of the hits of `_camera_rays` and fill ``radiance`` and ``depth``.

    A ray that hits nothing sees the panorama ``sky``, or ``background`` if ``sky`` is empty.
    """
    width, (rotation, center, intrinsics) = depth.shape[1], camera
    focal, samples = intrinsics[0], len(offsets)
    origin, axis = (center[0], center[1], center[2]), (rotation[0, 2], rotation[1, 2], rotation[2, 2])
    for y in range(begin, end):
        for x in range(width):
            red, green, blue, total_depth, found = 0.0, 0.0, 0.0, 0.0, 0
            for s in range(samples):
                direction = _direction(rotation, intrinsics, x, y, offsets[s])
                face = hits[(y * width + x) * samples + s]
                if face == NOTHING:
                    r, g, b = background[0], background[1], background[2]
                    if len(sky.level) > 0:
                        per_radian = sky.level[0, 2] / (2.0 * math.pi)
                        r, g, b = panorama(sky, direction, FOOTPRINT / focal * per_radian)
                        r, g, b = min(r, limit), min(g, limit), min(b, limit)
                else:
                    weights, normal = _intersect(surface, face, origin, direction)
                    point = interpolate(surface.vertices, row(surface.faces, face), weights)
                    distance = dot(axis, subtract(point, origin))
                    facing = dot(normal, direction)
                    footprint = 0.0
                    if surface.texture[face] >= 0:
                        # A pixel covers depth / focal length, stretched where the surface is seen at a slant; the
                        # geometric mean of its two sides keeps textures crisp there without aliasing.
                        slant = max(abs(facing) / math.sqrt(dot(normal, normal) * dot(direction, direction)), 0.02)
                        footprint = FOOTPRINT * distance / (focal * math.sqrt(slant))
                    side = 0 if facing < 0.0 else 1
                    r, g, b = diffuse_radiance(surface, light, face, side, weights, footprint)
                    total_depth += distance
                    found += 1
                red += r
                green += g
                blue += b
            radiance[y, x, 0], radiance[y, x, 1], radiance[y, x, 2] = red / samples, green / samples, blue / samples
            depth[y, x] = total_depth / found if found > 0 else math.inf


@dataclass(frozen=True)
class Renderer:
    """Render a lit mesh.

    Attributes:
        surface, caster: the mesh.
        light: (2, G, 3) irradiance / pi at the light points, in front of the faces and behind them.
        background: (3,) radiance where a ray hits nothing and ``surroundings`` is empty.
        surroundings: panorama that is seen where a ray hits nothing, or empty.
        limit: the radiance of the surroundings and of glossy surfaces is clipped to this value.
        reflections: reflections of glossy surfaces, or None if all surfaces are diffuse.
    """

    surface: Surface
    caster: RayCaster
    light: NDArray[np.float32]
    background: Array
    surroundings: MipMaps
    limit: float
    reflections: Reflections | None

    def render(
        self, camera_to_world: ArrayLike, intrinsics: Sequence[float], width: int, height: int, samples: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Render a picture through a pinhole camera.

        Args:
            camera_to_world: (4, 4) or (3, 4), OpenCV axes.
            intrinsics: (fx, fy, cx, cy) in pixels, pixel centers at +0.5.
            width, height: size of the picture in pixels.
            samples: rays per pixel, 1 or at least 3: see `sample_offsets`. All pixels have the same pattern of rays.

        Returns:
            radiance (H, W, 3), linear RGB; depth (H, W) along the optical axis, the mean over the rays that hit, inf
            where none does. Both are float32.
        """
        pose, lens = np.asarray(camera_to_world, np.float64), tuple(map(float, intrinsics))
        offsets = sample_offsets(samples)
        rotation, center = np.ascontiguousarray(pose[:3, :3]), np.ascontiguousarray(pose[:3, 3])
        rays = np.empty((height * width * samples, 6), np.float32)
        _camera_rays(rotation, center, lens, offsets, width, rays)
        hits = self.caster.cast(rays)
        radiance, depth = np.empty((height, width, 3), np.float32), np.empty((height, width), np.float32)
        camera, scene = (rotation, center, lens), (self.background, self.surroundings, self.limit)
        shade = partial(_shade, self.surface, self.light, hits.face, camera, offsets, *scene, radiance, depth)
        run_ranges(shade, height)
        if self.reflections is not None:
            add_reflections(
                self.reflections, self.surface, self.light, self.caster, rays, hits, lens[0], self.limit, radiance
            )
        return radiance, depth

    def with_gain(self, gain: float) -> Renderer:
        """Return the renderer of the same scene in ``gain`` times the light. The background does not change."""
        return replace(
            self,
            light=(gain * self.light).astype(np.float32),
            surroundings=self.surroundings.scaled(gain),
            reflections=self.reflections and self.reflections.scaled(gain),
        )


def make_surroundings(environment: Panorama | None) -> MipMaps:
    """Build the panorama behind a mesh, empty where there is no environment to be seen."""
    return mip_maps([] if environment is None else [environment], bits16=False)


def sample_offsets(samples: int) -> NDArray[np.float64]:
    """Return offsets (N, 2) in pixels of equally weighted rays that sample the point-spread function.

    The offsets lie on a spiral of golden angles, with radii at the quantiles of the Gaussian. A linear map then gives
    them exactly the Gaussian's mean and covariance, for which it takes three. A single ray goes through the center.
    """
    if samples == 1:
        return np.zeros((1, 2))
    rank = np.arange(samples)
    radius = np.sqrt(-2.0 * np.log(1.0 - (rank + 0.5) / samples))
    angle = np.pi * (3.0 - np.sqrt(5.0)) * rank
    offsets = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    offsets -= offsets.mean(axis=0)
    spread = np.linalg.cholesky(offsets.T @ offsets / samples)
    return np.ascontiguousarray(POINT_SPREAD * np.linalg.solve(spread, offsets.T).T)
