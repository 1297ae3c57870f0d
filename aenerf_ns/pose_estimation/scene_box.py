"""A box around what the camera goes around."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from aenerf_ns.pose_estimation.colmap_model import poses_of

# Shorter tracks are often wrong, and a few tell of no box.
_MIN_LENGTH, _MIN_TRACKS = 4, 50
# Share of the features that may lie beyond each side of the box. It then gets a margin, in its longest sides, because
# plain surfaces have no features.
_MAX_BEYOND, _MARGIN = 0.01, 0.1
_MAX_COMPARED = 2000


def box_of(model: Any) -> Tensor | None:
    """Return the (2, 3) corners of a box that holds what the camera goes around, or None if it does not.

    A camera goes around a scene if it stays outside the box, and sees it from directions more than 90 degrees apart.

    Args:
        model: COLMAP's. The box is in its world.
    """
    points = [point for point in model.points3D.values() if point.track.length() >= _MIN_LENGTH]
    poses = poses_of(model)
    if len(points) < _MIN_TRACKS or not poses:
        return None
    # A point counts as often as it was seen.
    seen = np.repeat([point.xyz for point in points], [point.track.length() for point in points], axis=0)
    low, high = np.quantile(seen, [_MAX_BEYOND, 1 - _MAX_BEYOND], axis=0)
    margin = _MARGIN * (high - low).max()
    low, high = low - margin, high + margin
    cameras = np.stack(list(poses.values()))[:, :, 3]
    # Of many cameras, some are looked at: each is compared with each.
    directions = cameras[:: -(-len(cameras) // _MAX_COMPARED)] - (low + high) / 2
    is_inside = ((low < cameras) & (cameras < high)).all(1).any()
    return None if is_inside or (directions @ directions.T).min() > 0 else torch.from_numpy(np.stack([low, high]))
