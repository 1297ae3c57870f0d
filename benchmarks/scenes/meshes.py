"""Textured triangle meshes: made, read from OBJ files, composed, cleaned and written to GLB files.

Lengths are metres, the z axis points up. Counter-clockwise corners, seen from outside.
"""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from aenerf_ns.camera.image_encoding import decode
from aenerf_ns.errors import DataError
from aenerf_ns.simulator.arrays import Texture
from aenerf_ns.simulator.rendering.embree import RayCaster
from aenerf_ns.simulator.textures import ALBEDO_RANGE

Array = NDArray[np.float64]

_LARGE = 0.02
"""Longest side, in metres, up to which a triangle is looked at in its middle only."""


@dataclass(frozen=True, eq=False)
class Material:
    """A Lambertian surface.

    Attributes:
        name: what tells it from the other materials of a scene.
        picture: (H, W, 3) uint8 sRGB albedo, its first row at the top.
    """

    name: str
    picture: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles of one material: points (F, 3, 3) and texture coordinates (F, 3, 2), v upwards."""

    points: Array
    uv: Array
    material: Material


@dataclass(frozen=True, eq=False)
class Model:
    """Parts that are moved together."""

    parts: tuple[Part, ...] = ()

    def __add__(self, other: Model) -> Model:
        return Model(self.parts + other.parts)

    @property
    def triangles(self) -> Array:
        """Corners (F, 3, 3) of all parts."""
        return np.concatenate([part.points for part in self.parts])

    @property
    def bounds(self) -> Array:
        """(2, 3) corners of the box that holds it."""
        points = self.triangles.reshape(-1, 3)
        return np.array([points.min(axis=0), points.max(axis=0)])

    def moved(self, position: ArrayLike = (0, 0, 0), turn_degrees: float = 0, scale: float = 1) -> Model:
        """Scaled and turned about the origin (counter-clockwise seen from above), then shifted."""
        c, s = np.cos(np.radians(turn_degrees)), np.sin(np.radians(turn_degrees))
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        shift = np.asarray(position, np.float64)
        return Model(tuple(replace(part, points=scale * part.points @ turn.T + shift) for part in self.parts))

    def standing(self) -> Model:
        """Shifted so that its lowest point is at z = 0 and the middle of its bounds at x = y = 0."""
        low, high = self.bounds
        return self.moved((-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]))

    def fitted(self, half_extent: float, radius: float) -> Model:
        """Shifted and scaled so that its bounds are centred, as large as half extents and radius may at most be.

        Args:
            half_extent: of the longest side of the bounds, in metres.
            radius: of the ball around the origin that holds it, in metres.
        """
        low, high = self.bounds
        centre = (low + high) / 2
        reach = np.linalg.norm(self.triangles.reshape(-1, 3) - centre, axis=1).max()
        scale = min(2 * half_extent / (high - low).max(), radius / reach)
        return self.moved(-scale * centre, scale=scale)

    def with_texture_shifted(self, shift: tuple[float, float]) -> Model:
        """With texture coordinates shifted by (u, v)."""
        return Model(tuple(replace(part, uv=part.uv + np.array(shift)) for part in self.parts))

    def inside_out(self) -> Model:
        """With the other side of its faces in front."""
        return Model(tuple(replace(part, points=part.points[:, ::-1], uv=part.uv[:, ::-1]) for part in self.parts))

    def height_under(self, x: float, y: float, below: float = np.inf) -> float:
        """z of the highest surface at (x, y) that lies below a height.

        Raises:
            ValueError: where there is none.
        """
        a, b, c = np.moveaxis(self.triangles, 1, 0)
        area = _cross_2d(b - a, c - a)
        point = np.array([x, y, 0.0])
        with np.errstate(divide="ignore", invalid="ignore"):
            v, w = _cross_2d(point - a, c - a) / area, _cross_2d(b - a, point - a) / area
            heights = (a + v[:, None] * (b - a) + w[:, None] * (c - a))[:, 2]
            hit = (np.abs(area) > 1e-12) & (np.minimum(v, w) >= 0) & (v + w <= 1)
        hit[hit] = heights[hit] < below
        if not hit.any():
            raise ValueError(f"nothing lies under ({x}, {y}) below {below}")
        return float(heights[hit].max())

    def with_dropped(self, model: Model, x: float, y: float, turn_degrees: float = 0, below: float = np.inf) -> Model:
        """With another model put down at (x, y), on the highest surface below a height."""
        return self + model.standing().moved((x, y, self.height_under(x, y, below)), turn_degrees)


def paint(
    name: str, generator: Callable[..., Texture], *arguments: object, size: int = 256, **options: object
) -> Material:
    """A material of a generated texture (see aenerf_ns.simulator.textures). Its name is the seed of its pattern."""
    texture = generator(size, np.random.default_rng(zlib.crc32(name.encode())), *arguments, **options)
    return Material(name, srgb_picture(texture)[::-1])


def coloured_copy(material: Material, colour: ArrayLike) -> Material:
    """The material with its linear albedo times an RGB factor."""
    factor = np.asarray(colour, np.float64)
    name = f"{material.name} * {factor.round(4).tolist()}"
    return Material(name, srgb_picture(np.clip(decode(material.picture / 255, "srgb") * factor, *ALBEDO_RANGE)))


def srgb_picture(value: ArrayLike) -> NDArray[np.uint8]:
    """sRGB values of linear ones in [0, 1], any shape."""
    value = np.clip(np.asarray(value, np.float64), 0, 1)
    encoded = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
    return np.rint(255 * encoded).astype(np.uint8)


# Shapes


def rectangle(origin: ArrayLike, u: ArrayLike, v: ArrayLike, material: Material, tile: float | None = None) -> Model:
    """A parallelogram seen from the side of u x v. The texture repeats every ``tile`` metres, or fills it once."""
    origin, u, v = (np.asarray(value, np.float64) for value in (origin, u, v))
    repeats = (1.0, 1.0) if tile is None else (np.linalg.norm(u) / tile, np.linalg.norm(v) / tile)
    corner = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])[[[0, 1, 2], [0, 2, 3]]]
    points = origin + corner[..., :1] * u + corner[..., 1:] * v
    return Model((Part(points, corner * np.array(repeats), material),))


def box(low: ArrayLike, high: ArrayLike, material: Material, tile: float = 0.5, without: str = "") -> Model:
    """A box between two corners, without some of its sides, named by letters of "xXyYzZ": low x, high x, ..."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    x, y, z = np.diag(high - low)
    sides = {
        "x": (low + y, -y, z),
        "X": (high - y - z, y, z),
        "y": (low, x, z),
        "Y": (high - z, -x, z),
        "z": (low + y, x, -y),
        "Z": (high - x - y, x, y),
    }
    return join(rectangle(*side, material, tile) for name, side in sides.items() if name not in without)


