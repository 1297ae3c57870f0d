"""A box around what the camera goes around, from the tracks of features."""

from __future__ import annotations

from typing import Any

import numpy as np

from aenerf_ns.pose_estimation.bundle_adjustment import Array, Tracks, tracks_of
from aenerf_ns.pose_estimation.colmap_workspace import poses_of

# Shorter tracks are often wrong.
_MIN_LENGTH = 4
# Share of the features that may lie beyond each side of the box. It then gets a margin, in its longest sides, because
# plain surfaces have no features.
_MAX_BEYOND, _MARGIN = 0.01, 0.1


def box_around(tracks: Tracks, poses: Array) -> Array | None:
    """Return the (2, 3) corners of a box that holds what the camera goes around, or None if it does not.

    A camera goes around a scene if it stays outside the box, and sees it from directions more than 90 degrees apart.

    Args:
        tracks: of the images.
        poses: (N, 3, 4) camera-to-world poses of the images, in the world of the tracks.
    """
    # A point counts as often as it was seen.
    points = tracks.points[np.bincount(tracks.points)[tracks.points] >= _MIN_LENGTH]
    if len(points) == 0:
        return None
    seen = tracks.positions[points]
    low, high = np.quantile(seen, [_MAX_BEYOND, 1 - _MAX_BEYOND], axis=0)
    margin = _MARGIN * (high - low).max()
    low, high = low - margin, high + margin
    cameras = poses[:, :, 3]
    directions = cameras - (low + high) / 2
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    is_inside = ((low < cameras) & (cameras < high)).all(1).any()
    return None if is_inside or (directions @ directions.T).min() > 0 else np.stack([low, high])


def box_of(model: Any) -> Array | None:
    """Return :func:`box_around` the points of a COLMAP model."""
    poses = poses_of(model)
    images = sorted(poses)
    return box_around(tracks_of(model, images), np.stack([poses[image] for image in images]))
