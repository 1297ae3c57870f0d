"""Compute the light that a mesh receives, once, on both sides of its faces.

The light consists of direct light of lamps and of the sun with soft shadows, light of the sky, and diffuse bounces. It
is computed at the corners of the faces; faces are small enough for light to be linear between their corners. Rays are
cast once: the points where gathering rays end are kept as links, and every bounce follows the same links.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from aenerf_ns.progress import track
from aenerf_ns.simulator.arrays import Array, Panorama
from aenerf_ns.simulator.rendering.embree import NOTHING, RayCaster
from aenerf_ns.simulator.rendering.environment import row_weights, split
from aenerf_ns.simulator.rendering.mesh import Mesh, normals_and_areas, position_ids
from aenerf_ns.simulator.rendering.mip_maps import lookup, mip_maps, panorama
from aenerf_ns.simulator.rendering.reflections import hit_weights, make_reflections
from aenerf_ns.simulator.rendering.renderer import Renderer
from aenerf_ns.simulator.rendering.surface import Surface, face_normal, make_surface
from aenerf_ns.simulator.rendering.vectors import dot, length, row
from aenerf_ns.threads import run_ranges

_CREASE = math.cos(math.radians(40.0))
"""Cosine of the angle below which adjacent faces belong to one smooth surface."""
_DIRECTIONS = 64
_STRATA = 4
_SUN_SAMPLES = 32
_BOUNCES = 12
_SMOOTHING = 4
_CHUNK = 1 << 14
_R2_STEP = np.array([0.7548776662466927, 0.5698402909980532])
"""Of the R2 low-discrepancy sequence in the unit square (Roberts, 2018): 1 / p and 1 / p^2 of the plastic number p."""


class AreaLight(NamedTuple):
    """An invisible rectangle that shines to one side, that of half_u x half_v."""

    center: ArrayLike  # (3,) in meters
    half_u: ArrayLike  # (3,) from the center to the middle of a side, in meters
    half_v: ArrayLike
    radiance: ArrayLike  # (3,) linear RGB, uniform


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
    corners = mesh.vertices[mesh.faces]
    normals, _ = normals_and_areas(mesh)
    position_id = position_ids(mesh.vertices)[mesh.faces].reshape(-1)
    order = np.argsort(position_id, kind="stable")
    start = np.searchsorted(position_id[order], np.arange(position_id.max() + 2))
    corner = np.full(len(position_id), -1)  # of no group yet
    count = _smooth_parts(start, order, normals, corner)
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
    neighbors = np.concatenate([np.roll(position_id.reshape(-1, 3), turn, axis=1).reshape(-1) for turn in (1, 2)])
    edges = np.concatenate([corner, corner]) * (position_id.max() + 1) + neighbors
    edge, uses = np.unique(edges, return_counts=True)
    is_open = np.zeros(count, bool)
    is_open[edge[uses == 1] // (position_id.max() + 1)] = True
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
    for position in range(len(start) - 1):
        corners = order[start[position] : start[position + 1]]
        for first in corners:
            if part[first] >= 0:
                continue
            part[first] = count
            # Grow the group from face to face.
            members = [first]
            while members:
                normal = row(normals, members.pop() // 3)
                for other in corners:
                    if part[other] < 0 and dot(normal, row(normals, other // 3)) > _CREASE:
                        part[other] = count
                        members.append(other)
            count += 1
    return count


def light_mesh(
    mesh: Mesh,
    environment: Panorama,
    lamps: Sequence[AreaLight],
    background: Array | None,
    *,
    ambient: float = 0.0,
    seed: int = 0,
) -> Renderer:
    """Light a mesh on both sides of its faces.

    Light that a glossy face passes on to other faces is computed as if the face were diffuse.

    Args:
        mesh: the mesh.
        environment, lamps: the light.
        background: (3,) radiance where a camera's ray hits nothing, or None where the environment is seen there.
        ambient: radiance that reaches every surface from all sides, occluded or not. It keeps crevices from going
            black, where small differences would become large contrasts of log-radiance.
        seed: of the sampling.
    """
    points = light_points(mesh)
    surface = make_surface(mesh, points.corner)
    emitters = np.array(lamps, np.float64).reshape(-1, 4, 3)
    light = compute_light(surface, mesh.caster, points, environment, emitters, ambient, seed)
    glow = np.zeros(len(points.position), np.float32)
    np.maximum.at(glow, points.corner, mesh.emission[:, None].astype(np.float32))
    light += glow[:, None]
    gloss = None
    if mesh.gloss[:, 0].any():
        far = mip_maps([environment], bits16=False)
        gloss = make_reflections(mesh, points.corner, points.normal, emitters, far, ambient)
    seen = mip_maps([environment] if background is None else [], bits16=False)
    return Renderer(surface, mesh.caster, light, background, seen, reflections=gloss)


def baked_mesh(mesh: Mesh, background: Array | None) -> Renderer:
    """Return a renderer of a mesh whose colors are radiance, in front of a uniform background (3,) or of black."""
    surface, light = make_surface(mesh, np.zeros_like(mesh.faces)), np.ones((2, 1, 3), np.float32)
    return Renderer(surface, mesh.caster, light, background, mip_maps([], bits16=False))


def compute_light(
    surface: Surface,
    caster: RayCaster,
    points: LightPoints,
    environment: Panorama,
    emitters: Array,
    ambient: float,
    seed: int,
) -> NDArray[np.float32]:
    """Compute irradiance / pi (2, G, 3) in front of the light points and behind them."""
    count, offset = len(points.position), surface.ray_offset
    normals = np.concatenate([points.normal, -points.normal])
    positions = np.concatenate([points.position, points.position]) + offset * normals
    size = np.concatenate([points.size, points.size])
    jitter = np.random.default_rng(seed).random((2 * count, 2))
    even, bright = split(environment)
    sky = mip_maps([even], bits16=False)
    sun = _Sun(bright, 8.0 * float(np.abs(surface.vertices).max())) if bright.max() > 0 else None
    directions = (np.arange(1, _DIRECTIONS + 1)[:, None] * _R2_STEP) % 1.0

    sharp = np.zeros((2 * count, 3), np.float32)
    sky_light = np.zeros((2 * count, 3), np.float32)
    links = np.empty((2 * count, _DIRECTIONS), np.int32)
    buried = np.empty(2 * count, np.bool_)
    for start in track(range(0, 2 * count, _CHUNK), "Lighting the scene"):
        part = slice(start, start + _CHUNK)
        p, n, j = positions[part], normals[part], jitter[part]
        for emitter in emitters:
            rays, weights = _lamp_rays(p, n, j, emitter, offset)
            _clear_blocked(caster, rays, weights)
            received = weights.reshape(len(p), -1).mean(axis=1)
            sharp[part] += received[:, None] * emitter[3].astype(np.float32)
        if sun is not None:
            rays, weights, colors = sun.rays(p, n, j)
            _clear_blocked(caster, rays, weights)
            sharp[part] += (weights[:, None] * colors).reshape(len(p), -1, 3).mean(axis=1)
        rays = np.empty((len(p) * _DIRECTIONS, 6), np.float32)
        run_ranges(partial(_gathering_rays, p, n, j, directions, rays), len(p))
        hits = caster.cast(rays)
        found = links[part], sky_light[part], buried[part]
        run_ranges(partial(_gather, surface, count, rays, hits, size[part], sky, *found), len(p))
    albedo = np.tile(_mean_albedo(surface, count), (2, 1))
    direct = sharp + sky_light + np.float32(ambient)
    # The mean over a point's rays of the light at their ends, as a matrix.
    ends_in_sight = links >= 0
    row_starts = np.append(0, ends_in_sight.sum(axis=1).cumsum()).astype(links.dtype)
    gathering = csr_array((np.ones(row_starts[-1]), links[ends_in_sight], row_starts), shape=(2 * count, 2 * count))
    light = direct
    for _ in range(_BOUNCES):
        light = direct + (gathering @ (albedo * light) / _DIRECTIONS).astype(np.float32)
    sides = [np.stack([points.corner[:, i], points.corner[:, i - 1]], axis=1) for i in range(3)]
    return _smooth(light, sharp, buried, np.unique(np.concatenate(sides), axis=0)).reshape(2, count, 3)


def _smooth(
    light: NDArray[np.float32], sharp: NDArray[np.float32], buried: NDArray[np.bool_], edges: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Smooth the light but for its sharp part, all (2 G, 3), and fill it in where points are buried.

    ``edges`` (M, 2) are pairs of neighboring points.
    """
    # The points that are averaged on either side of each point: its neighbors and itself.
    near = np.concatenate([edges, edges[:, ::-1], np.arange(len(light) // 2).repeat(2).reshape(-1, 2)])
    near = np.concatenate([near, near + len(light) // 2])
    matrix = csr_array((np.ones(len(near)), near.T), shape=(len(light), len(light)))

    def means(values: NDArray[np.float32], known: NDArray[np.bool_]) -> tuple[NDArray, NDArray[np.bool_]]:
        """Return the means (2 G, 3) over each point and its neighbors, of those that are known, and where any is."""
        weight = matrix @ known
        total = (matrix @ np.where(known[:, None], values, 0)).astype(np.float32)
        return (total / np.maximum(weight, 1)[:, None]).astype(np.float32), weight > 0

    soft = light - sharp
    for _ in range(_SMOOTHING):
        smooth, found = means(soft, ~buried)
        soft = np.where(found[:, None], smooth, soft)
    light = sharp + soft
    for _ in range(2):
        # A point inside or beneath another object has no light of its own. It takes the mean of its neighbors' light.
        filled, found = means(light, ~buried)
        found &= buried
        light[found] = filled[found]
        buried = buried & ~found
    return light


def _mean_albedo(surface: Surface, count: int) -> NDArray[np.float32]:
    """Return the mean color (G, 3) of the faces at each light point."""
    color = np.empty((len(surface.faces), 3), np.float32)
    run_ranges(partial(_face_colors, surface, color), len(color))
    corner = surface.light_point.reshape(-1)
    total = np.stack([np.bincount(corner, column, count) for column in np.repeat(color, 3, axis=0).T], axis=1)
    return (total / np.bincount(corner, minlength=count)[:, None]).astype(np.float32)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _face_colors(surface, colors, begin, end):
    """Fill the mean color of each face, from the mip level that has about two texels on the face."""
    for face in range(begin, end):
        i, j, k = surface.faces[face]
        for c in range(3):
            colors[face, c] = (surface.color[i, c] + surface.color[j, c] + surface.color[k, c]) / 3.0
        if surface.texture[face] >= 0:
            u = (surface.uv[i, 0] + surface.uv[j, 0] + surface.uv[k, 0]) / 3.0
            v = (surface.uv[i, 1] + surface.uv[j, 1] + surface.uv[k, 1]) / 3.0
            side = math.sqrt(0.5 * length(face_normal(surface, face)))
            texel = lookup(surface.textures, surface.texture[face], u, v, side * surface.density[face], True)
            for c in range(3):
                colors[face, c] *= texel[c] / 65535.0


def _lamp_rays(
    points: Array, normals: Array, jitter: Array, lamp: Array, offset: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return segments (N * samples, 6) to a lamp (4, 3), and the irradiance / pi that each alone would bring.

    The irradiance is of unit radiance.
    """
    center, half_u, half_v, _ = lamp
    sample = np.arange(_STRATA**2)
    a = 2.0 * (sample % _STRATA + jitter[:, :1]) / _STRATA - 1.0
    b = 2.0 * (sample // _STRATA + jitter[:, 1:]) / _STRATA - 1.0
    direction = center + a[..., None] * half_u + b[..., None] * half_v - points[:, None]
    square = (direction * direction).sum(axis=-1)
    distance = np.sqrt(square)
    cosine = (normals[:, None] * direction).sum(axis=-1) / distance
    # The cross product is a quarter of the lamp's area long.
    facing = -(np.cross(half_u, half_v) * direction).sum(axis=-1) / distance
    reach = (distance - offset) / distance
    rays = np.concatenate([np.broadcast_to(points[:, None], direction.shape), reach[..., None] * direction], axis=-1)
    is_lit = (cosine > 0) & (facing > 0) & (reach > 0)
    weights = np.where(is_lit, 4.0 * facing * cosine / (np.pi * square), 0.0)
    return rays.reshape(-1, 6).astype(np.float32), weights.reshape(-1).astype(np.float32)


def _clear_blocked(caster: RayCaster, rays: NDArray[np.float32], weights: NDArray[np.float32]) -> None:
    """Set the weights of blocked segments to zero."""
    active = np.flatnonzero(weights)
    weights[active[caster.blocked(rays[active])]] = 0


class _Sun:
    """Sample the small and bright part of an environment in proportion to its luminance.

    Args:
        radiance: (rows, columns, 3) of the bright part, zero elsewhere.
        distance: length of the segments towards it, in meters.
    """

    def __init__(self, radiance: NDArray[np.float32], distance: float) -> None:
        rows, columns = radiance.shape[:2]
        solid_angle = 2 * np.pi / columns * row_weights(rows)
        power = (radiance.mean(axis=-1, dtype=np.float64) * solid_angle[:, None]).reshape(-1)
        self._shape, self._distance = (rows, columns), distance
        self._texel = np.flatnonzero(power)
        self._cumulative = np.cumsum(power[self._texel]) / power[self._texel].sum()
        bright = radiance.reshape(-1, 3)[self._texel]
        # Radiance divided by the probability density of the direction.
        self._color = (bright / bright.mean(axis=-1, keepdims=True) * power.sum()).astype(np.float32)

    def rays(
        self, points: Array, normals: Array, jitter: Array
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Return segments (N * samples, 6), weights and colors. The mean of weight times color is irradiance / pi."""
        rows, columns = self._shape
        rank = np.arange(_SUN_SAMPLES)
        index = np.searchsorted(self._cumulative, ((rank + jitter[:, :1]) / _SUN_SAMPLES).reshape(-1))
        index = np.minimum(index, len(self._texel) - 1)
        texel = self._texel[index]
        # The sequence spreads the samples evenly over each texel.
        u = ((rank * _R2_STEP[0] + jitter[:, 1:]) % 1).reshape(-1)
        v = ((rank * _R2_STEP[1] + jitter[:, :1]) % 1).reshape(-1)
        # Uniform in solid angle: the height is uniform between the texel's edges.
        row = texel // columns
        top, bottom = np.cos(np.pi * row / rows), np.cos(np.pi * (row + 1) / rows)
        height = top + v * (bottom - top)
        ring, turn = np.sqrt(1 - height * height), 2 * np.pi * (0.5 - (texel % columns + u) / columns)
        direction = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)
        cosine = (direction.reshape(len(points), -1, 3) * normals[:, None]).sum(axis=-1).reshape(-1)
        rays = np.concatenate([np.repeat(points, _SUN_SAMPLES, axis=0), self._distance * direction], axis=1)
        weights = np.maximum(cosine, 0) / np.pi
        return rays.astype(np.float32), weights.astype(np.float32), self._color[index]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _gathering_rays(points, normals, jitter, directions, rays, begin, end):
    """Fill rays in cosine-weighted directions: ``directions`` (K, 2) in the unit square, shifted by the jitter."""
    for n in range(begin, end):
        nx, ny, nz = row(normals, n)
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
            ray[0], ray[1], ray[2] = row(points, n)
            ray[3] = u * tx + v * bx + w * nx
            ray[4] = u * ty + v * by + w * ny
            ray[5] = u * tz + v * bz + w * nz


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _gather(surface, half, rays, hits, size, sky, links, received, buried, begin, end):
    """Fill, for each point, where its rays end, the light of the sky, and whether the point is buried.

    A link is the light point nearest to the hit, plus ``half`` for the back of a surface, or -1 for the sky. A point is
    buried if it lies inside an object or right beneath one.
    """
    count = links.shape[1]
    for n in range(begin, end):
        red, green, blue, behind, near = 0.0, 0.0, 0.0, 0, 0
        for k in range(count):
            i = n * count + k
            direction, face = (rays[i, 3], rays[i, 4], rays[i, 5]), hits.face[i]
            if face == NOTHING:
                links[n, k] = -1
                r, g, b = panorama(sky, direction, 1.0)
                red += r
                green += g
                blue += b
                continue
            facing = dot(direction, face_normal(surface, face))
            first, second, third = hit_weights(hits, i)
            nearest = 0 if first >= max(second, third) else (1 if second >= third else 2)
            links[n, k] = surface.light_point[face, nearest] + (half if facing > 0.0 else 0)
            behind += facing > 0.0
            near += hits.distance[i] < size[n]
        received[n, 0], received[n, 1], received[n, 2] = red / count, green / count, blue / count
        buried[n] = behind > 0.75 * count or near == count
