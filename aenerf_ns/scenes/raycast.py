"""A ray caster for scenes of analytic primitives with baked light.

Everything is Lambertian, so the light a surface receives does not depend on the view: `bake` computes it once, with
soft shadows and a few diffuse bounces, into a light map, and `render` casts primary rays only. Radiance is linear RGB,
lengths are metres, the world's z axis points up. A camera has OpenCV axes (x right, y down, z forward); the centre of
pixel (x, y) lies at (x + 0.5, y + 0.5), as Nerfstudio counts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aenerf_ns.scenes.textures import Texture, mip_pyramid

Array = NDArray[np.float64]

RECTANGLE, BOX, SPHERE, CYLINDER = range(4)
POINT_SPREAD = 0.5
"""Standard deviation of a pixel's Gaussian point-spread function, in pixels."""
_FOOTPRINT = 0.5
"""Side of the texture region a sample averages, in pixels: about the distance between the samples of a pixel."""
_TILE = 8
BOUNCES = 3
_SURFACE_OFFSET = 1e-4


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


@dataclass(frozen=True)
class AreaLight:
    """An invisible rectangle that shines to one side, that of half_u x half_v, with a uniform radiance (3,)."""

    centre: ArrayLike
    half_u: ArrayLike
    half_v: ArrayLike
    radiance: ArrayLike


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


@dataclass(frozen=True)
class Scene:
    """A baked scene and the radiance (3,) seen where a ray hits nothing."""

    arrays: SceneArrays
    background: Array