def revolved(profile: Sequence[tuple[float, float]], material: Material, tile: float = 0.5, sides: int = 48) -> Model:
    """The surface that a line of (radius, z) sweeps about the z axis, upwards outside; flat between its points."""
    line = np.array(profile, np.float64)
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    around = max(1.0, np.rint(2 * np.pi * line[:, 0].max() / tile))
    points = np.stack(
        [
            line[:, :1] * np.cos(angle),
            line[:, :1] * np.sin(angle),
            np.repeat(line[:, 1:], sides + 1, axis=1),
        ],
        axis=2,
    )
    uv = np.stack(np.broadcast_arrays(around * angle / (2 * np.pi), length[:, None] / tile), axis=2)
    parts = []
    for grid in (points, uv):
        a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
        corners = np.stack([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)], axis=2)
        parts.append(corners.reshape(-1, 3, grid.shape[2]))
    return Model((_without_degenerate(Part(parts[0], parts[1], material)),))


def top(low: ArrayLike, high: ArrayLike, material: Material, tile: float | None = None) -> Model:
    """The upper side of a box between two corners."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    return rectangle((*low[:2], high[2]), (high[0] - low[0], 0, 0), (0, high[1] - low[1], 0), material, tile)


def disc(radius: float, z: float, material: Material, tile: float = 0.5, sides: int = 48) -> Model:
    """A disc around the z axis, seen from above."""
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    rim = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(sides + 1, z)])
    points = np.stack([np.broadcast_to((0, 0, z), (sides, 3)), rim[:-1], rim[1:]], axis=1)
    return Model((Part(points, points[..., :2] / tile, material),))


def join(models: Iterable[Model]) -> Model:
    """All parts of several models."""
    return Model(tuple(part for model in models for part in model.parts))


# OBJ files


@dataclass(frozen=True)
class _ObjMaterial:
    colour: tuple[float, float, float] = (0.6, 0.6, 0.6)
    opacity: float = 1.0
    picture: Path | None = None


def read_obj(
    path: Path,
    surface: Callable[[str, tuple[float, float, float], Path | None], Material | None],
    size: ArrayLike | None = None,
    minimum_opacity: float = 0.8,
    tile: float = 0.35,
) -> Model:
    """The polygons of an OBJ file, y up, as triangles, z up.

    Normals are not read. Faces without texture coordinates, or whose material has no picture in the file, get those of
    the nearest axis-aligned plane.

    Args:
        path: OBJ file; its material libraries lie beside it.
        surface: from the name, sRGB colour and picture file (or None) of a material to what is to be used for it;
            None leaves its faces out.
        size: extent (3,) along x, y and z that the file's content should have, in metres; it keeps its proportions, so
            the median of the three ratios counts. None: the file's unit is the metre.
        minimum_opacity: faces of more transparent materials are left out: rays stop at every surface.
        tile: side of one tile of the texture of those faces, in metres.

    Raises:
        DataError: on a file that cannot be read or has no faces.
    """
    vertices: list[list[float]] = []
    texture: list[list[float]] = []
    materials: dict[str, _ObjMaterial] = {}
    polygons: dict[str, list[tuple[list[int], list[int] | None]]] = {}
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
                at = [_index(corner[1], len(texture)) for corner in corners] if has_uv else None
                polygons.setdefault(current, []).append((where, at))
            elif key == "usemtl":
                current = value.strip()
            elif key == "mtllib":
                materials.update(_read_mtl(path.parent / value.strip()))
    except (OSError, ValueError, IndexError) as error:
        raise DataError(path, f"not a readable OBJ file ({error})", "remove the asset cache and build again") from error
    if not polygons:
        raise DataError(path, "no faces", "remove the asset cache and build again")

    points = np.array(vertices)[:, [0, 2, 1]] * (1, -1, 1)
    if size is not None:
        used = points[np.concatenate([where for faces in polygons.values() for where, _ in faces])]
        points *= np.median(np.asarray(size) / np.maximum(np.ptp(used, axis=0), 1e-9))
    coordinates = np.array(texture).reshape(-1, 2)
    parts = []
    for name, faces in polygons.items():
        entry = materials.get(name, _ObjMaterial())
        material = surface(name, entry.colour, entry.picture) if entry.opacity >= minimum_opacity else None
        if material is None:
            continue
        triangles, corner_uv = [], []
        for where, at in faces:
            corners = points[where]
            for triangle in triangulate(corners):
                triangles.append(corners[triangle])
                corner_uv.append(coordinates[np.array(at)[triangle]] if at else np.full((3, 2), np.nan))
        if triangles:
            part = _without_degenerate(Part(np.array(triangles), np.array(corner_uv), material))
            bare = np.isnan(part.uv).any(axis=(1, 2)) | (entry.picture is None)
            parts.append(
                replace(part, uv=np.where(bare[:, None, None], _plane_coordinates(part.points) / tile, part.uv))
            )
    return Model(tuple(parts))


def triangulate(polygon: ArrayLike) -> NDArray[np.int64]:
    """Triangles (N - 2, 3), corner numbers, of a simple polygon (N, 3), concave or not, by ear clipping.

    They keep the polygon's sense. A polygon without area has none.
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
    # Seen along the dropped axis the corners run counter-clockwise.
    if (normal[drop] < 0) != (drop == 1):
        flat = flat * (1, -1)
    left = list(range(len(flat)))
    triangles = []
    while len(left) > 3:
        corners = flat[left]
        before, after = np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0)
        turn = _cross_2d(corners - before, after - corners)
        best, best_quality = -1, -np.inf
        for k in np.flatnonzero(turn > 1e-9 * area):
            a, b, c = before[k], corners[k], after[k]
            others = np.delete(corners, [k - 1, k, (k + 1) % len(left)], axis=0)
            inside = (
                (_cross_2d(b - a, others - a) >= 0)
                & (_cross_2d(c - b, others - b) >= 0)
                & (_cross_2d(a - c, others - c) >= 0)
                # A polygon with a hole passes some points twice.
                & ~(others[:, None] == np.array([a, b, c])).all(axis=2).any(axis=1)
            )
            if not inside.any():
                # The ear with the widest smallest angle, nearly, keeps slivers away.
                sides = [np.linalg.norm(e) for e in (b - a, c - b, a - c)]
                quality = turn[k] / (max(sides) ** 2)
                if quality > best_quality:
                    best, best_quality = int(k), quality
                if quality > 0.5:
                    break
        if best < 0:
            # Only corners on a line or a polygon that crosses itself remain: cut the one that turns least.
            best = int(np.abs(turn).argmin())
        triangles.append([left[best - 1], left[best], left[(best + 1) % len(left)]])
        del left[best]
    return np.array([*triangles, left])


