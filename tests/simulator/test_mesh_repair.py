"""Subdivision, coincident and degenerate faces, and concave polygons."""

import dataclasses

import numpy as np
import pytest
import trimesh
from helpers.small_meshes import BLACK, joined, mesh_of, plate

from aenerf_ns.simulator import paths
from aenerf_ns.simulator.rendering.lighting import baked_mesh
from aenerf_ns.simulator.rendering.mesh import normals_and_areas
from aenerf_ns.simulator.rendering.mesh_loading import triangulate
from aenerf_ns.simulator.rendering.mesh_repair import repair, subdivided

pytestmark = pytest.mark.usefixtures("small_work")


def test_subdivision_leaves_no_gaps() -> None:
    body = trimesh.creation.box((2.0, 1.0, 0.3))
    small, source = subdivided(mesh_of(body), 0.17)
    corners = small.vertices[small.faces]
    assert np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1).max() <= 0.17
    assert trimesh.Trimesh(small.vertices, small.faces, process=True).is_watertight
    np.testing.assert_allclose(normals_and_areas(small)[1].sum(), body.area, rtol=1e-5)
    old, new = normals_and_areas(mesh_of(body))[0][source], normals_and_areas(small)[0]
    np.testing.assert_allclose((old * new).sum(1), 1, atol=1e-5)


def test_first_of_coincident_faces_is_seen() -> None:
    red, green = (mesh_of(trimesh.creation.box((1, 1, 0.2)), color) for color in ((0.8, 0, 0), (0, 0.8, 0)))
    smaller = mesh_of(trimesh.creation.box((0.6, 0.6, 0.2)), (0, 0, 0.8))
    for second, count in ((green, 12), (smaller, 4)):
        both, coincident = repair(joined(red, second))
        assert coincident == count
        scene = baked_mesh(both, BLACK)
        rng = np.random.default_rng(0)
        for _ in range(20):
            pose = paths.look_at((*rng.uniform(-2, 2, 2), rng.uniform(1, 3)), (0, 0, 0))
            radiance, depth = scene.render(pose, (80, 80, 20, 15), 40, 30, 1)
            seen = radiance[np.isfinite(depth)]
            np.testing.assert_allclose(seen, np.tile([0.8, 0, 0], (len(seen), 1)), rtol=1e-6)


def test_degenerate_faces_are_dropped() -> None:
    square = plate(1.0)
    faces = np.concatenate([square.faces, [[0, 0, 1], [0, 2, 2]]])
    mesh, _ = repair(dataclasses.replace(square.with_faces_kept([0, 1, 0, 1]), faces=faces), 10.0)
    assert len(mesh.faces) == 2
    with pytest.raises(ValueError, match="no face has an area"):
        repair(dataclasses.replace(square, faces=faces[2:]), 10.0)


@pytest.mark.parametrize(
    "outline",
    [
        # An arrow, from each of its corners.
        *(np.roll([(0, 0), (2, 1), (0, 2), (0.7, 1)], shift, axis=0)[::-1] for shift in range(4)),
        # A hole that a bridge joins to the outline.
        [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)],
        # Corners on the line between others, before and after a notch.
        [(0, 0), (1, 0), (2, 0), (4, 0), (4, 4), (2, 1), (0, 4), (0, 2)],
        # A corner given twice.
        [(0, 0), (4, 0), (4, 0), (4, 4), (2, 1), (0, 4)],
    ],
)
@pytest.mark.parametrize("turned", [False, True])
def test_polygons_are_filled_once(outline: list[tuple[float, float]], turned: bool) -> None:
    noise = 1e-6 * np.random.default_rng(0).normal(size=len(outline))
    corners = (np.array(outline, np.float64) @ [[1, 0, 0.2], [0, 1, -0.4]] + noise[:, None])[:: -1 if turned else 1]
    a, b, c = np.moveaxis(corners[triangulate(corners)], 1, 0)
    cross, newell = np.cross(b - a, c - a), np.cross(corners, np.roll(corners, -1, axis=0)).sum(0)
    assert (cross @ newell >= -1e-5).all()
    np.testing.assert_allclose(cross.sum(0), newell, rtol=1e-9, atol=1e-5)
