"""Prepare a mesh for rendering: no degenerate or coincident faces, and faces small enough to carry light."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.simulator.rendering.mesh import Mesh, normals_and_areas, position_ids

_RESOLUTION = 4e-6
"""Distance below which the ray caster's float32 cannot order two surfaces, as a fraction of the largest coordinate."""
_SEPARATION = 8.0
"""How far coincident surfaces are moved apart, in units of that distance."""
NUM_CORNERS = 60_000
"""Approximate number of corners that large faces are subdivided into."""


def repair(mesh: Mesh, spacing: float | None = None) -> tuple[Mesh, int]:
    """Remove degenerate faces, separate coincident faces and subdivide large faces.

    ``spacing`` is the longest edge in meters. By default large faces become about `NUM_CORNERS` corners.

    Returns:
        the mesh, and the number of its faces that coincided with others.

    Raises:
        ValueError: no face has an area.
    """
    mesh, dropped = without_duplicate_faces(without_degenerate_faces(mesh))
    if len(mesh.faces) == 0:
        raise ValueError("no face has an area")
    if spacing is None:
        # Halving leaves edges of about 0.7 of that length; an equilateral mesh has two triangles per corner.
        spacing = math.sqrt(2.3 * float(normals_and_areas(mesh)[1].sum()) / NUM_CORNERS)
    small, source = subdivided(mesh, spacing)
    apart, moved = with_coincident_faces_apart(small, source)
    return apart, dropped + len(np.unique(source[moved]))


def without_degenerate_faces(mesh: Mesh) -> Mesh:
    """Drop the faces whose height is lost in float32."""
    a, b, c = mesh.vertices[mesh.faces.T]
    longest = np.sqrt(np.maximum.reduce([((p - q) ** 2).sum(1) for p, q in ((a, b), (b, c), (c, a))]))
    area = normals_and_areas(mesh)[1]
    keep = 2 * area > np.abs(mesh.vertices).max() * 1e-7 * longest
    return mesh.with_faces_kept(keep)


def without_duplicate_faces(mesh: Mesh) -> tuple[Mesh, int]:
    """Keep the first of the faces that share all corners, in any order. Return also how many were dropped."""
    corners = np.sort(position_ids(mesh.vertices)[mesh.faces], axis=1)
    first = np.sort(np.unique(corners, axis=0, return_index=True)[1])
    return mesh.with_faces_kept(first), len(mesh.faces) - len(first)


def subdivided(mesh: Mesh, spacing: float) -> tuple[Mesh, NDArray[np.int64]]:
    """Halve edges longer than ``spacing``, the longest of a face first (Rivara, 1984).

    An edge is halved in all its faces or in none, so that no gaps open. Return also the index (F,) of the original face
    that each face is part of.
    """
    vertices, uv, color, faces = mesh.vertices, mesh.uv, mesh.color, mesh.faces
    source = np.arange(len(faces))
    while True:
        corners = vertices[faces]
        square = ((np.roll(corners, -1, axis=1) - corners) ** 2).sum(axis=-1)
        longest = square.argmax(axis=1)
        split = np.flatnonzero(square[np.arange(len(faces)), longest] > spacing * spacing)
        if len(split) == 0:
            return replace(mesh.with_faces_kept(source), vertices=vertices, uv=uv, color=color, faces=faces), source
        turn = (longest[split, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(faces[split], turn, axis=1).T
        low, high = np.minimum(a, b), np.maximum(a, b)
        _, representative, middle = np.unique(low * len(vertices) + high, return_index=True, return_inverse=True)
        i, j = low[representative], high[representative]
        middle = len(vertices) + middle.reshape(-1)
        # Rounded to float32, as the ray caster does.
        midpoints = (0.5 * (vertices[i] + vertices[j])).astype(np.float32).astype(np.float64)
        vertices = np.concatenate([vertices, midpoints])
        uv = np.concatenate([uv, 0.5 * (uv[i] + uv[j])])
        color = np.concatenate([color, 0.5 * (color[i] + color[j])])
        faces = faces.copy()
        faces[split] = np.stack([a, middle, c], axis=1)
        faces = np.concatenate([faces, np.stack([middle, b, c], axis=1)])
        source = np.concatenate([source, source[split]])


def with_coincident_faces_apart(mesh: Mesh, order: NDArray[np.int64]) -> tuple[Mesh, NDArray[np.int64]]:
    """Separate coincident faces: move each a hair behind the one that comes first.

    Rounding would otherwise decide which of the two faces a ray hits, differently in each frame. Of two coincident
    faces, the one with the lower rank in ``order`` (F,) stays. Return also the indices of the moved faces.
    """
    resolution = _RESOLUTION * float(np.abs(mesh.vertices).max())
    a, b, c = mesh.vertices[mesh.faces.T]
    normal = normals_and_areas(mesh)[0]
    above = 16 * resolution
    is_moved = np.zeros(len(mesh.faces), bool)
    shift = np.zeros((len(mesh.faces), 3))
    # The middle, and points near the corners.
    for weights in ((1 / 3, 1 / 3, 1 / 3), (0.8, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.1, 0.8)):
        points = weights[0] * a + weights[1] * b + weights[2] * c
        # The rays end just behind the face. Hits beyond that are listed too, and ignored.
        rays = np.concatenate([points + above * normal, -above * normal], axis=1).astype(np.float32)
        for start in range(0, len(rays), 1 << 18):
            face, other, distance = mesh.caster.all_hits(rays[start : start + (1 << 18)])
            face = face + start
            near = (np.abs(distance - 1) * above < resolution) & (face != other)
            near &= np.abs((normal[face] * normal[other]).sum(axis=1)) > 0.999
            near &= order[face] != order[other]
            face, other = face[near], other[near]
            later, first = np.where(order[face] > order[other], (face, other), (other, face))
            is_moved[later] = True
            shift[later] = -normal[first]
    moved = np.flatnonzero(is_moved)
    offset = _SEPARATION * resolution * shift[moved]
    apart = (mesh.vertices[mesh.faces[moved]] + offset[:, None]).reshape(-1, 3).astype(np.float32).astype(np.float64)
    faces = mesh.faces.copy()
    faces[moved] = len(mesh.vertices) + np.arange(3 * len(moved)).reshape(-1, 3)
    copied = mesh.faces[moved].reshape(-1)
    return replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, apart]),
        uv=np.concatenate([mesh.uv, mesh.uv[copied]]),
        color=np.concatenate([mesh.color, mesh.color[copied]]),
        faces=faces,
    ), moved
