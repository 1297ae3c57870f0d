"""A ray caster for scenes of analytic primitives with baked light.

Everything is Lambertian, so the light a surface receives does not depend on the view: `light_baking.bake` computes it
once, into a light map, and rendering casts primary rays only. Radiance is linear RGB,
lengths are metres, the world's z axis points up. A camera has OpenCV axes (x right, y down, z forward); the centre of
pixel (x, y) lies at (x + 0.5, y + 0.5), as Nerfstudio counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aenerf_ns.simulator.rendering.renderer import POINT_SPREAD, sample_offsets

Array = NDArray[np.float64]

RECTANGLE, BOX, SPHERE, CYLINDER = range(4)
_FOOTPRINT = 0.5
"""Side of the texture region a sample averages, in pixels: about the distance between the samples of a pixel."""
_TILE = 8


@dataclass(frozen=True)
class Primitive:
    """A textured solid, or a rectangle seen from its front only.

    The local axes of a rectangle are x right, y up, z towards the viewer; the axis of a cylinder is its local z.

    Attributes:
        kind: RECTANGLE, BOX, SPHERE or CYLINDER.
        centre: (3,) world.
        half_extents: (3,) along the local axes; a sphere's radius thrice; a cylinder's radius twice, then its half
            height.
        texture: name of its texture.
        texture_scale: side of one tile of the texture, in metres.
        rotation: (3, 3) world-from-local.
        texture_offset: (u, v) in tiles of the texture's origin from the middle of the surface.
        tint: RGB factor of the albedo.
        emission: radiance it glows with, for an albedo of 1. It lights nothing: an `AreaLight` does.
    """

    kind: int
    centre: ArrayLike
    half_extents: ArrayLike
    texture: str
    texture_scale: float = 1.0
    rotation: Array = field(default_factory=lambda: np.eye(3))
    texture_offset: tuple[float, float] = (0.0, 0.0)
    tint: ArrayLike = (1.0, 1.0, 1.0)
    emission: float = 0.0


class SceneArrays(NamedTuple):
    """What the compiled functions read: P primitives with 6 faces at most, L light-map texels, T textures."""

    kind: NDArray[np.int64]  # (P,)
    centre: Array  # (P, 3)
    rotation: Array  # (P, 3, 3) local-from-world
    half: Array  # (P, 3)
    bound: Array  # (P,) radius of the bounding sphere
    texture: NDArray[np.int64]  # (P,)
    tiles: Array  # (P, 2) of the texture per metre: along u of face 0, and everywhere else
    texture_offset: Array  # (P, 2)
    tint: Array  # (P, 3)
    emission: Array  # (P,)
    chart: NDArray[np.int64]  # (P, 6, 3): first texel, width and height of each face's light map
    light: NDArray[np.float32]  # (L, 3) irradiance / pi
    texels: NDArray[np.float32]  # (T, M, 3) mip pyramids
    level_start: NDArray[np.int64]  # (levels,)


@numba.njit(cache=True, error_model="numpy")
def intersect(kind, hx, hy, hz, ox, oy, oz, dx, dy, dz):
    """Parameter of the first point of a local ray on a primitive, inf if none. From inside a solid, its way out."""
    if kind == RECTANGLE:
        if dz >= 0.0 or oz <= 0.0:
            return math.inf
        t = -oz / dz
        return t if abs(ox + t * dx) <= hx and abs(oy + t * dy) <= hy else math.inf
    enter, leave = -math.inf, math.inf
    if kind == BOX:
        a, b = (-hx - ox) / dx, (hx - ox) / dx
        enter, leave = min(a, b), max(a, b)
        a, b = (-hy - oy) / dy, (hy - oy) / dy
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    else:
        # A sphere, or the infinite cylinder around the local z axis.
        along = 1.0 if kind == SPHERE else 0.0
        square = dx * dx + dy * dy + along * dz * dz
        middle = -(ox * dx + oy * dy + along * oz * dz)
        discriminant = middle * middle - square * (ox * ox + oy * oy + along * oz * oz - hx * hx)
        if discriminant < 0.0:
            return math.inf
        root = math.sqrt(discriminant)
        enter, leave = (middle - root) / square, (middle + root) / square
    if kind != SPHERE:
        a, b = (-hz - oz) / dz, (hz - oz) / dz
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    if enter > leave or leave <= 0.0:
        return math.inf
    return enter if enter > 0.0 else leave


@numba.njit(cache=True, error_model="numpy")
def surface(kind, hx, hy, hz, x, y, z):
    """At a local surface point: face, texture coordinates in metres, light-map coordinates in [0, 1], normal."""
    if kind == RECTANGLE:
        return 0, x, y, 0.5 + 0.5 * x / hx, 0.5 + 0.5 * y / hy, 0.0, 0.0, 1.0
    if kind == BOX:
        rx, ry, rz = abs(x) / hx, abs(y) / hy, abs(z) / hz
        if rx >= ry and rx >= rz:
            side, face, u, v, hu, hv = x, 0, y, z, hy, hz
        elif ry >= rz:
            side, face, u, v, hu, hv = y, 2, x, z, hx, hz
        else:
            side, face, u, v, hu, hv = z, 4, x, y, hx, hy
        sign = 1.0 if side > 0.0 else -1.0
        nx, ny, nz = sign * (face == 0), sign * (face == 2), sign * (face == 4)
        face += side > 0.0
        lu, lv = 0.5 + 0.5 * u / hu, 0.5 + 0.5 * v / hv
        # Textures have their grain along u: let it follow the longer side.
        return (face, v, u, lu, lv, nx, ny, nz) if hv > hu else (face, u, v, lu, lv, nx, ny, nz)
    turn = math.atan2(y, x) / (2.0 * math.pi)
    if kind == SPHERE:
        latitude = math.asin(max(-1.0, min(1.0, z / hx)))
        lv = 0.5 + latitude / math.pi
        return 0, turn * 2.0 * math.pi * hx, latitude * hx, turn % 1.0, lv, x / hx, y / hx, z / hx
    if hx * hx * z * z > hz * hz * (x * x + y * y):
        sign = 1.0 if z > 0.0 else -1.0
        return 1 + (z > 0.0), x, y, 0.5 + 0.5 * x / hx, 0.5 + 0.5 * y / hx, 0.0, 0.0, sign
    return 0, turn * 2.0 * math.pi * hx, z, turn % 1.0, 0.5 + 0.5 * z / hz, x / hx, y / hx, 0.0


@numba.njit(cache=True, error_model="numpy")
def irradiance(light, start, width, height, wraps, lu, lv):
    """Bilinear light-map value (irradiance / pi) of one chart; those of spheres and cylinder sides wrap around."""
    u, v = lu * width - 0.5, lv * height - 0.5
    i, j = int(math.floor(u)), int(math.floor(v))
    fu, fv = u - i, v - j
    left, right = max(i, 0), min(i + 1, width - 1)
    if wraps and (i < 0 or i == width - 1):
        left, right = width - 1, 0
    low, high = start + max(j, 0) * width, start + min(j + 1, height - 1) * width
    a, b, c, d = (1 - fu) * (1 - fv), fu * (1 - fv), (1 - fu) * fv, fu * fv
    return (
        a * light[low + left, 0] + b * light[low + right, 0] + c * light[high + left, 0] + d * light[high + right, 0],
        a * light[low + left, 1] + b * light[low + right, 1] + c * light[high + left, 1] + d * light[high + right, 1],
        a * light[low + left, 2] + b * light[low + right, 2] + c * light[high + left, 2] + d * light[high + right, 2],
    )


@numba.njit(cache=True, error_model="numpy")
def _albedo(texels, level_start, texture, u, v, footprint):
    """Trilinear value of a texture at (u, v) tiles, for a footprint in tiles."""
    levels = len(level_start)
    detail = max(0.0, min(levels - 1.0, math.log2(np.float32(max(footprint, 1e-12))) + (levels - 1)))
    base = min(int(detail), levels - 2)
    red, green, blue = 0.0, 0.0, 0.0
    for level in (base, base + 1):
        weight = 1.0 - abs(detail - level)
        size = 1 << (levels - 1 - level)
        x, y = u * size - 0.5, v * size - 0.5
        i, j = int(math.floor(x)), int(math.floor(y))
        fx, fy = x - i, y - j
        start, mask = level_start[level], size - 1
        low, high = start + (j & mask) * size, start + ((j + 1) & mask) * size
        left, right = i & mask, (i + 1) & mask
        a, b = weight * (1 - fx) * (1 - fy), weight * fx * (1 - fy)
        c, d = weight * (1 - fx) * fy, weight * fx * fy
        for texel, part in ((low + left, a), (low + right, b), (high + left, c), (high + right, d)):
            red += part * texels[texture, texel, 0]
            green += part * texels[texture, texel, 1]
            blue += part * texels[texture, texel, 2]
    return red, green, blue


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _render(arrays, rotation, origin, centre, nearest, order, intrinsics, offsets, background, radiance, depth, alpha):
    """Cast the rays of one camera. ``rotation`` (P, 3, 3) local-from-camera, ``origin`` (P, 3) the camera, local;
    ``centre`` (P, 3) of the bounding spheres in the camera; ``nearest`` (P,) their distance, ascending in ``order``."""
    kind, _, _, half, bound, texture, tiles, texture_offset, tint, emission, chart, light, texels, level_start = arrays
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics
    count, samples = len(order), len(offsets)
    margin = 4.0 * POINT_SPREAD
    for strip in numba.prange((height + _TILE - 1) // _TILE):
        candidates = np.empty(count, np.int64)
        for tile in range((width + _TILE - 1) // _TILE):
            x0, y0 = tile * _TILE, strip * _TILE
            x1, y1 = min(x0 + _TILE, width), min(y0 + _TILE, height)
            # The tile's rays lie in a cone: drop the primitives whose bounding sphere it misses.
            ax, ay = (0.5 * (x0 + x1) - cx) / fx, (0.5 * (y0 + y1) - cy) / fy
            norm = math.sqrt(ax * ax + ay * ay + 1.0)
            cone = math.hypot((0.5 * (x1 - x0) + margin) / fx, (0.5 * (y1 - y0) + margin) / fy)
            sin_cone = cone / math.sqrt(1.0 + cone * cone)
            cos_cone = math.sqrt(1.0 - sin_cone * sin_cone)
            kept = 0
            for k in range(count):
                i = order[k]
                if nearest[i] > 0.0:
                    distance = nearest[i] + bound[i]
                    sin_sphere = bound[i] / distance
                    cos_sum = math.sqrt(1.0 - sin_sphere * sin_sphere) * cos_cone - sin_sphere * sin_cone
                    if ax * centre[i, 0] + ay * centre[i, 1] + centre[i, 2] < cos_sum * distance * norm:
                        continue
                candidates[kept] = i
                kept += 1
            for y in range(y0, y1):
                for x in range(x0, x1):
                    red, green, blue, total_depth, hits = 0.0, 0.0, 0.0, 0.0, 0
                    for s in range(samples):
                        u = (x + 0.5 + offsets[s, 0] - cx) / fx
                        v = (y + 0.5 + offsets[s, 1] - cy) / fy
                        length = math.sqrt(u * u + v * v + 1.0)
                        best, hit = math.inf, -1
                        for k in range(kept):
                            i = candidates[k]
                            if nearest[i] > best * length:
                                break
                            t = intersect(
                                kind[i],
                                half[i, 0],
                                half[i, 1],
                                half[i, 2],
                                origin[i, 0],
                                origin[i, 1],
                                origin[i, 2],
                                rotation[i, 0, 0] * u + rotation[i, 0, 1] * v + rotation[i, 0, 2],
                                rotation[i, 1, 0] * u + rotation[i, 1, 1] * v + rotation[i, 1, 2],
                                rotation[i, 2, 0] * u + rotation[i, 2, 1] * v + rotation[i, 2, 2],
                            )
                            if t < best:
                                best, hit = t, i
                        if hit < 0:
                            red += background[0]
                            green += background[1]
                            blue += background[2]
                            continue
                        dx = rotation[hit, 0, 0] * u + rotation[hit, 0, 1] * v + rotation[hit, 0, 2]
                        dy = rotation[hit, 1, 0] * u + rotation[hit, 1, 1] * v + rotation[hit, 1, 2]
                        dz = rotation[hit, 2, 0] * u + rotation[hit, 2, 1] * v + rotation[hit, 2, 2]
                        face, tu, tv, lu, lv, nx, ny, nz = surface(
                            kind[hit],
                            half[hit, 0],
                            half[hit, 1],
                            half[hit, 2],
                            origin[hit, 0] + best * dx,
                            origin[hit, 1] + best * dy,
                            origin[hit, 2] + best * dz,
                        )
                        # A pixel covers depth / focal length, stretched where the surface is seen at a slant; the
                        # geometric mean of its two sides keeps textures crisp there without aliasing.
                        slant = max(abs(nx * dx + ny * dy + nz * dz) / length, 0.02)
                        r, g, b = _albedo(
                            texels,
                            level_start,
                            texture[hit],
                            tu * tiles[hit, min(face, 1)] + texture_offset[hit, 0],
                            tv * tiles[hit, 1] + texture_offset[hit, 1],
                            _FOOTPRINT * best / (fx * math.sqrt(slant)) * tiles[hit, 1],
                        )
                        er, eg, eb = irradiance(
                            light,
                            chart[hit, face, 0],
                            chart[hit, face, 1],
                            chart[hit, face, 2],
                            kind[hit] >= SPHERE and face == 0,
                            lu,
                            lv,
                        )
                        red += r * tint[hit, 0] * (er + emission[hit])
                        green += g * tint[hit, 1] * (eg + emission[hit])
                        blue += b * tint[hit, 2] * (eb + emission[hit])
                        total_depth += best
                        hits += 1
                    radiance[y, x, 0] = red / samples
                    radiance[y, x, 1] = green / samples
                    radiance[y, x, 2] = blue / samples
                    depth[y, x] = total_depth / hits if hits > 0 else math.inf
                    alpha[y, x] = hits / samples


@dataclass(frozen=True)
class PrimitiveScene:
    """A baked scene and the radiance (3,) seen where a ray hits nothing."""

    arrays: SceneArrays
    background: Array

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
        arrays = self.arrays
        to_camera = arrays.centre - pose[:3, 3]
        nearest = np.linalg.norm(to_camera, axis=1) - arrays.bound
        radiance = np.empty((height, width, 3), np.float32)
        depth, alpha = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
        _render(
            arrays,
            arrays.rotation @ pose[:3, :3],
            -np.einsum("pij,pj->pi", arrays.rotation, to_camera),
            to_camera @ pose[:3, :3],
            nearest,
            np.argsort(nearest, kind="stable"),
            np.asarray(intrinsics, np.float64),
            sample_offsets(samples),
            self.background,
            radiance,
            depth,
            alpha,
        )
        return radiance, depth, alpha
