"""Reading OBJ files, with what the furniture needs of the format.

trimesh would read them faster, but fills concave polygons wrongly, orders triangles and their corners otherwise (the
scenes would not stay the same), and passes over malformed materials in silence. mapbox-earcut would triangulate them
faster, but into other triangles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aenerf_ns.errors import DataError
from benchmarks.scenes.meshes import Array, Material, Model, Part, cross_2d, not_degenerate, unit_normals

# Faces of more transparent materials are left out, because rays stop at every surface.
_MIN_OPACITY = 0.8
_TILE = 0.35
"""Side of a texture tile in meters, where the file gives no texture coordinates."""


@dataclass(frozen=True)
class _ObjMaterial:
    color: tuple[float, float, float] = (0.6, 0.6, 0.6)
    opacity: float = 1.0
    picture: Path | None = None


def read_obj(
    path: Path, surface: Callable[[str, tuple[float, float, float], Path | None], Material], size: ArrayLike
) -> Model:
    """Read the polygons of an OBJ file, y up, as triangles, z up.

    Normals are not read. A face takes its texture coordinates from the nearest axis-aligned plane if the file gives
    it none, or if its material has no picture in the file.

    Args:
        path: OBJ file. Its material libraries lie beside it.
        surface: maps the name, sRGB color and picture file (or None) of a material to the material to use.
        size: extent (3,) of the content along x, y and z, in meters. Proportions are kept: the scale is the median
            of the three ratios.

    Raises:
        DataError: if the file cannot be read or has no faces.
    """
    vertices: list[list[float]] = []
    texture: list[list[float]] = []
    materials: dict[str, _ObjMaterial] = {}
    polygons: dict[str, list[NDArray[np.int64]]] = {}
    current = ""
    try:
        for line in path.read_text(errors="replace").splitlines():
            key, _, value = line.strip().partition(" ")
            if key == "v":
                vertices.append([float(number) for number in value.split()[:3]])
            elif key == "vt":
                texture.append([float(number) for number in value.split()[:2]])
            elif key == "f":
                corners = [corner.split("/") for corner in value.split()]
                where = [_index(corner[0], len(vertices)) for corner in corners]
                has_uv = all(len(corner) > 1 and corner[1] for corner in corners)
                at = [_index(corner[1], len(texture)) for corner in corners] if has_uv else [-1] * len(corners)
                polygons.setdefault(current, []).append(np.array([where, at]))
            elif key == "usemtl":
                current = value.strip()
            elif key == "mtllib":
                materials.update(_read_mtl(path.parent / value.strip()))
    except (OSError, ValueError, IndexError) as error:
        raise DataError(path, f"not a readable OBJ file ({error})", "remove the asset cache and build again") from error
    if not polygons:
        raise DataError(path, "no faces", "remove the asset cache and build again")

    points = np.array(vertices)[:, [0, 2, 1]] * (1, -1, 1)
    used = points[np.concatenate([where for faces in polygons.values() for where, _ in faces])]
    points *= np.median(np.asarray(size) / np.maximum(np.ptp(used, axis=0), 1e-9))
    # Index -1, of a corner without texture coordinates, is the last row.
    coordinates = np.array([*texture, [0.0, 0.0]])
    parts = []
    for name, faces in polygons.items():
        entry = materials.get(name, _ObjMaterial())
        if entry.opacity < _MIN_OPACITY:
            continue
        corners = np.concatenate([face[:, triangulate(points[face[0]])] for face in faces], axis=1)
        where, at = corners[:, not_degenerate(points[corners[0]])]
        bare = (at < 0)[..., None] | (entry.picture is None)
        uv = np.where(bare, _plane_coordinates(points[where]) / _TILE, coordinates[at])
        if len(where):
            parts.append(Part(points[where], uv, surface(name, entry.color, entry.picture)))
    return Model(tuple(parts))


def triangulate(polygon: ArrayLike) -> NDArray[np.int64]:
    """Cut a simple polygon (N, 3), concave or not, into triangles by ear clipping (Meisters, 1975).

    Returns:
        Corner numbers (N - 2, 3) of triangles that keep the polygon's sense; (0, 3) if the polygon has no area.
    """
    polygon = np.asarray(polygon, np.float64)
    if len(polygon) == 3:
        return np.array([[0, 1, 2]])
    spokes = polygon[1:] - polygon[0]
    fan = 0.5 * np.cross(spokes[:-1], spokes[1:])
    normal = fan.sum(axis=0)
    area = np.linalg.norm(normal)
    if not area > 0:
        return np.empty((0, 3), np.int64)
    if (fan @ normal > 0).all():
        last = np.arange(2, len(polygon))
        return np.column_stack([np.zeros_like(last), last - 1, last])
    drop = np.abs(normal).argmax()
    flat = np.delete(polygon, drop, axis=1)
    # Make the corners run counter-clockwise, seen along the dropped axis.
    if (normal[drop] < 0) != (drop == 1):
        flat = flat * (1, -1)
    left = list(range(len(flat)))
    triangles = []
    while len(left) > 3:
        corners = flat[left]
        before, after = np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0)
        turn = cross_2d(corners - before, after - corners)
        best, best_quality = -1, -np.inf
        for k in np.flatnonzero(turn > 1e-9 * area):
            ear = np.array([before[k], corners[k], after[k]])
            sides = np.roll(ear, -1, axis=0) - ear
            others = np.delete(corners, [k - 1, k, (k + 1) % len(left)], axis=0)
            inside = (cross_2d(sides[:, None], others - ear[:, None]) >= 0).all(axis=0)
            # A polygon with a hole passes some points twice, and they do not block the ear.
            if not (inside & ~(others[:, None] == ear).all(axis=2).any(axis=1)).any():
                # Prefer ears with a wide smallest angle, to avoid slivers.
                quality = turn[k] / (max(np.linalg.norm(side) for side in sides) ** 2)
                if quality > best_quality:
                    best, best_quality = int(k), quality
                if quality > 0.5:
                    break
        if best < 0:
            # The rest is a line or crosses itself: cut the corner that turns least.
            best = int(np.abs(turn).argmin())
        triangles.append([left[best - 1], left[best], left[(best + 1) % len(left)]])
        del left[best]
    return np.array([*triangles, left])


def _index(text: str, count: int) -> int:
    """Return the index from 0 of an OBJ reference, which counts from 1, or back from the end if negative."""
    number = int(text)
    return number - 1 if number > 0 else count + number


def _read_mtl(path: Path) -> dict[str, _ObjMaterial]:
    """Read the colors, opacities and pictures of a material library, by material name."""
    materials: dict[str, _ObjMaterial] = {}
    name = ""
    for line in path.read_text(errors="replace").splitlines():
        key, _, value = line.strip().partition(" ")
        value = value.strip()
        if key == "newmtl":
            name = value
            materials[name] = _ObjMaterial()
        elif key == "Kd":
            red, green, blue = (float(number) for number in value.split()[:3])
            materials[name] = replace(materials[name], color=(red, green, blue))
        elif key == "d":
            materials[name] = replace(materials[name], opacity=float(value.split()[-1]))
        elif key == "map_Kd" and (path.parent / value).is_file():
            materials[name] = replace(materials[name], picture=path.parent / value)
    return materials


def _plane_coordinates(triangles: Array) -> Array:
    """Return coordinates (F, 3, 2) of triangles (F, 3, 3) in the axis-aligned plane nearest to theirs, z upwards."""
    axis = np.abs(unit_normals(triangles)).argmax(axis=1)
    pairs = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    return np.take_along_axis(triangles, pairs[:, None].repeat(3, axis=1), axis=2)