def _index(text: str, count: int) -> int:
    """Zero-based index of an OBJ reference, which counts from 1, or back from the end if negative."""
    number = int(text)
    return number - 1 if number > 0 else count + number


def _read_mtl(path: Path) -> dict[str, _ObjMaterial]:
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
            materials[name] = replace(materials[name], colour=(red, green, blue))
        elif key == "d":
            materials[name] = replace(materials[name], opacity=float(value.split()[-1]))
        elif key == "map_Kd" and (path.parent / value).is_file():
            materials[name] = replace(materials[name], picture=path.parent / value)
    return materials


def _cross_2d(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _areas(points: Array) -> Array:
    return 0.5 * np.linalg.norm(np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=1)


def _face_normals(points: Array) -> Array:
    normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _select(part: Part, keep: NDArray[np.bool_]) -> Part:
    return replace(part, points=part.points[keep], uv=part.uv[keep])


def _without_degenerate(part: Part) -> Part:
    """Without the triangles whose height is less than a millionth of their longest side."""
    longest = np.linalg.norm(part.points - np.roll(part.points, 1, axis=1), axis=2).max(axis=1)
    return _select(part, _areas(part.points) > 5e-7 * longest**2)


def _plane_coordinates(points: Array) -> Array:
    """The two coordinates (F, 3, 2) of points (F, 3, 3) in the axis-aligned plane that faces them most, z upwards."""
    axis = np.abs(_face_normals(points)).argmax(axis=1)
    pairs = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    return np.take_along_axis(points, pairs[:, None].repeat(3, axis=1), axis=2)


# Cleaning


def without_coincident_faces(model: Model, gap: float) -> Model:
    """Without faces that lie in one another: the two would flicker in turn as the camera moves.

    Of triangles with the same corners, either way round, the first stays. Where different triangles that face the
    same way overlap within a third of the gap, the smaller piece of surface moves outwards by the gap.

    Args:
        model: meshes that may touch.
        gap: in metres.
    """
    seen = np.concatenate([np.full(len(part.points), k) for k, part in enumerate(model.parts)])
    _, first = np.unique(_corner_keys(model.triangles, 1e-6), axis=0, return_index=True)
    keep = np.zeros(len(seen), bool)
    keep[first] = True
    model = Model(tuple(_select(part, keep[seen == k]) for k, part in enumerate(model.parts)))
    # Pieces may lie in layers: what moves out of one may land in the next.
    changed = np.ones(len(first), bool)
    for layer in range(1, 5):
        moving = changed = _overlapped(model.triangles, changed, gap / 3)
        if not moving.any():
            break
        shift = _outward_shift(model.triangles, moving) * (gap * layer)
        start = np.concatenate([[0], np.cumsum([len(part.points) for part in model.parts])])
        model = Model(
            tuple(
                replace(part, points=part.points + shift[start[k] : start[k + 1]]) for k, part in enumerate(model.parts)
            )
        )
    return model


def _corner_keys(triangles: Array, tolerance: float) -> NDArray[np.int64]:
    """(F, 9): equal for triangles with the same corners in any order."""
    _, corner = np.unique(np.rint(triangles.reshape(-1, 3) / tolerance).astype(np.int64), axis=0, return_inverse=True)
    return np.sort(corner.reshape(-1, 3), axis=1)


def _pieces(triangles: Array) -> NDArray[np.int64]:
    """Number (F,) of the connected flat piece that each triangle belongs to: they share an edge and a plane."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    _, corner = np.unique(triangles.reshape(-1, 3).round(6), axis=0, return_inverse=True)
    corner = corner.reshape(-1, 3)
    normals = _face_normals(triangles)
    edges = np.sort(np.stack([corner, np.roll(corner, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    order = np.lexsort(edges.T)
    same = (edges[order][1:] == edges[order][:-1]).all(axis=1)
    a, b = order[:-1][same] // 3, order[1:][same] // 3
    flat = (normals[a] * normals[b]).sum(axis=1) > 0.999
    graph = coo_matrix((np.ones(flat.sum()), (a[flat], b[flat])), shape=(len(triangles),) * 2)
    return connected_components(graph, directed=False)[1]


def _overlapped(triangles: Array, asked: NDArray[np.bool_], tolerance: float) -> NDArray[np.bool_]:
    """Which triangles (F,) lie in others that face the same way, and belong to the smaller piece of the two.

    Only pairs with one of the ``asked`` triangles (F,) are looked at.
    """
    caster = RayCaster(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    normals = _face_normals(triangles)
    longest = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    piece = _pieces(triangles)
    piece_area = np.bincount(piece, _areas(triangles))
    moving = np.zeros(len(triangles), bool)
    # The middles of all, and points near the corners of those large enough to be overlapped in part.
    for weight in ((1 / 3, 1 / 3, 1 / 3), (0.8, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.1, 0.8)):
        source = np.flatnonzero(asked & ((longest > _LARGE) | (weight[0] == weight[1] == weight[2])))
        if len(source) == 0:
            # Open3D's list of intersections of no rays ends the process.
            continue
        origin = np.einsum("k,fkd->fd", weight, triangles[source]) + tolerance * normals[source]
        rays = np.concatenate([origin, -normals[source]], axis=1).astype(np.float32)
        hits = caster.all_hits(rays)
        one, other = source[hits["ray_ids"].astype(np.int64)], hits["primitive_ids"].astype(np.int64)
        near = (hits["t_hit"] < 2 * tolerance) & (piece[one] != piece[other])
        near &= (normals[one] * normals[other]).sum(axis=1) > 0.99
        one, other = one[near], other[near]
        size = piece_area[piece[one]] - piece_area[piece[other]]
        smaller = (size < 0) | ((size == 0) & (piece[one] > piece[other]))
        moving[np.where(smaller, one, other)] = True
    # The whole of a flat piece moves: it must not tear.
    return np.isin(piece, piece[moving])


def _outward_shift(triangles: Array, moving: NDArray[np.bool_]) -> Array:
    """Unit shifts (F, 3, 3) along the normals of the moving triangles, for all corners at the same points."""
    _, corner = np.unique(triangles.reshape(-1, 3).round(6), axis=0, return_inverse=True)
    corner = corner.ravel()
    weighted = _face_normals(triangles) * (_areas(triangles) * moving)[:, None]
    total = np.zeros((corner.max() + 1, 3))
    np.add.at(total, corner, weighted.repeat(3, axis=0))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return (total / np.maximum(length, 1e-30))[corner].reshape(-1, 3, 3)


# GLB files


def write_glb(path: Path, model: Model) -> None:
    """Write a binary glTF 2.0 file, y up: one mesh with a primitive for each material, its pictures inside as PNG.

    The same model gives the same bytes.

    Raises:
        ValueError: if two different materials share a name.
    """
    by_name: dict[str, list[Part]] = {}
    for part in model.parts:
        parts = by_name.setdefault(part.material.name, [])
        if parts and not np.array_equal(parts[0].material.picture, part.material.picture):
            raise ValueError(f'two materials are called "{part.material.name}"')
        parts.append(part)
    blob = bytearray()
    views: list[dict[str, int]] = []
    accessors: list[dict[str, object]] = []
    primitives, pictures = [], []

    def view(data: bytes) -> int:
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(data)})
        blob.extend(data + b"\0" * (-len(data) % 4))
        return len(views) - 1

    def accessor(values: NDArray[np.generic], kind: str, component: int) -> int:
        entry: dict[str, object] = {
            "bufferView": view(values.tobytes()),
            "componentType": component,
            "count": len(values),
            "type": kind,
        }
        if kind == "VEC3":
            entry |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        accessors.append(entry)
        return len(accessors) - 1

    for index, parts in enumerate(by_name.values()):
        corners = np.concatenate([np.concatenate([part.points, part.uv], axis=2).reshape(-1, 5) for part in parts])
        corners = corners[:, [0, 2, 1, 3, 4]] * (1, 1, -1, 1, -1) + (0, 0, 0, 0, 1)
        unique, faces = np.unique(corners.astype("<f4"), axis=0, return_inverse=True)
        attributes = {
            "POSITION": accessor(np.ascontiguousarray(unique[:, :3]), "VEC3", 5126),
            "TEXCOORD_0": accessor(np.ascontiguousarray(unique[:, 3:]), "VEC2", 5126),
        }
        indices = accessor(faces.ravel().astype("<u4"), "SCALAR", 5125)
        primitives.append({"attributes": attributes, "indices": indices, "material": index})
        file = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(parts[0].material.picture)).save(file, "PNG")
        pictures.append({"bufferView": view(file.getvalue()), "mimeType": "image/png"})
    header = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": primitives}],
        "materials": [
            {
                "name": name,
                "doubleSided": True,
                "pbrMetallicRoughness": {"baseColorTexture": {"index": k}, "metallicFactor": 0, "roughnessFactor": 1},
            }
            for k, name in enumerate(by_name)
        ],
        "textures": [{"source": k, "sampler": 0} for k in range(len(pictures))],
        "samplers": [{"wrapS": 10497, "wrapT": 10497}],
        "images": pictures,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob)}],
    }
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with path.open("wb") as output:
        output.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(blob)))
        output.write(struct.pack("<I4s", len(text), b"JSON") + text)
        output.write(struct.pack("<I4s", len(blob), b"BIN\0") + bytes(blob))
