"""Intersect rays with triangles by Embree, through Open3D."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from aenerf_ns.open3d_import import load_open3d

NOTHING = np.uint32(0xFFFFFFFF)
"""Stands for the face where a ray hits none."""


class Hits(NamedTuple):
    """The first hit of each ray."""

    face: NDArray[np.uint32]  # (N,) `NOTHING` where the ray hits no face
    distance: NDArray[np.float32]  # (N,) in lengths of the direction, inf where the ray hits no face
    coordinates: NDArray[np.float32]  # (N, 2) barycentric coordinates of the second and third corner


class RayCaster:
    """Cast rays against triangles, whose vertices (V, 3) are rounded to float32.

    Rays are float32 (N, 6): origin and direction. Queries use as many threads as torch. Answers do not depend on that
    number, because one thread builds the tree.

    Raises:
        DataError: Open3D cannot be loaded.
    """

    def __init__(self, vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> None:
        open3d = load_open3d()
        self._tensor = open3d.core.Tensor.from_numpy
        self._scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(
            self._tensor(np.ascontiguousarray(vertices, np.float32)),
            self._tensor(np.ascontiguousarray(faces, np.uint32)),
        )

    def cast(self, rays: NDArray[np.float32]) -> Hits:
        """Find the first hit of each ray."""
        hits = self._scene.cast_rays(self._tensor(rays), nthreads=torch.get_num_threads())
        return Hits(*(hits[name].numpy() for name in ("primitive_ids", "t_hit", "primitive_uvs")))

    def blocked(self, rays: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Tell for each ray (N,) whether a triangle lies between its origin and origin + direction."""
        threads = torch.get_num_threads()
        return self._scene.test_occlusions(self._tensor(rays), tnear=0.0, tfar=1.0, nthreads=threads).numpy()

    def all_hits(self, rays: NDArray[np.float32]) -> tuple[NDArray, NDArray, NDArray]:
        """Find all hits (M,) of all rays: the numbers of the rays and of the faces (int64), and the distances."""
        hits = self._scene.list_intersections(self._tensor(rays), nthreads=torch.get_num_threads())
        ray, face = (hits[name].numpy().astype(np.int64) for name in ("ray_ids", "primitive_ids"))
        return ray, face, hits["t_hit"].numpy()

    def distance(self, points: ArrayLike) -> NDArray[np.float32]:
        """Return the distance (N,) of points (N, 3) from the nearest triangle."""
        query = np.ascontiguousarray(points, np.float32).reshape(-1, 3)
        return self._scene.compute_distance(self._tensor(query), nthreads=torch.get_num_threads()).numpy()
