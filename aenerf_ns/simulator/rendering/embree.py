"""Intersect rays with triangles by Embree, through Open3D."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aenerf_ns.open3d_import import load_open3d

NOTHING = np.uint32(0xFFFFFFFF)
"""Stands for the triangle where a ray hits none."""


class RayCaster:
    """Cast rays against triangles.

    Rays are float32 (N, 6): origin and direction. Queries use as many threads as numba. Answers do not depend on that
    number, because one thread builds the tree.

    Args:
        vertices: (V, 3), rounded to float32.
        faces: (F, 3).

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

    def cast(self, rays: NDArray[np.float32]) -> dict[str, NDArray]:
        """Return the first hit of each ray.

        Returns:
            ``primitive_ids`` (N,) uint32, `NOTHING` where the ray hits no triangle; ``t_hit`` (N,), the distance in
            lengths of the direction, inf where the ray hits none; ``primitive_uvs`` (N, 2), barycentric coordinates of
            the second and third corner.
        """
        hits = self._scene.cast_rays(self._tensor(rays), nthreads=numba.get_num_threads())
        return {name: hits[name].numpy() for name in ("primitive_ids", "t_hit", "primitive_uvs")}

    def blocked(self, rays: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Tell for each ray (N,) whether a triangle lies between its origin and origin + direction."""
        return self._scene.test_occlusions(
            self._tensor(rays), tnear=0.0, tfar=1.0, nthreads=numba.get_num_threads()
        ).numpy()

    def all_hits(self, rays: NDArray[np.float32]) -> dict[str, NDArray]:
        """Return every intersection (M,) of every ray: ``ray_ids``, ``primitive_ids`` and ``t_hit``."""
        hits = self._scene.list_intersections(self._tensor(rays), nthreads=numba.get_num_threads())
        return {name: hits[name].numpy() for name in ("ray_ids", "primitive_ids", "t_hit")}

    def distance(self, points: ArrayLike) -> NDArray[np.float32]:
        """Return the distance (N,) of points (N, 3) from the nearest triangle."""
        query = np.ascontiguousarray(points, np.float32).reshape(-1, 3)
        return self._scene.compute_distance(self._tensor(query), nthreads=numba.get_num_threads()).numpy()
