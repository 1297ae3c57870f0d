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
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.simulator.arrays import Array
from aenerf_ns.simulator.rendering.embree import NOTHING, RayCaster
from aenerf_ns.simulator.rendering.mesh import Mesh
from aenerf_ns.simulator.rendering.mip_maps import MipMaps, panorama
from aenerf_ns.simulator.rendering.surface import FOOTPRINT, MeshArrays, diffuse_radiance, face_normal, ray_offset

_LOWEST = 0.01
"""Least sine of the angle between a mirrored ray and its face. An interpolated normal may mirror rays into the face."""


class Coats(NamedTuple):
    """The coats of a mesh as the compiled functions read them: F faces, G light points."""

    specular: NDArray[np.float32]  # (F,) reflectance at normal incidence, 0 where a face is diffuse
    lobe: NDArray[np.float32]  # (F,) standard deviation of reflected directions, in radians
    curvature: NDArray[np.float32]  # (F,) turn of the normal along the face, in radians per meter
    normal: Array  # (G, 3) unit


@dataclass(frozen=True)
class Reflections:
    """The coats of a mesh, and the light that they reflect beside the light from the mesh itself.

    Attributes:
        coats: the coats.
        lamps: (L, 4, 3) center, half sides and radiance.
        environment: light from far away.
        ambient: radiance that arrives from everywhere.
    """

    coats: Coats
    lamps: Array
    environment: MipMaps
    ambient: float

    def scaled(self, gain: float) -> Reflections:
        """Return the reflections of the same surfaces in ``gain`` times the light."""
        return Reflections(
            self.coats,
            self.lamps * np.array([1.0, 1.0, 1.0, gain])[:, None],
            self.environment._replace(texels=(gain * self.environment.texels).astype(np.float32)),
            gain * self.ambient,
        )


def reflections(
    mesh: Mesh, light_point: NDArray[np.integer], normal: Array, lamps: Array, environment: MipMaps, ambient: float
) -> Reflections:
    """Return the reflections of a mesh.

    Args:
        mesh: the mesh.
        light_point: (F, 3) light point of each corner.
        normal: (G, 3) unit normals of the light points. They are interpolated over the faces.
        lamps: (L, 4, 3) center, half sides and radiance.
        environment: light from far away.
        ambient: radiance that reaches every surface from all sides.
    """
    specular, roughness = mesh.gloss.T.astype(np.float32)
    corners, normals = mesh.vertices[mesh.faces], normal[light_point]
    length = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1)
    turn = np.linalg.norm(np.roll(normals, -1, axis=1) - normals, axis=-1)
    curvature = (turn / np.maximum(length, 1e-300)).max(axis=1).astype(np.float32)
    coats = Coats(specular, np.float32(math.sqrt(2.0)) * roughness**2, curvature, normal)
    return Reflections(coats, lamps, environment, ambient)


