"""Triangulate polygons that are not convex; a fan from one corner would fill them wrongly."""

from __future__ import annotations

import re

import numpy as np

from aenerf_ns.simulator.arrays import Array


def ear_clipping(corners: Array) -> list[tuple[int, int, int]]:
    """Cut a simple polygon with corners (N, 3) into triangles of indices, in its orientation (Meisters, 1975)."""
    normal = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)  # Newell's
    axis = int(np.argmax(np.abs(normal)))
    flat = corners[:, [(axis + 1) % 3, (axis + 2) % 3]] * [1.0, np.sign(normal[axis]) or 1.0]

    def turn(a: int, b: int, c: int) -> float:
        (ux, uy), (vx, vy) = flat[b] - flat[a], flat[c] - flat[b]
        return float(ux * vy - uy * vx)

    left, triangles = list(range(len(corners))), []
    while len(left) > 3:
        for i, b in enumerate(left):
            a, c = left[i - 1], left[(i + 1) % len(left)]
            # Corners where a hole joins the outline occur twice. A corner must not block its own copy.
            others = [p for p in left if not any((flat[p] == flat[q]).all() for q in (a, b, c))]
            if turn(a, b, c) > 0 and not any(
                turn(a, b, p) >= 0 and turn(b, c, p) >= 0 and turn(c, a, p) >= 0 for p in others
            ):
                break
        else:
            i = 1  # the polygon crosses or touches itself, so no triangulation is right
        triangles.append((left[i - 1], left[i], left[(i + 1) % len(left)]))
        del left[i]
    return [*triangles, (left[0], left[1], left[2])]


def triangulated_obj(text: str) -> str:
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
            triangles = [" ".join(names[k] for k in triangle) for triangle in ear_clipping(corners[i])]
            lines[number] = "\n".join(f"f {triangle}" for triangle in triangles)
    return "\n".join(lines)
