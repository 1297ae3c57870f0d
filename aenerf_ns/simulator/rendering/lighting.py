"""Compute the light that a mesh receives, once, on both sides of its faces.

The light consists of direct light of lamps and of the sun with soft shadows, light of the sky, and diffuse bounces. It
is computed at the corners of the faces; faces are small enough for light to be linear between their corners. Rays are
cast once: the points where gathering rays end are kept as links, and every bounce follows the same links.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aenerf_ns.progress import progress_bar
from aenerf_ns.simulator.arrays import Array
from aenerf_ns.simulator.rendering.embree import NOTHING, RayCaster
from aenerf_ns.simulator.rendering.environment import Environment
from aenerf_ns.simulator.rendering.mesh import Mesh, normals_and_areas, position_ids
from aenerf_ns.simulator.rendering.mip_maps import MipMaps, lookup, mip_maps, panorama
from aenerf_ns.simulator.rendering.reflections import reflections
from aenerf_ns.simulator.rendering.renderer import Renderer, surroundings
from aenerf_ns.simulator.rendering.surface import MeshArrays, face_normal, mesh_arrays, ray_offset

_CREASE = math.cos(math.radians(40.0))
"""Cosine of the angle below which adjacent faces belong to one smooth surface."""
_DIRECTIONS = 64
_STRATA = 4
_SUN_SAMPLES = 32
_BOUNCES = 12
_SMOOTHING = 4
_CHUNK = 1 << 14


@dataclass(frozen=True)
class AreaLight:
    """An invisible rectangle that shines to one side, that of half_u x half_v.

    Attributes:
        center: (3,) in meters.
        half_u, half_v: (3,) from the center to the middle of a side, in meters.
        radiance: (3,) linear RGB, uniform.
    """

    center: ArrayLike
    half_u: ArrayLike
    half_v: ArrayLike
    radiance: ArrayLike


class LightPoints(NamedTuple):
    """The points at which light is computed. Faces of one smooth surface share them at their corners."""

    corner: NDArray[np.int64]  # (F, 3) light point of each corner of the faces
    position: Array  # (G, 3)
    normal: Array  # (G, 3) unit
    size: Array  # (G,) mean length of the edges at the point, in meters


def light_points(mesh: Mesh) -> LightPoints:
    """Place the light points of a mesh.

    At the boundary of a surface, points lie a little inside it, away from other surfaces that begin there.
    """
    a, b, c = mesh.vertices[mesh.faces.T]
    normals, _ = normals_and_areas(mesh)
    place = position_ids(mesh.vertices)[mesh.faces].reshape(-1)
    order = np.argsort(place, kind="stable")
    start = np.searchsorted(place[order], np.arange(place.max() + 2))
    corner = np.empty(len(place), np.int64)
    count = _smooth_parts(start, order, normals, corner)
    corners = np.stack([a, b, c], axis=1)
    towards, back = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    lengths = np.linalg.norm(towards, axis=-1)
    cosine = (towards * back).sum(-1) / np.maximum(lengths * np.linalg.norm(back, axis=-1), 1e-300)
    angle = np.arccos(cosine.clip(-1, 1)).reshape(-1)
    inwards = (corners.mean(axis=1, keepdims=True) - corners).reshape(-1, 3)

    def total(values: Array) -> Array:
        return np.stack([np.bincount(corner, column, count) for column in values.T], axis=1)

    faces_at = np.bincount(corner, minlength=count)[:, None]
    normal = total(angle[:, None] * np.repeat(normals, 3, axis=0))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    # An edge that belongs to one face only marks the boundary of a surface. A point on the boundary moves onto the face
    # that leads furthest inside. Other points stay, because a step along a face of a curved surface leaves the surface.
    neighbors = np.concatenate([np.roll(place.reshape(-1, 3), turn, axis=1).reshape(-1) for turn in (1, 2)])
    edges = np.concatenate([corner, corner]) * (place.max() + 1) + neighbors
    edge, uses = np.unique(edges, return_counts=True)
    is_open = np.zeros(count, bool)
    is_open[edge[uses == 1] // (place.max() + 1)] = True
    leads = (inwards * (total(inwards) / faces_at)[corner]).sum(axis=1)
    best = np.empty(count, np.int64)
    best_last = np.lexsort((leads, corner))
    best[corner[best_last]] = best_last
    position = corners.reshape(-1, 3)[best] + 0.1 * is_open[:, None] * inwards[best]
    size = (total(lengths.reshape(-1, 1)) / faces_at)[:, 0]
    return LightPoints(corner.reshape(-1, 3), position, normal, size)


@numba.njit(cache=True, error_model="numpy")
def _smooth_parts(start, order, normals, part):
    """Number the crease-free groups of the corners at each position, ``order[start[i]:start[i + 1]]``."""
    count = 0
    for place in range(len(start) - 1):
        corners = order[start[place] : start[place + 1]]
        for corner in corners:
            part[corner] = -1
        for first in range(len(corners)):
            if part[corners[first]] >= 0:
                continue
            part[corners[first]] = count
            # Grow the group from face to face.
            grown = True
            while grown:
                grown = False
                for i in range(len(corners)):
                    if part[corners[i]] != count:
                        continue
                    one = normals[corners[i] // 3]
                    for j in range(len(corners)):
                        other = normals[corners[j] // 3]
                        cosine = one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
                        if part[corners[j]] < 0 and cosine > _CREASE:
                            part[corners[j]] = count
                            grown = True
            count += 1
    return count


def light_mesh(
    mesh: Mesh,
    caster: RayCaster,
    environment: Environment,
    lamps: Sequence[AreaLight],
    background: Array,
    *,
    show_environment: bool = False,
    ambient: float = 0.0,
    seed: int = 0,
) -> Renderer:
    """Light a mesh on both sides of its faces.

    Light that a glossy face passes on to other faces is computed as if the face were diffuse.

    Args:
        mesh: the mesh. Light is computed at the corners of its faces and is linear between them.
        caster: casts rays against the mesh.
        environment: light from far away.
        lamps: invisible lamps.
        background: (3,) radiance where a camera's ray hits nothing, unless the environment is shown there.
        show_environment: whether the camera sees the environment where its ray hits nothing.
        ambient: radiance that reaches every surface from all sides, occluded or not. It keeps crevices from going
            black, where small differences would become large contrasts of log-radiance.
        seed: seed of the sampling.
    """
    points = light_points(mesh)
    arrays = mesh_arrays(mesh, points.corner)
    textures = mip_maps(mesh.textures, bits16=True)
    emitters = np.array([[a.center, a.half_u, a.half_v, a.radiance] for a in lamps], np.float64).reshape(-1, 4, 3)
    light = _light(arrays, textures, caster, points, environment, emitters, ambient, seed)
    glow = np.zeros(len(points.position), np.float32)
    np.maximum.at(glow, points.corner, mesh.emission[:, None].astype(np.float32))
    light += glow[:, None]
    shown = surroundings(environment if show_environment else None)
    gloss = None
    if mesh.gloss[:, 0].any():
        gloss = reflections(mesh, points.corner, points.normal, emitters, surroundings(environment), ambient)
    return Renderer(arrays, textures, caster, light, background, shown, math.inf, gloss)


def baked_mesh(mesh: Mesh, caster: RayCaster, background: Array) -> Renderer:
    """Return a renderer of a mesh whose colors are radiance, in front of a uniform background (3,)."""
    arrays = mesh_arrays(mesh, np.zeros_like(mesh.faces))
    light, textures = np.ones((2, 1, 3), np.float32), mip_maps(mesh.textures, bits16=True)
    return Renderer(arrays, textures, caster, light, background, surroundings(None), math.inf, None)


def _light(
    arrays: MeshArrays,
    textures: MipMaps,
    caster: RayCaster,
    points: LightPoints,
    environment: Environment,
    emitters: Array,
    ambient: float,
    seed: int,
) -> NDArray[np.float32]:
    """Compute irradiance / pi (2, G, 3) in front of the light points and behind them."""
    count = len(points.position)
    extent, offset = float(np.abs(arrays.vertices).max()), ray_offset(arrays)
    normals = np.concatenate([points.normal, -points.normal])
    positions = np.concatenate([points.position, points.position]) + offset * normals
    size = np.concatenate([points.size, points.size])
    jitter = np.random.default_rng(seed).random((2 * count, 2))
    even, bright = environment.split()
    sky = mip_maps([even], bits16=False)
    sun = _Sun(bright) if bright.max() > 0 else None
    directions = _plane_sequence(_DIRECTIONS)

    sharp = np.zeros((2 * count, 3), np.float32)
    soft = np.zeros((2 * count, 3), np.float32)
    links = np.empty((2 * count, _DIRECTIONS), np.int32)
    buried = np.empty(2 * count, np.bool_)
    with progress_bar() as progress:
        for start in progress.track(range(0, 2 * count, _CHUNK), description="Lighting the scene"):
            part = slice(start, start + _CHUNK)
            p, n, j = positions[part], normals[part], jitter[part]
            for emitter in emitters:
                rays = np.empty((len(p) * _STRATA**2, 6), np.float32)
                weights = np.empty(len(rays), np.float32)
                _lamp_rays(p, n, j, emitter, offset, rays, weights)
                _clear_blocked(caster, rays, weights)
                received = weights.reshape(len(p), -1).mean(axis=1)
                sharp[part] += received[:, None] * emitter[3].astype(np.float32)
            if sun is not None:
                rays, weights, colors = sun.rays(p, n, j, 8.0 * extent)
                _clear_blocked(caster, rays, weights)
                sharp[part] += (weights[:, None] * colors).reshape(len(p), -1, 3).mean(axis=1)
            rays = np.empty((len(p) * _DIRECTIONS, 6), np.float32)
            _gathering_rays(p, n, j, directions, rays)
            hits = caster.cast(rays)
            _gather(
                arrays,
                count,
                rays,
                hits["primitive_ids"],
                hits["t_hit"],
                hits["primitive_uvs"],
                size[part],
                sky,
                links[part],
                soft[part],
                buried[part],
            )
    albedo = _albedo(arrays, textures, count)
    direct = sharp + soft + np.float32(ambient)
    light = direct
    for _ in range(_BOUNCES):
        reflected = np.empty_like(light)
        _follow_links(links, albedo, light, reflected)
        light = direct + reflected
    del links
    neighbors = np.unique(
        np.concatenate([np.stack([points.corner[:, i], points.corner[:, i - 1]], axis=1) for i in range(3)]), axis=0
    )
    neighbors = np.concatenate([neighbors, neighbors[:, ::-1]])
    neighbors = np.concatenate([neighbors, neighbors + count])
    soft = light - sharp
    for _ in range(_SMOOTHING):
        soft = _means(neighbors, soft, ~buried)
    light = sharp + soft
    for _ in range(2):
        # A point inside or beneath another object has no light of its own. It takes the mean of its neighbors' light.
        known = ~buried
        filled = _means(neighbors[buried[neighbors[:, 0]]], light, known)
        found = np.zeros(2 * count, np.bool_)
        found[neighbors[buried[neighbors[:, 0]] & known[neighbors[:, 1]], 0]] = True
        light[found] = filled[found]
        buried &= ~found
    return np.ascontiguousarray(light.reshape(2, count, 3), np.float32)


def _plane_sequence(count: int) -> Array:
    """Return the first points (count, 2) of the R2 low-discrepancy sequence in the unit square (Roberts, 2018)."""
    plastic = 1.32471795724474602596
    return (np.arange(1, count + 1)[:, None] * np.array([1 / plastic, 1 / plastic**2])) % 1.0


def _means(neighbors: NDArray[np.int64], values: NDArray, known: NDArray[np.bool_]) -> NDArray:
    """Return the mean (N, C) over each point and its neighbors, of those that are known; the point's value if none is.

    ``neighbors`` (M, 2) are pairs of points.
    """
    to, of = neighbors[known[neighbors[:, 1]]].T
    weight = known + np.bincount(to, minlength=len(values))
    total = values * known[:, None]
    total += np.stack([np.bincount(to, column[of], len(values)) for column in values.T], axis=1)
    return np.where(weight[:, None] > 0, total / np.maximum(weight, 1)[:, None], values).astype(np.float32)


def _albedo(arrays: MeshArrays, textures: MipMaps, count: int) -> NDArray[np.float32]:
    """Return the mean color (G, 3) of the faces at each light point."""
    color = np.empty((len(arrays.faces), 3), np.float32)
    _face_colors(arrays, textures, color)
    corner = arrays.light_point.reshape(-1)
    colors = np.repeat(color, 3, axis=0)
    total = np.stack([np.bincount(corner, column, count) for column in colors.T], axis=1)
    return (total / np.bincount(corner, minlength=count)[:, None]).astype(np.float32)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _face_colors(arrays, textures, colors):
    """Fill the mean color of each face, from the mip level that has about two texels on the face."""
    for face in numba.prange(len(arrays.faces)):
        i, j, k = arrays.faces[face]
        for c in range(3):
            colors[face, c] = (arrays.color[i, c] + arrays.color[j, c] + arrays.color[k, c]) / 3.0
        if arrays.texture[face] >= 0:
            uv = arrays.uv
            nx, ny, nz = face_normal(arrays, face)
            side = math.sqrt(0.5 * math.sqrt(nx * nx + ny * ny + nz * nz))
            r, g, b = lookup(
                textures,
                arrays.texture[face],
                (uv[i, 0] + uv[j, 0] + uv[k, 0]) / 3.0,
                (uv[i, 1] + uv[j, 1] + uv[k, 1]) / 3.0,
                side * arrays.density[face],
                True,
            )
            colors[face, 0] *= r / 65535.0
            colors[face, 1] *= g / 65535.0
            colors[face, 2] *= b / 65535.0


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _lamp_rays(points, normals, jitter, lamp, offset, rays, weights):
    """Fill segments to a lamp (4, 3), and the irradiance / pi that each alone would bring from unit radiance."""
    center, half_u, half_v = lamp[0], lamp[1], lamp[2]
    nx = half_u[1] * half_v[2] - half_u[2] * half_v[1]
    ny = half_u[2] * half_v[0] - half_u[0] * half_v[2]
    nz = half_u[0] * half_v[1] - half_u[1] * half_v[0]
    for n in numba.prange(len(points)):
        for sample in range(_STRATA * _STRATA):
            a = 2.0 * (sample % _STRATA + jitter[n, 0]) / _STRATA - 1.0
            b = 2.0 * (sample // _STRATA + jitter[n, 1]) / _STRATA - 1.0
            dx = center[0] + a * half_u[0] + b * half_v[0] - points[n, 0]
            dy = center[1] + a * half_u[1] + b * half_v[1] - points[n, 1]
            dz = center[2] + a * half_u[2] + b * half_v[2] - points[n, 2]
            square = dx * dx + dy * dy + dz * dz
            distance = math.sqrt(square)
            cosine = (normals[n, 0] * dx + normals[n, 1] * dy + normals[n, 2] * dz) / distance
            # The normal of the lamp has the length of a quarter of its area.
            facing = -(nx * dx + ny * dy + nz * dz) / distance
            reach = (distance - offset) / distance
            k = n * _STRATA * _STRATA + sample
            rays[k, 0], rays[k, 1], rays[k, 2] = points[n, 0], points[n, 1], points[n, 2]
            rays[k, 3], rays[k, 4], rays[k, 5] = reach * dx, reach * dy, reach * dz
            lit = cosine > 0.0 and facing > 0.0 and reach > 0.0
            weights[k] = 4.0 * facing * cosine / (math.pi * square) if lit else 0.0


def _clear_blocked(caster: RayCaster, rays: NDArray[np.float32], weights: NDArray[np.float32]) -> None:
    """Set the weights of blocked segments to zero."""
    active = np.flatnonzero(weights)
    weights[active[caster.blocked(rays[active])]] = 0


class _Sun:
    """Sample the small and bright part of an environment in proportion to its luminance."""

    def __init__(self, radiance: NDArray[np.float32]) -> None:
        rows, columns = radiance.shape[:2]
        solid_angle = 2 * np.pi / columns * -np.diff(np.cos(np.pi * np.arange(rows + 1) / rows))
        power = (radiance.mean(axis=-1, dtype=np.float64) * solid_angle[:, None]).reshape(-1)
        texel = np.flatnonzero(power)
        self._shape = rows, columns
        self._texel = texel
        self._cumulative = np.cumsum(power[texel]) / power[texel].sum()
        per_power = radiance.reshape(-1, 3)[texel] / radiance.reshape(-1, 3)[texel].mean(axis=-1, keepdims=True)
        # Radiance divided by the probability density of the direction.
        self._color = (per_power * power.sum()).astype(np.float32)

    def rays(
        self, points: Array, normals: Array, jitter: Array, reach: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Return segments (N * samples, 6), weights and colors. The mean of weight times color is irradiance / pi."""
        rows, columns = self._shape
        rank = np.arange(_SUN_SAMPLES)
        index = np.searchsorted(self._cumulative, ((rank + jitter[:, :1]) / _SUN_SAMPLES).reshape(-1))
        index = np.minimum(index, len(self._texel) - 1)
        texel = self._texel[index]
        # An additive recurrence spreads the samples evenly over each texel.
        u = ((rank * 0.7548776662466927 + jitter[:, 1:]) % 1).reshape(-1)
        v = ((rank * 0.5698402909980532 + jitter[:, :1]) % 1).reshape(-1)
        # Uniform in solid angle: the height is uniform between the texel's edges.
        row = texel // columns
        top, bottom = np.cos(np.pi * row / rows), np.cos(np.pi * (row + 1) / rows)
        height = top + v * (bottom - top)
        ring, turn = np.sqrt(1 - height * height), 2 * np.pi * (0.5 - (texel % columns + u) / columns)
        direction = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)
        cosine = (direction.reshape(len(points), -1, 3) * normals[:, None]).sum(axis=-1).reshape(-1)
        rays = np.concatenate([np.repeat(points, _SUN_SAMPLES, axis=0), reach * direction], axis=1)
        weights = np.maximum(cosine, 0) / np.pi
        return rays.astype(np.float32), weights.astype(np.float32), self._color[index]


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _gathering_rays(points, normals, jitter, directions, rays):
    """Fill rays in cosine-weighted directions: ``directions`` (K, 2) in the unit square, shifted by the jitter."""
    for n in numba.prange(len(points)):
        nx, ny, nz = normals[n, 0], normals[n, 1], normals[n, 2]
        # Tangent frame without a branch per axis: Duff et al., JCGT 2017.
        sign = math.copysign(1.0, nz)
        a = -1.0 / (sign + nz)
        b = nx * ny * a
        tx, ty, tz = 1.0 + sign * nx * nx * a, sign * b, -sign * nx
        bx, by, bz = b, sign + ny * ny * a, -ny
        for k in range(len(directions)):
            angle = 2.0 * math.pi * (directions[k, 0] + jitter[n, 0])
            square = (directions[k, 1] + jitter[n, 1]) % 1.0
            u, v, w = math.sqrt(square) * math.cos(angle), math.sqrt(square) * math.sin(angle), math.sqrt(1.0 - square)
            ray = rays[n * len(directions) + k]
            ray[0], ray[1], ray[2] = points[n, 0], points[n, 1], points[n, 2]
            ray[3] = u * tx + v * bx + w * nx
            ray[4] = u * ty + v * by + w * ny
            ray[5] = u * tz + v * bz + w * nz


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _gather(arrays, half, rays, hits, distance, coordinates, size, sky, links, received, buried):
    """Fill, for each point, where its rays end, the light of the sky, and whether the point is buried.

    A link is the light point nearest to the hit, plus ``half`` for the back of a surface, or -1 for the sky. A point is
    buried if it lies inside an object or right beneath one.
    """
    count = links.shape[1]
    for n in numba.prange(len(links)):
        red, green, blue, behind, near = 0.0, 0.0, 0.0, 0, 0
        for k in range(count):
            i = n * count + k
            dx, dy, dz = rays[i, 3], rays[i, 4], rays[i, 5]
            face = hits[i]
            if face == NOTHING:
                links[n, k] = -1
                r, g, b = panorama(sky, dx, dy, dz, 1.0)
                red += r
                green += g
                blue += b
                continue
            nx, ny, nz = face_normal(arrays, face)
            facing = dx * nx + dy * ny + dz * nz
            second_weight, third_weight = coordinates[i, 0], coordinates[i, 1]
            nearest = 0
            if max(second_weight, third_weight) > 1.0 - second_weight - third_weight:
                nearest = 1 if second_weight >= third_weight else 2
            links[n, k] = arrays.light_point[face, nearest] + (half if facing > 0.0 else 0)
            behind += facing > 0.0
            near += distance[i] < size[n]
        received[n, 0] = red / count
        received[n, 1] = green / count
        received[n, 2] = blue / count
        buried[n] = behind > 0.75 * count or near == count


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _follow_links(links, albedo, light, reflected):
    """Fill the light (2 G, 3) that each point receives from the points at the ends of its rays."""
    half, count = len(albedo), links.shape[1]
    for n in numba.prange(len(links)):
        red, green, blue = 0.0, 0.0, 0.0
        for k in range(count):
            link = links[n, k]
            if link < 0:
                continue
            point = link - half if link >= half else link
            red += albedo[point, 0] * light[link, 0]
            green += albedo[point, 1] * light[link, 1]
            blue += albedo[point, 2] * light[link, 2]
        reflected[n, 0] = red / count
        reflected[n, 1] = green / count
        reflected[n, 2] = blue / count