def add_reflections(
    reflected: Reflections,
    arrays: MeshArrays,
    textures: MipMaps,
    light: NDArray[np.float32],
    caster: RayCaster,
    rays: NDArray[np.float32],
    hits: dict[str, NDArray],
    focal_length: float,
    samples: int,
    limit: float,
    radiance: NDArray[np.float32],
) -> None:
    """Add to a picture what its glossy surfaces reflect, and take from it what they keep from their diffuse ground.

    Args:
        reflected, arrays, textures, light, caster: see `Renderer`.
        rays: (rows * columns * samples, 6) rays through the picture, one meter long along the optical axis.
        hits: what the rays hit, from the ray caster.
        focal_length: in pixels.
        samples: rays per pixel.
        limit: the radiance of a glossy surface is clipped to this value.
        radiance: (rows, columns, 3) diffuse picture, changed in place.
    """
    seen = np.flatnonzero(hits["primitive_ids"] != NOTHING)
    seen = seen[reflected.coats.specular[hits["primitive_ids"][seen]] > 0]
    first = tuple(hits[name][seen] for name in ("primitive_ids", "primitive_uvs", "t_hit"))
    mirrored = np.empty((len(seen), 6), np.float32)
    optics, diffuse = np.empty((len(seen), 3)), np.empty((len(seen), 3))
    offset = ray_offset(arrays)
    _mirror(
        arrays, textures, light, reflected.coats, rays[seen], *first, focal_length, offset, mirrored, optics, diffuse
    )
    second = caster.cast(mirrored)
    change = np.empty((len(seen), 3))
    second_hits = tuple(second[name] for name in ("primitive_ids", "primitive_uvs", "t_hit"))
    _reflect(
        arrays,
        textures,
        light,
        reflected.lamps,
        reflected.environment,
        reflected.ambient,
        mirrored,
        *second_hits,
        optics,
        diffuse,
        limit,
        change,
    )
    rows, columns = radiance.shape[:2]
    for channel in range(3):
        total = np.bincount(seen // samples, change[:, channel], rows * columns)
        radiance[..., channel] += total.reshape(rows, columns) / samples


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _mirror(
    arrays, textures, light, coats, rays, faces, coordinates, depth, focal_length, offset, mirrored, optics, diffuse
):
    """Fill the mirrored rays (N, 6) of rays that hit glossy faces, with unit directions, and the diffuse light there.

    ``optics`` (N, 3) are the Fresnel reflectance, the standard deviation of the reflected directions over the sample's
    region, in radians, and the side of that region in meters.
    """
    for n in numba.prange(len(rays)):
        face = faces[n]
        wj, wk = float(coordinates[n, 0]), float(coordinates[n, 1])
        wi = 1.0 - wj - wk
        dx, dy, dz = float(rays[n, 3]), float(rays[n, 4]), float(rays[n, 5])
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx / length, dy / length, dz / length
        gx, gy, gz = face_normal(arrays, face)
        facing = gx * dx + gy * dy + gz * dz
        side = 0 if facing < 0.0 else 1
        towards = 1.0 if side == 0 else -1.0
        area = towards * math.sqrt(gx * gx + gy * gy + gz * gz)
        gx, gy, gz = gx / area, gy / area, gz / area
        li, lj, lk = arrays.light_point[face, 0], arrays.light_point[face, 1], arrays.light_point[face, 2]
        normal = coats.normal
        nx = wi * normal[li, 0] + wj * normal[lj, 0] + wk * normal[lk, 0]
        ny = wi * normal[li, 1] + wj * normal[lj, 1] + wk * normal[lk, 1]
        nz = wi * normal[li, 2] + wj * normal[lj, 2] + wk * normal[lk, 2]
        norm = towards * math.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx / norm, ny / norm, nz / norm
        cosine = -(nx * dx + ny * dy + nz * dz)
        rx, ry, rz = dx + 2.0 * cosine * nx, dy + 2.0 * cosine * ny, dz + 2.0 * cosine * nz
        rise = max(_LOWEST - (rx * gx + ry * gy + rz * gz), 0.0)
        rx, ry, rz = rx + rise * gx, ry + rise * gy, rz + rise * gz
        norm = math.sqrt(rx * rx + ry * ry + rz * rz)
        distance = depth[n] * length
        mirrored[n, 0] = rays[n, 0] + distance * dx + offset * gx
        mirrored[n, 1] = rays[n, 1] + distance * dy + offset * gy
        mirrored[n, 2] = rays[n, 2] + distance * dz + offset * gz
        mirrored[n, 3], mirrored[n, 4], mirrored[n, 5] = rx / norm, ry / norm, rz / norm

        specular = coats.specular[face]
        # No surface reflects less than 2 % at normal incidence. Below that, the reflectance at grazing angles fades too
        # (Lagarde and de Rousiers, 2014).
        grazing = min(50.0 * specular, 1.0)
        optics[n, 0] = specular + (grazing - specular) * (1.0 - min(max(cosine, 0.0), 1.0)) ** 5
        footprint = FOOTPRINT * depth[n] / (focal_length * math.sqrt(max(abs(facing / area), 0.02)))
        bend, view = coats.curvature[face] * footprint, 0.5 * FOOTPRINT / focal_length
        optics[n, 1] = math.sqrt(coats.lobe[face] ** 2 + bend * bend + view * view)
        optics[n, 2] = footprint
        diffuse[n, 0], diffuse[n, 1], diffuse[n, 2] = diffuse_radiance(
            arrays, textures, light, face, side, wi, wj, wk, footprint
        )


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _reflect(
    arrays,
    textures,
    light,
    lamps,
    environment,
    ambient,
    rays,
    faces,
    coordinates,
    distance,
    optics,
    diffuse,
    limit,
    change,
):
    """Fill how the radiance (N, 3) of glossy surfaces differs from the diffuse radiance, given their mirrored rays."""
    for n in numba.prange(len(rays)):
        dx, dy, dz = float(rays[n, 3]), float(rays[n, 4]), float(rays[n, 5])
        reflectance, lobe, footprint = optics[n, 0], optics[n, 1], optics[n, 2]
        face = faces[n]
        if face == NOTHING:
            # A region of side 2 s has about the spread of a Gaussian of standard deviation s, once interpolated.
            per_radian = environment.level[0, 2] / (2.0 * math.pi)
            r, g, b = panorama(environment, dx, dy, dz, 2.0 * lobe * per_radian)
        else:
            gx, gy, gz = face_normal(arrays, face)
            facing = gx * dx + gy * dy + gz * dz
            slant = max(abs(facing) / math.sqrt(gx * gx + gy * gy + gz * gz), 0.02)
            wj, wk = float(coordinates[n, 0]), float(coordinates[n, 1])
            region = (footprint + 2.0 * lobe * distance[n]) / math.sqrt(slant)
            r, g, b = diffuse_radiance(
                arrays, textures, light, face, 0 if facing < 0.0 else 1, 1.0 - wj - wk, wj, wk, region
            )
        r, g, b = r + ambient, g + ambient, b + ambient
        for lamp in lamps:
            covered = _covered(lamp, rays[n], distance[n], lobe)
            r += covered * (lamp[3, 0] - r)
            g += covered * (lamp[3, 1] - g)
            b += covered * (lamp[3, 2] - b)
        for channel, reflected in enumerate((r, g, b)):
            ground = diffuse[n, channel]
            change[n, channel] = min(ground + reflectance * (reflected - ground), limit) - ground


@numba.njit(cache=True, error_model="numpy")
def _covered(lamp, ray, reach, lobe):
    """Return the share of a Gaussian lobe around a ray that a lamp (4, 3) covers. The ray ends at ``reach``."""
    ux, uy, uz = lamp[1, 0], lamp[1, 1], lamp[1, 2]
    vx, vy, vz = lamp[2, 0], lamp[2, 1], lamp[2, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    dx, dy, dz = float(ray[3]), float(ray[4]), float(ray[5])
    facing = nx * dx + ny * dy + nz * dz
    if facing >= 0.0:
        return 0.0
    cx, cy, cz = lamp[0, 0] - ray[0], lamp[0, 1] - ray[1], lamp[0, 2] - ray[2]
    distance = (nx * cx + ny * cy + nz * cz) / facing
    if not 0.0 < distance < reach:
        return 0.0
    px, py, pz = distance * dx - cx, distance * dy - cy, distance * dz - cz
    square = nx * nx + ny * ny + nz * nz
    share = 1.0
    # The vector (sx, sy, sz) along which the place in units of one half side grows: across the other half side.
    for sx, sy, sz in (
        (vy * nz - vz * ny, vz * nx - vx * nz, vx * ny - vy * nx),
        (ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux),
    ):
        place = (sx * px + sy * py + sz * pz) / square
        # The lobe's direction moves the place on the lamp's plane by this vector per meter of distance and radian.
        along = (sx * dx + sy * dy + sz * dz) / facing
        mx, my, mz = sx - along * nx, sy - along * ny, sz - along * nz
        width = math.sqrt(2.0 * (mx * mx + my * my + mz * mz)) * lobe * distance / square
        share *= 0.5 * (math.erf((1.0 - place) / width) + math.erf((1.0 + place) / width))
    return share
