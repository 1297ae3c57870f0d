"""Reprojection errors of feature tracks, and what they say of the poses when the points are eliminated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.cluster.vq import kmeans2
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

# Pixels: the scale of Cauchy's robust loss. Tracks of images of events are often wrong.
_LOSS_SCALE = 1.0
# Neighboring points make one error: their features lie on one contour, or on one pattern.
_NUM_GROUPS = 64


@dataclass(frozen=True)
class Tracks:
    """Features of scene points in images.

    Attributes:
        images: (M,) index of the image of each feature.
        points: (M,) index of its scene point.
        rays: (M, 2) the feature, as a point in the plane at depth 1.
        positions: (P, 3) the scene points in the world.
        focal_length: in pixels.
    """

    images: NDArray[np.int64]
    points: NDArray[np.int64]
    rays: Array
    positions: Array
    focal_length: float


def tracks_of(model: Any, images: Sequence[int]) -> Tracks:
    """Return the tracks of a COLMAP model.

    Args:
        model: it may have any images of the workspace.
        images: the indices of its images in the workspace, in the order in which the tracks count them.
    """
    (camera,) = model.cameras.values()
    order = {image: number for number, image in enumerate(images)}
    numbers = {image.image_id: order[int(Path(image.name).stem)] for image in model.images.values()}
    points = list(model.points3D.values())
    seen = [(point, element) for point, three in enumerate(points) for element in three.track.elements]
    pixels = [model.images[element.image_id].points2D[element.point2D_idx].xy for _, element in seen]
    return Tracks(
        images=np.array([numbers[element.image_id] for _, element in seen], np.int64),
        points=np.array([point for point, _ in seen], np.int64),
        rays=camera.cam_from_img(np.array(pixels).reshape(-1, 2)),
        positions=np.array([point.xyz for point in points]).reshape(-1, 3),
        focal_length=camera.mean_focal_length(),
    )


def move_poses(poses: Array, twists: Array) -> Array:
    """Compose poses (N, 3, 4), camera-to-world, with small twists (N, 6) in the cameras' frames.

    A twist is a translation in the units of the poses, then a rotation vector in radians.
    """
    rotations = poses[:, :, :3]
    turned = rotations @ Rotation.from_rotvec(twists[:, 3:]).as_matrix()
    return np.concatenate([turned, poses[:, :, 3:] + rotations @ twists[:, :3, None]], -1)


class TrackAdjustment:
    """Keep the points of tracks at their best positions while the poses move.

    Args:
        tracks: of N images.
        seed: of the grouping of points.
    """

    def __init__(self, tracks: Tracks, seed: int) -> None:
        self._tracks = tracks
        self.positions = tracks.positions
        # Far points would each be a group of their own.
        offsets = tracks.positions - np.median(tracks.positions, 0)
        distances = np.linalg.norm(offsets, axis=1, keepdims=True)
        offsets *= np.minimum(1, 3 * np.median(distances) / np.maximum(distances, 1e-12))
        num_groups = min(_NUM_GROUPS, len(offsets))
        self._groups = kmeans2(offsets, num_groups, minit="++", seed=seed)[1]

    def adjust_points(self, poses: Array, iterations: int) -> None:
        """Move the points alone."""
        for _ in range(iterations):
            self._eliminate_points(poses)
            self._move_points(self._pull)

    def linearize(self, poses: Array) -> tuple[Array, Array]:
        """Return the robust sum of squared reprojection errors (square pixels) around poses (N, 3, 4), camera-to-world,
        as a quadratic function of small twists of them. The points take their best positions for each of these.

        Returns:
            The (6 N, 6 N) Hessian by Gauss and Newton's method, and the (G, 6 N) parts of the gradient by groups of
            neighboring points.
        """
        images, points, count = self._tracks.images, self._tracks.points, len(poses)
        local, errors, weights, projection, of_point = self._eliminate_points(poses)
        # A camera that turns by w moves a point y in its frame by the cross product of y and w.
        of_pose = np.concatenate([-projection, np.cross(projection, local[:, None])], -1)
        weighted = (weights * of_pose).transpose(0, 2, 1)
        mixed = weighted @ of_point @ self._inverse_root[points].transpose(0, 2, 1)
        rows = 6 * images[:, None, None] + np.arange(6)[:, None]
        columns = 3 * points[:, None, None] + np.arange(3)
        indices = [np.broadcast_to(index, mixed.shape).ravel() for index in (rows, columns)]
        shape = (6 * count, 3 * len(self.positions))
        self._mixed = sparse.csr_matrix((mixed.ravel(), tuple(indices)), shape)
        hessian = -(self._mixed @ self._mixed.T).toarray()
        blocks = hessian.reshape(count, 6, count, 6)
        blocks[range(count), :, range(count)] += _sum_by(images, weighted @ of_pose, count)
        parts = (weighted @ errors - mixed @ self._pull[points])[..., 0]
        group_gradients = _sum_by(self._groups[points] * count + images, parts, (self._groups.max() + 1) * count)
        return hessian, group_gradients.reshape(-1, 6 * count)

    def move_points(self, twists: Array) -> None:
        """Move the points to where they belong after twists (6 N,) of the poses that were linearized last."""
        self._move_points(self._pull + (self._mixed.T @ twists).reshape(-1, 3, 1))

    def _eliminate_points(self, poses: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Linearize the points alone: the inverse root of each point's Hessian, and its pull at the point.

        Returns:
            (M, 3) points in the frames of their cameras, (M, 2, 1) errors in pixels, (M, 1, 1) robust weights, and the
            (M, 2, 3) derivatives of the errors by the points in the cameras' frames and in the world.
        """
        tracks, count = self._tracks, len(self.positions)
        rotations = poses[tracks.images, :, :3]
        local = np.einsum("mji,mj->mi", rotations, self.positions[tracks.points] - poses[tracks.images, :, 3])
        depths = np.maximum(local[:, 2], 1e-9)
        errors = tracks.focal_length * (local[:, :2] / depths[:, None] - tracks.rays)
        weights = 1 / (1 + np.square(errors / _LOSS_SCALE).sum(1))
        # A point behind the camera says nothing.
        weights[local[:, 2] <= 0] = 0
        projection = np.zeros((len(local), 2, 3))
        projection[:, 0, 0] = projection[:, 1, 1] = tracks.focal_length / depths
        projection[:, :, 2] = -tracks.focal_length * local[:, :2] / np.square(depths)[:, None]
        of_point = projection @ rotations.transpose(0, 2, 1)
        weighted = (weights[:, None, None] * of_point).transpose(0, 2, 1)
        hessians = _sum_by(tracks.points, weighted @ of_point, count)
        # Keeps points of vanishing parallax in place.
        hessians += np.eye(3) * (1e-6 * np.trace(hessians, axis1=1, axis2=2)[:, None, None] + 1e-12)
        self._inverse_root = np.linalg.inv(np.linalg.cholesky(hessians))
        self._pull = self._inverse_root @ _sum_by(tracks.points, weighted @ errors[..., None], count)
        return local, errors[..., None], weights[:, None, None], projection, of_point

    def _move_points(self, pulls: Array) -> None:
        self.positions = self.positions - (self._inverse_root.transpose(0, 2, 1) @ pulls)[..., 0]


def _sum_by(index: NDArray[np.int64], values: Array, size: int) -> Array:
    """Add up the values (M, ...) of each index (M,), as an array (size, ...)."""
    flat = values.reshape(len(values), -1)
    sums: Array = np.stack([np.bincount(index, column, size) for column in flat.T], 1)
    return sums.reshape(size, *values.shape[1:])
