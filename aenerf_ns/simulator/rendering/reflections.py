"""Reflections of glossy surfaces, which depend on the view, over diffuse light, which does not.

A coat reflects the share F of the light and lets the share 1 - F through to a diffuse ground. F follows Schlick's
approximation (1994) from the reflectance at normal incidence. The coat is a microfacet surface with Gaussian slopes
(Beckmann and Spizzichino, 1963; GGX has longer tails) and alpha = roughness^2. Its lobe around the mirrored direction
is taken as an isotropic Gaussian: facets turn by a standard deviation of alpha / sqrt(2) about each axis, and reflected
directions turn by twice that. One ray is cast along the mirrored direction. Lamps, environment and textures are
averaged over the lobe, so pictures have no noise of sampling. Only the edges of reflected meshes stay sharp.

A surface that is seen in a reflection shows the light that a diffuse surface reflects.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.simulator.arrays import Array
from aenerf_ns.simulator.rendering.embree import NOTHING, Hits, RayCaster
from aenerf_ns.simulator.rendering.mesh import Mesh
from aenerf_ns.simulator.rendering.mip_maps import MipMaps, panorama
from aenerf_ns.simulator.rendering.surface import FOOTPRINT, Surface, diffuse_radiance, face_normal
from aenerf_ns.simulator.rendering.vectors import add_scaled, cross, divide, dot, interpolate, length, row, subtract
from aenerf_ns.threads import run_ranges

_MIN_SINE = 0.01
"""Of the angle between a mirrored ray and its face. An interpolated normal may mirror rays into the face."""


class Reflections(NamedTuple):
    """The coats of a mesh of F faces and G light points, and the light that they reflect beside that from the mesh."""

    specular: NDArray[np.float32]  # (F,) reflectance at normal incidence, 0 where a face is diffuse
    lobe: NDArray[np.float32]  # (F,) standard deviation of reflected directions, in radians
    curvature: NDArray[np.float32]  # (F,) turn of the normal along the face, in radians per meter
    normal: Array  # (G, 3) unit
    lamps: Array  # (L, 4, 3) center, half sides and radiance
    environment: MipMaps  # light from far away
    ambient: float  # radiance that arrives from everywhere


def make_reflections(
    mesh: Mesh, light_point: NDArray[np.integer], normal: Array, lamps: Array, environment: MipMaps, ambient: float
) -> Reflections:
    """Build the reflections of a mesh, given the light points (F, 3) of its corners and their unit normals (G, 3)."""
    specular, roughness = mesh.gloss.T.astype(np.float32)
    corners, normals = mesh.vertices[mesh.faces], normal[light_point]
    side = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1)
    turn = np.linalg.norm(np.roll(normals, -1, axis=1) - normals, axis=-1)
    curvature = (turn / np.maximum(side, 1e-300)).max(axis=1).astype(np.float32)
    lobe = np.float32(math.sqrt(2.0)) * roughness**2
    return Reflections(specular, lobe, curvature, normal, lamps, environment, ambient)


def add_reflections(
    reflections: Reflections,
    surface: Surface,
    light: NDArray[np.float32],
    caster: RayCaster,
    rays: NDArray[np.float32],
    hits: Hits,
    focal_length: float,
    limit: float,
    radiance: NDArray[np.float32],
) -> None:
    """Add to a picture what its glossy surfaces reflect, and take from it what they keep from their diffuse ground.

    Args:
        reflections, surface, light, caster, limit: see `Renderer`.
        rays, hits: rays (rows * columns * samples, 6), one meter long along the optical axis, and what they hit.
        focal_length: in pixels.
        radiance: (rows, columns, 3) diffuse picture, changed in place.
    """
    glossy = np.flatnonzero(hits.face != NOTHING)
    glossy = glossy[reflections.specular[hits.face[glossy]] > 0]
    first = Hits(*(column[glossy] for column in hits))
    mirrored = np.empty((len(glossy), 6), np.float32)
    optics, diffuse, change = (np.empty((len(glossy), 3)) for _ in range(3))
    seen = rays[glossy], first, focal_length, surface.ray_offset
    run_ranges(partial(_mirror, surface, light, reflections, *seen, mirrored, optics, diffuse), len(glossy))
    found = mirrored, caster.cast(mirrored), optics, diffuse
    run_ranges(partial(_reflect, surface, light, reflections, *found, limit, change), len(glossy))
    rows, columns = radiance.shape[:2]
    samples = len(rays) // (rows * columns)
    for channel in range(3):
        total = np.bincount(glossy // samples, change[:, channel], rows * columns)
        radiance[..., channel] += total.reshape(rows, columns) / samples


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mirror(surface, light, reflections, rays, hits, focal_length, offset, mirrored, optics, diffuse, begin, end):
    """Fill the mirrored rays (N, 6) of rays that hit glossy faces, with unit directions, and the diffuse light there.

    ``optics`` (N, 3) are the Fresnel reflectance, the standard deviation of the reflected directions over the sample's
    region, in radians, and the side of that region in meters.
    """
    for n in range(begin, end):
        face, weights = hits.face[n], hit_weights(hits, n)
        direction = float(rays[n, 3]), float(rays[n, 4]), float(rays[n, 5])
        size = length(direction)
        direction = divide(direction, size)
        face_direction = face_normal(surface, face)
        facing = dot(face_direction, direction)
        side = 0 if facing < 0.0 else 1
        # Both normals are turned towards the camera.
        towards = 1.0 if side == 0 else -1.0
        area = towards * length(face_direction)
        face_direction = divide(face_direction, area)
        normal = interpolate(reflections.normal, row(surface.light_point, face), weights)
        normal = divide(normal, towards * length(normal))
        cosine = -dot(normal, direction)
        reflected = add_scaled(direction, 2.0 * cosine, normal)
        rise = max(_MIN_SINE - dot(reflected, face_direction), 0.0)
        reflected = add_scaled(reflected, rise, face_direction)
        reflected = divide(reflected, length(reflected))
        depth = hits.distance[n]
        origin = add_scaled(add_scaled(row(rays, n), depth * size, direction), offset, face_direction)
        for axis in range(3):
            mirrored[n, axis], mirrored[n, 3 + axis] = origin[axis], reflected[axis]

        specular = reflections.specular[face]
        # No surface reflects less than 2 % at normal incidence. Below that, the reflectance at grazing angles fades too
        # (Lagarde and de Rousiers, 2014).
        grazing = min(50.0 * specular, 1.0)
        optics[n, 0] = specular + (grazing - specular) * (1.0 - min(max(cosine, 0.0), 1.0)) ** 5
        footprint = FOOTPRINT * depth / (focal_length * math.sqrt(max(abs(facing / area), 0.02)))
        bend, view = reflections.curvature[face] * footprint, 0.5 * FOOTPRINT / focal_length
        optics[n, 1] = math.sqrt(reflections.lobe[face] ** 2 + bend * bend + view * view)
        optics[n, 2] = footprint
        diffuse[n, 0], diffuse[n, 1], diffuse[n, 2] = diffuse_radiance(surface, light, face, side, weights, footprint)


@numba.njit(cache=True, error_model="numpy")
def hit_weights(hits, n):
    """Return the barycentric coordinates of a hit."""
    wj, wk = float(hits.coordinates[n, 0]), float(hits.coordinates[n, 1])
    return 1.0 - wj - wk, wj, wk


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _reflect(surface, light, reflections, rays, hits, optics, diffuse, limit, change, begin, end):
    """Fill how the radiance (N, 3) of glossy surfaces differs from the diffuse radiance, given their mirrored rays."""
    environment, ambient = reflections.environment, reflections.ambient
    for n in range(begin, end):
        direction = float(rays[n, 3]), float(rays[n, 4]), float(rays[n, 5])
        reflectance, lobe, footprint = row(optics, n)
        face, distance = hits.face[n], hits.distance[n]
        if face == NOTHING:
            # A region of side 2 s has about the spread of a Gaussian of standard deviation s, once interpolated.
            per_radian = environment.level[0, 2] / (2.0 * math.pi)
            r, g, b = panorama(environment, direction, 2.0 * lobe * per_radian)
        else:
            normal = face_normal(surface, face)
            facing = dot(normal, direction)
            slant = max(abs(facing) / length(normal), 0.02)
            region = (footprint + 2.0 * lobe * distance) / math.sqrt(slant)
            side = 0 if facing < 0.0 else 1
            r, g, b = diffuse_radiance(surface, light, face, side, hit_weights(hits, n), region)
        r, g, b = r + ambient, g + ambient, b + ambient
        for lamp in reflections.lamps:
            covered = _covered_share(lamp, row(rays, n), direction, distance, lobe)
            r += covered * (lamp[3, 0] - r)
            g += covered * (lamp[3, 1] - g)
            b += covered * (lamp[3, 2] - b)
        for channel, reflected in enumerate((r, g, b)):
            ground = diffuse[n, channel]
            change[n, channel] = min(ground + reflectance * (reflected - ground), limit) - ground


@numba.njit(cache=True, error_model="numpy")
def _covered_share(lamp, origin, direction, reach, lobe):
    """Return the share of a Gaussian lobe around a ray that a lamp (4, 3) covers. The ray ends at ``reach``."""
    half_u, half_v = row(lamp, 1), row(lamp, 2)
    normal = cross(half_u, half_v)
    facing = dot(normal, direction)
    if facing >= 0.0:
        return 0.0
    from_center = subtract(origin, row(lamp, 0))
    distance = -dot(normal, from_center) / facing
    if not 0.0 < distance < reach:
        return 0.0
    meeting = add_scaled(from_center, distance, direction)
    square = dot(normal, normal)
    share = 1.0
    # The vector along which the position in units of one half side grows: across the other half side.
    for growth in (cross(half_v, normal), cross(normal, half_u)):
        position = dot(growth, meeting) / square
        # The lobe's direction moves the position on the lamp's plane by this vector per meter of distance and radian.
        along = dot(growth, direction) / facing
        moved = add_scaled(growth, -along, normal)
        width = math.sqrt(2.0 * dot(moved, moved)) * lobe * distance / square
        share *= 0.5 * (math.erf((1.0 - position) / width) + math.erf((1.0 + position) / width))
    return share
