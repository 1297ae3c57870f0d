"""Triangulate polygons that are not convex; a fan from one corner would fill them wrongly."""

from __future__ import annotations

import re

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.simulator.arrays import Array


def clip_ears(corners: Array) -> NDArray[np.int64]:
    """Cut a simple polygon with corners (N, 3) into triangles that keep its orientation.

    Returns:
        Corner numbers (T, 3). T is at most N - 2: earcut may leave out corners that repeat a neighbor or lie on a line
        with both, and parts of polygons that cross themselves.
    """
    normal = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)  # Newell's
    axis = int(np.argmax(np.abs(normal)))
    flat = corners[:, [(axis + 1) % 3, (axis + 2) % 3]] * [1.0, np.sign(normal[axis]) or 1.0]
    triangles = mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], np.uint32))
    return triangles.reshape(-1, 3).astype(np.int64)


def triangulate_obj(text: str) -> str:
    """Return the text of an .obj file with its concave polygons cut into triangles."""
    if not re.search(r"^f(?:[ \t]+\S+){4}", text, re.MULTILINE):
        return text
    lines = text.replace("\\\n", " ").split("\n")
    vertices: list[str] = []
    polygons: dict[int, list[tuple[int, list[int]]]] = {}
    for number, line in enumerate(lines):
        if line.startswith(("v ", "v\t")):
            vertices.append(line)
        elif line.startswith(("f ", "f\t")) and len(names := line.split()[1:]) > 3:
            index = [int(name.partition("/")[0]) for name in names]
            corners = [i - 1 if i > 0 else len(vertices) + i for i in index]
            polygons.setdefault(len(corners), []).append((number, corners))
    positions = np.array([line.split()[1:4] for line in vertices], np.float64)
    for rows in polygons.values():
        corners = positions[np.array([row for _, row in rows])]
        edges = np.roll(corners, -1, axis=1) - corners
        turns = np.cross(edges, np.roll(edges, -1, axis=1))
        normals = np.cross(corners, np.roll(corners, -1, axis=1)).sum(axis=1, keepdims=True)
        concave = ((turns * normals).sum(axis=-1) < 0).any(axis=1)
        for i in np.flatnonzero(concave):
            number = rows[i][0]
            names = lines[number].split()[1:]
            triangles = [" ".join(names[k] for k in triangle) for triangle in clip_ears(corners[i])]
            lines[number] = "\n".join(f"f {triangle}" for triangle in triangles)
    return "\n".join(lines)
