"""Pictures of a lit mesh: Embree casts the primary rays, compiled code shades the hits.

The light that a surface receives does not depend on the view. `lighting` computes that light once, and diffuse surfaces
need primary rays only. Glossy surfaces take a second ray each (`reflections`). Radiance is linear RGB, lengths are
meters, and the world's z axis points up. A camera has OpenCV axes (x right, y down, z forward). The center of pixel
(x, y) lies at (x + 0.5, y + 0.5), as in Nerfstudio.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aenerf_ns.simulator.arrays import Array
from aenerf_ns.simulator.rendering.embree import NOTHING, RayCaster
from aenerf_ns.simulator.rendering.mip_maps import MipMaps, panorama
from aenerf_ns.simulator.rendering.reflections import Reflections, add_reflections, hit_weights
from aenerf_ns.simulator.rendering.surface import FOOTPRINT, Surface, diffuse_radiance, face_normal
from aenerf_ns.simulator.rendering.vectors import dot, length
from aenerf_ns.threads import run_ranges

POINT_SPREAD = 0.5
"""Standard deviation of a pixel's Gaussian point-spread function, in pixels."""


@numba.njit(cache=True, nogil=True)
def _aim(pose, fx, fy, cx, cy, offsets, rays, begin, end):
    """Fill rows of ``rays`` (H, W, samples, 6), whose directions are one meter long along the optical axis."""
    _, width, samples, _ = rays.shape
    for row in range(begin, end):
        for column in range(width):
            for n in range(samples):
                x = (column + 0.5 + offsets[n, 0] - cx) / fx
                y = (row + 0.5 + offsets[n, 1] - cy) / fy
                for axis in range(3):
                    rays[row, column, n, axis] = pose[axis, 3]
                    rays[row, column, n, 3 + axis] = x * pose[axis, 0] + y * pose[axis, 1] + pose[axis, 2]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shade(surface, light, rays, hits, focal, background, sky, limit, radiance, depth, begin, end):
    """Shade rows of the hits of camera rays and fill ``radiance`` and ``depth``.

    A ray that hits nothing sees the panorama ``sky``, or ``background`` if ``sky`` is empty.
    """
    height, width = depth.shape
    samples = len(rays) // (height * width)
    for y in range(begin, end):
        for x in range(width):
            red, green, blue, total_depth, found = 0.0, 0.0, 0.0, 0.0, 0
            for n in range((y * width + x) * samples, (y * width + x + 1) * samples):
                direction = float(rays[n, 3]), float(rays[n, 4]), float(rays[n, 5])
                face = hits.face[n]
                if face == NOTHING:
                    r, g, b = background[0], background[1], background[2]
                    if len(sky.level) > 0:
                        per_radian = sky.level[0, 2] / (2.0 * math.pi)
                        r, g, b = panorama(sky, direction, FOOTPRINT / focal * per_radian)
                        r, g, b = min(r, limit), min(g, limit), min(b, limit)
                else:
                    normal, distance = face_normal(surface, face), hits.distance[n]
                    facing = dot(normal, direction)
                    footprint = 0.0
                    if surface.texture[face] >= 0:
                        # A pixel covers depth / focal length, stretched where the surface is seen at a slant; the
                        # geometric mean of its two sides keeps textures crisp there without aliasing.
                        slant = max(abs(facing) / (length(normal) * length(direction)), 0.02)
                        footprint = FOOTPRINT * distance / (focal * math.sqrt(slant))
                    side = 0 if facing < 0.0 else 1
                    r, g, b = diffuse_radiance(surface, light, face, side, hit_weights(hits, n), footprint)
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
        background: (3,) radiance where a ray hits nothing, or None where it sees the surroundings.
        surroundings: panorama that is seen without a background, else empty.
        limit: the radiance of the surroundings and of glossy surfaces is clipped to this value.
        reflections: reflections of glossy surfaces, or None if all surfaces are diffuse.
        gain: factor of all light but the background's.
    """

    surface: Surface
    caster: RayCaster
    light: NDArray[np.float32]
    background: Array | None
    surroundings: MipMaps
    limit: float = math.inf
    reflections: Reflections | None = None
    gain: float = 1.0

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
        pose, (fx, fy, cx, cy) = np.asarray(camera_to_world, np.float64), map(float, intrinsics)
        rays = np.empty((height, width, samples, 6), np.float32)
        run_ranges(partial(_aim, pose, fx, fy, cx, cy, sample_offsets(samples), rays), height)
        rays = rays.reshape(-1, 6)
        hits = self.caster.cast(rays)
        radiance, depth = np.empty((height, width, 3), np.float32), np.empty((height, width), np.float32)
        limit = self.limit / self.gain
        background = np.zeros(3) if self.background is None else self.background / self.gain
        scene = background, self.surroundings, limit
        run_ranges(partial(_shade, self.surface, self.light, rays, hits, fx, *scene, radiance, depth), height)
        if self.reflections is not None:
            add_reflections(self.reflections, self.surface, self.light, self.caster, rays, hits, fx, limit, radiance)
        return np.float32(self.gain) * radiance, depth


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
