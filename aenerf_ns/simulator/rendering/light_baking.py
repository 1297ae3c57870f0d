"""The light that the surfaces of a scene receive, computed once.

Direct light of rectangular lamps with soft shadows, light of the sky, and a few diffuse bounces, gathered at the texels
of a light map. Everything is Lambertian, so it holds for every view.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aenerf_ns.simulator.rendering.raycast import (
    BOX,
    CYLINDER,
    RECTANGLE,
    SPHERE,
    Array,
    Primitive,
    PrimitiveScene,
    SceneArrays,
    intersect,
    irradiance,
    surface,
)
from aenerf_ns.simulator.textures import Texture, mip_pyramid

BOUNCES = 3
_SURFACE_OFFSET = 1e-4


@dataclass(frozen=True)
class AreaLight:
    """An invisible rectangle that shines to one side, that of half_u x half_v, with a uniform radiance (3,)."""

    centre: ArrayLike
    half_u: ArrayLike
    half_v: ArrayLike
    radiance: ArrayLike


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
        t = intersect(
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
            face, _, _, lu, lv, nx, ny, nz = surface(
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
                er, eg, eb = irradiance(arrays.light, start, width, height, wraps, lu, lv)
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
) -> PrimitiveScene:
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
    directions = plane_sequence(48)
    direct = np.full((texel_count, 3), ambient, np.float32)
    _direct_light(arrays, points, normals, emitters, 4, jitter, direct)
    light = direct
    for _ in range(BOUNCES):
        lit = arrays._replace(light=light)
        light = direct.copy()
        _reflected_light(lit, points, normals, albedo, np.asarray(sky, np.float64), directions, jitter, light)
    return PrimitiveScene(arrays._replace(light=light), np.asarray(background, np.float64))


def plane_sequence(count: int) -> Array:
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