@numba.njit(cache=True, error_model="numpy")
def _intersect(kind, hx, hy, hz, ox, oy, oz, dx, dy, dz):
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
def _surface(kind, hx, hy, hz, x, y, z):
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
def _irradiance(light, start, width, height, wraps, lu, lv):
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
                            t = _intersect(
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
                        face, tu, tv, lu, lv, nx, ny, nz = _surface(
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
                        er, eg, eb = _irradiance(
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


@numba.njit(cache=True, error_model="numpy")
def _closest(arrays, px, py, pz, dx, dy, dz, limit):
    """Closest primitive along a world ray with a unit direction, nearer than ``limit``: index (-1 if none), distance.

    For a shadow ray, whose limit is finite, the first one found will do.
    """
    best, hit = limit, -1
    for i in range(len(arrays.kind)):
        c, bound = arrays.centre[i], arrays.bound[i]
        cx, cy, cz = px - c[0], py - c[1], pz - c[2]
        along = cx * dx + cy * dy + cz * dz
        outside = cx * cx + cy * cy + cz * cz - bound * bound
        if outside > 0.0 and (along > 0.0 or along * along < outside):
            continue
        m, h = arrays.rotation[i], arrays.half[i]
        t = _intersect(
            arrays.kind[i],
            h[0],
            h[1],
            h[2],
            m[0, 0] * cx + m[0, 1] * cy + m[0, 2] * cz,
            m[1, 0] * cx + m[1, 1] * cy + m[1, 2] * cz,
            m[2, 0] * cx + m[2, 1] * cy + m[2, 2] * cz,
            m[0, 0] * dx + m[0, 1] * dy + m[0, 2] * dz,
            m[1, 0] * dx + m[1, 1] * dy + m[1, 2] * dz,
            m[2, 0] * dx + m[2, 1] * dy + m[2, 2] * dz,
        )
        if t < best:
            best, hit = t, i
            if limit < math.inf:
                break
    return hit, best


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _direct_light(arrays, points, normals, lights, strata, jitter, light_map):
    """Irradiance / pi from the area lights ``lights`` (K, 4, 3), by ``strata`` x ``strata`` shadow rays to each."""
    for n in numba.prange(len(points)):
        p, normal = points[n], normals[n]
        for k in range(len(lights)):
            centre, half_u, half_v, emitted = lights[k]
            nx = half_u[1] * half_v[2] - half_u[2] * half_v[1]
            ny = half_u[2] * half_v[0] - half_u[0] * half_v[2]
            nz = half_u[0] * half_v[1] - half_u[1] * half_v[0]
            received = 0.0
            for sample in range(strata * strata):
                a = 2.0 * (sample % strata + jitter[n, 0]) / strata - 1.0
                b = 2.0 * (sample // strata + jitter[n, 1]) / strata - 1.0
                dx = centre[0] + a * half_u[0] + b * half_v[0] - p[0]
                dy = centre[1] + a * half_u[1] + b * half_v[1] - p[1]
                dz = centre[2] + a * half_u[2] + b * half_v[2] - p[2]
                distance = math.sqrt(dx * dx + dy * dy + dz * dz)
                dx, dy, dz = dx / distance, dy / distance, dz / distance
                cosine = normal[0] * dx + normal[1] * dy + normal[2] * dz
                # The normal of the light has the length of a quarter of its area.
                facing = -(nx * dx + ny * dy + nz * dz)
                if cosine <= 0.0 or facing <= 0.0:
                    continue
                if _closest(arrays, p[0], p[1], p[2], dx, dy, dz, distance - _SURFACE_OFFSET)[0] < 0:
                    received += 4.0 * facing * cosine / (math.pi * distance * distance)
            for c in range(3):
                light_map[n, c] += emitted[c] * received / (strata * strata)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _reflected_light(arrays, points, normals, albedo, sky, directions, jitter, light_map):
    """Irradiance / pi from the other surfaces, lit as in ``arrays.light``, and from the sky where a ray hits none.

    ``directions`` (K, 2) are points of the unit square, turned into cosine-weighted directions.
    """
    for n in numba.prange(len(points)):
        p, normal = points[n], normals[n]
        # Tangent frame without a branch per axis: Duff et al., JCGT 2017.
        sign = math.copysign(1.0, normal[2])
        a = -1.0 / (sign + normal[2])
        b = normal[0] * normal[1] * a
        tx, ty, tz = 1.0 + sign * normal[0] * normal[0] * a, sign * b, -sign * normal[0]
        bx, by, bz = b, sign + normal[1] * normal[1] * a, -normal[1]
        red, green, blue = 0.0, 0.0, 0.0
        for k in range(len(directions)):
            angle = 2.0 * math.pi * (directions[k, 0] + jitter[n, 0])
            square = (directions[k, 1] + jitter[n, 1]) % 1.0
            u, v, w = math.sqrt(square) * math.cos(angle), math.sqrt(square) * math.sin(angle), math.sqrt(1.0 - square)
            dx = u * tx + v * bx + w * normal[0]
            dy = u * ty + v * by + w * normal[1]
            dz = u * tz + v * bz + w * normal[2]
            hit, distance = _closest(arrays, p[0], p[1], p[2], dx, dy, dz, math.inf)
            if hit < 0:
                up = 0.5 + 0.5 * dz
                red += sky[0, 0] + up * (sky[1, 0] - sky[0, 0])
                green += sky[0, 1] + up * (sky[1, 1] - sky[0, 1])
                blue += sky[0, 2] + up * (sky[1, 2] - sky[0, 2])
                continue
            m, h, c = arrays.rotation[hit], arrays.half[hit], arrays.centre[hit]
            qx, qy, qz = p[0] + distance * dx - c[0], p[1] + distance * dy - c[1], p[2] + distance * dz - c[2]
            face, _, _, lu, lv, nx, ny, nz = _surface(
                arrays.kind[hit],
                h[0],
                h[1],
                h[2],
                m[0, 0] * qx + m[0, 1] * qy + m[0, 2] * qz,
                m[1, 0] * qx + m[1, 1] * qy + m[1, 2] * qz,
                m[2, 0] * qx + m[2, 1] * qy + m[2, 2] * qz,
            )
            facing = 0.0
            for axis in range(3):
                facing += (nx * m[0, axis] + ny * m[1, axis] + nz * m[2, axis]) * (dx, dy, dz)[axis]
            if facing < 0.0:  # else the ray starts inside a solid, where it is dark
                start, width, height = arrays.chart[hit, face]
                wraps = arrays.kind[hit] >= SPHERE and face == 0
                er, eg, eb = _irradiance(arrays.light, start, width, height, wraps, lu, lv)
                red += albedo[hit, 0] * er
                green += albedo[hit, 1] * eg
                blue += albedo[hit, 2] * eb
        light_map[n, 0] += red / len(directions)
        light_map[n, 1] += green / len(directions)
        light_map[n, 2] += blue / len(directions)


def bake(
    primitives: Sequence[Primitive],
    textures: Mapping[str, Texture],
    lights: Sequence[AreaLight],
    *,
    spacing: float,
    ambient: float,
    sky: ArrayLike = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    background: ArrayLike = (0.0, 0.0, 0.0),
    seed: int = 0,
) -> Scene:
    """Light a scene once and for all.

    Args:
        primitives, textures, lights: the scene; textures are float32 (N, N, 3), all of one size, a power of two.
        spacing: of the light map's texels, in metres.
        ambient: radiance that reaches every surface from all sides, occluded or not. It keeps crevices from going
            black, where the logarithm would make huge contrasts of nothing.
        sky: (2, 3) radiance that comes from straight below and from straight above where a ray hits nothing.
        background: (3,) radiance the camera sees there.
        seed: of the sampling.

    Raises:
        ValueError: on textures of different sizes or of a size that is not a power of two.
        KeyError: on a primitive whose texture is missing.
    """
    names = list(textures)
    sizes = {textures[name].shape for name in names}
    size = len(textures[names[0]])
    if sizes != {(size, size, 3)} or size & (size - 1):
        raise ValueError(f"textures must share one shape (N, N, 3), N a power of two, got {sorted(sizes)}")
    pyramids = [mip_pyramid(textures[name]) for name in names]
    index = {name: position for position, name in enumerate(names)}

    half = np.array([p.half_extents for p in primitives], np.float64)
    kind = np.array([p.kind for p in primitives], np.int64)
    bound = np.linalg.norm(half, axis=1)
    bound[kind == RECTANGLE] = np.linalg.norm(half[kind == RECTANGLE, :2], axis=1)
    bound[kind == SPHERE] = half[kind == SPHERE, 0]
    bound[kind == CYLINDER] = np.hypot(half[kind == CYLINDER, 0], half[kind == CYLINDER, 2])
    tiles = 1 / np.array([[p.texture_scale] * 2 for p in primitives], np.float64)
    # Around a sphere or a cylinder goes a whole number of tiles, so that no seam shows.
    girth = 2 * np.pi * half[kind >= SPHERE, 0]
    tiles[kind >= SPHERE, 0] = np.maximum(1, np.rint(girth * tiles[kind >= SPHERE, 0])) / girth
    chart = _charts(kind, half, spacing)
    texel_count = int((chart[..., 1] * chart[..., 2]).sum())
    arrays = SceneArrays(
        kind=kind,
        centre=np.array([p.centre for p in primitives], np.float64),
        rotation=np.array([np.asarray(p.rotation).T for p in primitives], np.float64),
        half=half,
        bound=bound,
        texture=np.array([index[p.texture] for p in primitives], np.int64),
        tiles=tiles,
        texture_offset=np.array([p.texture_offset for p in primitives], np.float64),
        tint=np.array([p.tint for p in primitives], np.float64),
        emission=np.array([p.emission for p in primitives], np.float64),
        chart=chart,
        light=np.zeros((texel_count, 3), np.float32),
        texels=np.array([np.concatenate([level.reshape(-1, 3) for level in levels]) for levels in pyramids]),
        level_start=np.cumsum([0] + [level.size // 3 for level in pyramids[0][:-1]]),
    )
    points, normals = _texel_points(arrays)
    albedo = np.array([pyramids[i][-1][0, 0] for i in arrays.texture], np.float64) * arrays.tint
    jitter = np.random.default_rng(seed).random((texel_count, 2))
    emitters = np.array([[a.centre, a.half_u, a.half_v, a.radiance] for a in lights], np.float64).reshape(-1, 4, 3)
    directions = _plane_sequence(48)
    direct = np.full((texel_count, 3), ambient, np.float32)
    _direct_light(arrays, points, normals, emitters, 4, jitter, direct)
    light = direct
    for _ in range(BOUNCES):
        lit = arrays._replace(light=light)
        light = direct.copy()
        _reflected_light(lit, points, normals, albedo, np.asarray(sky, np.float64), directions, jitter, light)
    return Scene(arrays._replace(light=light), np.asarray(background, np.float64))


def render(
    scene: Scene,
    camera_to_world: ArrayLike,
    intrinsics: Sequence[float],
    width: int,
    height: int,
    samples: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Picture of a scene through a pinhole camera.

    Args:
        camera_to_world: (4, 4) or (3, 4), OpenCV axes.
        intrinsics: (fx, fy, cx, cy) in pixels, pixel centres at +0.5.
        samples: rays per pixel, the same pattern of a Gaussian point-spread in every pixel and every frame: 1, or 3
            and more; one ray goes through the pixel's centre.

    Returns:
        radiance (H, W, 3) linear RGB; depth (H, W) along the optical axis, mean over the rays that hit, inf where
        none does; alpha (H, W), the fraction of rays that hit. All float32.

    Raises:
        ValueError: on a number of samples that `sample_offsets` has no pattern for.
    """
    pose = np.asarray(camera_to_world, np.float64)
    arrays = scene.arrays
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
        scene.background,
        radiance,
        depth,
        alpha,
    )
    return radiance, depth, alpha


def sample_offsets(samples: int) -> Array:
    """Offsets (N, 2) in pixels of equally weighted rays that stand for the point-spread function.

    A spiral of golden angles with its radii at the quantiles of the Gaussian, then brought to exactly the Gaussian's
    mean and covariance. One ray goes through the centre.

    Raises:
        ValueError: on fewer than one ray, or on two, which cannot spread both ways.
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


def _plane_sequence(count: int) -> Array:
    """The first points of the R2 low-discrepancy sequence in the unit square (Roberts, 2018)."""
    plastic = 1.32471795724474602596
    return (np.arange(1, count + 1)[:, None] * np.array([1 / plastic, 1 / plastic**2])) % 1.0


def _charts(kind: NDArray[np.int64], half: Array, spacing: float) -> NDArray[np.int64]:
    """First texel, width and height (P, 6, 3) of the light map of every face; faces a primitive lacks are empty."""
    chart = np.zeros((len(kind), 6, 3), np.int64)
    start = 0
    for i, (hx, hy, hz) in enumerate(half):
        sides = {
            RECTANGLE: [(2 * hx, 2 * hy)],
            BOX: [(2 * hy, 2 * hz)] * 2 + [(2 * hx, 2 * hz)] * 2 + [(2 * hx, 2 * hy)] * 2,
            SPHERE: [(2 * np.pi * hx, np.pi * hx)],
            CYLINDER: [(2 * np.pi * hx, 2 * hz), (2 * hx, 2 * hx), (2 * hx, 2 * hx)],
        }[int(kind[i])]
        for face, (u, v) in enumerate(sides):
            width, height = max(2, round(u / spacing)), max(2, round(v / spacing))
            chart[i, face] = start, width, height
            start += width * height
    return chart


def _texel_points(arrays: SceneArrays) -> tuple[Array, Array]:
    """World points (L, 3), just off the surface, and outward normals (L, 3) of the light map's texels."""
    points, normals = [], []
    for i, kind in enumerate(arrays.kind):
        half = arrays.half[i]
        for face, (_, width, height) in enumerate(arrays.chart[i]):
            v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
            u, v, one = u.ravel(), v.ravel(), np.ones(width * height)
            across, up = 2 * u - 1, 2 * v - 1
            turn, latitude = 2 * np.pi * u, np.pi * (v - 0.5)
            if kind == SPHERE:
                ring = np.cos(latitude)
                normal = np.stack([ring * np.cos(turn), ring * np.sin(turn), np.sin(latitude)], 1)
                local = normal
            elif kind == CYLINDER and face == 0:
                normal = np.stack([np.cos(turn), np.sin(turn), 0 * one], 1)
                local = normal + np.stack([0 * one, 0 * one, up], 1)
            elif kind == CYLINDER:
                # The corners of a cap's chart lie off the disc: draw them in.
                scale = 1 / np.maximum(1.0, np.hypot(across, up))
                side = (2 * face - 3) * one
                normal = np.stack([0 * one, 0 * one, side], 1)
                local = np.stack([across * scale, up * scale, side], 1)
            else:
                axis, sign = (2, 1.0) if kind == RECTANGLE else (face // 2, 2.0 * (face % 2) - 1)
                local = np.insert(np.stack([across, up], 1), axis, sign, axis=1)  # a rectangle's half extent is 0 there
                normal = np.zeros_like(local)
                normal[:, axis] = sign
            points.append((local * half + _SURFACE_OFFSET * normal) @ arrays.rotation[i] + arrays.centre[i])
            normals.append(normal @ arrays.rotation[i])
    return np.concatenate(points), np.concatenate(normals)
