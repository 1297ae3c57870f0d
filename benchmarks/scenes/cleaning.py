"""Removal of faces that lie in one another: they would flicker as the camera moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from trimesh.graph import connected_component_labels

from aenerf_ns.simulator.rendering.embree import RayCaster
from benchmarks.scenes.meshes import Array, Model, areas, longest_sides, unit_normals

_LARGE = 0.02
"""Length in meters. Triangles with a longer side are also checked near their corners, others only in the middle."""


def without_coincident_faces(model: Model, gap: float) -> Model:
    """Drop duplicate faces and move overlapping ones apart.

    Of triangles with the same corners, in any order, the first stays. Where different triangles that face the same
    way overlap within a third of the gap, in meters, the smaller of the two flat pieces moves outwards by the gap.
    """
    owner = np.repeat(np.arange(len(model.parts)), [len(part.points) for part in model.parts])
    _, first = np.unique(np.sort(_corner_numbers(model.triangles), axis=1), axis=0, return_index=True)
    keep = np.zeros(len(owner), bool)
    keep[first] = True
    model = Model(tuple(part.select(keep[owner == k]) for k, part in enumerate(model.parts)))
    owner = owner[keep]
    # A piece that moves out of one layer may land in the next.
    changed = np.ones(len(owner), bool)
    for layer in range(1, 5):
        changed = _overlapped(model.triangles, changed, gap / 3)
        if not changed.any():
            break
        shift = _outward_shift(model.triangles, changed) * (gap * layer)
        parts = enumerate(model.parts)
        model = Model(tuple(replace(part, points=part.points + shift[owner == k]) for k, part in parts))
    return model


def _corner_numbers(triangles: Array) -> NDArray[np.int64]:
    """Number the corners (F, 3) of triangles (F, 3, 3): the same number for points equal to a micrometer."""
    return np.unique(triangles.reshape(-1, 3).round(6), axis=0, return_inverse=True)[1].reshape(-1, 3)


def _pieces(triangles: Array, normals: Array) -> NDArray[np.int64]:
    """Number (F,) the flat pieces: connected triangles (F, 3, 3) that share an edge and a plane."""
    corner = _corner_numbers(triangles)
    edges = np.sort(np.stack([corner, np.roll(corner, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    order = np.lexsort(edges.T)
    same = (edges[order][1:] == edges[order][:-1]).all(axis=1)
    a, b = order[:-1][same] // 3, order[1:][same] // 3
    flat = (normals[a] * normals[b]).sum(axis=1) > 0.999
    return connected_component_labels(np.stack([a[flat], b[flat]], axis=1), len(triangles))


def _overlapped(triangles: Array, asked: NDArray[np.bool_], tolerance: float) -> NDArray[np.bool_]:
    """Mark the triangles (F,) that lie in others facing the same way and belong to the smaller piece of the two.

    Only pairs that include one of the ``asked`` triangles (F,) are compared.
    """
    caster = RayCaster(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    normals = unit_normals(triangles)
    large = longest_sides(triangles) > _LARGE
    piece = _pieces(triangles, normals)
    piece_area = np.bincount(piece, areas(triangles))
    moving = np.zeros(len(triangles), bool)
    # Large triangles can be overlapped in part: look near their corners too.
    for weight in ((1 / 3, 1 / 3, 1 / 3), (0.8, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.1, 0.8)):
        source = np.flatnonzero(asked & (large | (weight[0] == weight[1] == weight[2])))
        if len(source) == 0:
            # Open3D's list_intersections ends the process when it is given no rays.
            continue
        origin = np.einsum("k,fkd->fd", weight, triangles[source]) + tolerance * normals[source]
        rays = np.concatenate([origin, -normals[source]], axis=1).astype(np.float32)
        ray, other, distance = caster.all_hits(rays)
        face = source[ray]
        near = (distance < 2 * tolerance) & (piece[face] != piece[other])
        near &= (normals[face] * normals[other]).sum(axis=1) > 0.99
        face, other = face[near], other[near]
        size = piece_area[piece[face]] - piece_area[piece[other]]
        smaller = (size < 0) | ((size == 0) & (piece[face] > piece[other]))
        moving[np.where(smaller, face, other)] = True
    # A flat piece moves as a whole, because it must not tear.
    return np.isin(piece, piece[moving])


def _outward_shift(triangles: Array, moving: NDArray[np.bool_]) -> Array:
    """Return unit shifts (F, 3, 3) along the normals of the moving triangles, equal for corners at the same point."""
    corner = _corner_numbers(triangles).ravel()
    weighted = unit_normals(triangles) * (areas(triangles) * moving)[:, None]
    total = np.zeros((corner.max() + 1, 3))
    np.add.at(total, corner, weighted.repeat(3, axis=0))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return (total / np.maximum(length, 1e-30))[corner].reshape(-1, 3, 3)
