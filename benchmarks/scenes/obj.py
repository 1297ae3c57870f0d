"""Reading OBJ files, with what the furniture needs of the format.

trimesh reads their materials, malformed ones in silence: the assets are pinned. It would read the rest faster, but
fills concave polygons wrongly, and orders triangles and their corners otherwise: the scenes would not stay the same.
mapbox-earcut would make other triangles of polygons.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from trimesh.exchange.obj import parse_mtl
from trimesh.resolvers import FilePathResolver

from aenerf_ns.errors import DataError
from benchmarks.scenes.meshes import Array, Material, Model, Part, cross_2d, not_degenerate, unit_normals

# Faces of more transparent materials are left out, because rays stop at every surface.
_MIN_OPACITY = 0.8
_TILE = 0.35
"""Side of a texture tile in meters, where the file gives no texture coordinates."""


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
    materials: dict[str, dict[str, Any]] = {}
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
                library = path.parent / value.strip()
                materials |= parse_mtl(library.read_text(errors="replace"), FilePathResolver(str(library)))
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
        entry = materials.get(name, {})
        if float(entry.get("d", [1])[-1]) < _MIN_OPACITY:
            continue
        picture = path.parent / entry["image"].info["file_path"] if "image" in entry else None
        corners = np.concatenate([face[:, triangulate(points[face[0]])] for face in faces], axis=1)
        where, at = corners[:, not_degenerate(points[corners[0]])]
        bare = (at < 0)[..., None] | (picture is None)
        uv = np.where(bare, _plane_coordinates(points[where]) / _TILE, coordinates[at])
        if len(where):
            parts.append(Part(points[where], uv, surface(name, tuple(entry.get("kd", (0.6, 0.6, 0.6))), picture)))
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


def _plane_coordinates(triangles: Array) -> Array:
    """Return coordinates (F, 3, 2) of triangles (F, 3, 3) in the axis-aligned plane nearest to theirs, z upwards."""
    axis = np.abs(unit_normals(triangles)).argmax(axis=1)
    pairs = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    return np.take_along_axis(triangles, pairs[:, None].repeat(3, axis=1), axis=2)
