"""Read the poses of a COLMAP model, judge whether the model is sound, and turn its world upright."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import torch
from nerfstudio.cameras.camera_utils import auto_orient_and_center_poses
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, Trajectory, homogeneous

MIN_POINTS = 15
"""Points that a frame is placed by, at least."""
# Other frames with which a frame shares MIN_POINTS, at least: a share of the median, but no more than this.
_SHARE, _ENOUGH_PARTNERS = 0.25, 5
# Frames of a part of the path, at least: COLMAP drops shorter pieces.
_SHORTEST_PART = 10
# Degrees that a camera turns from one frame to the next, at most.
_MAX_TURN = 30.0


def placed_images(model: Any, only_linked: bool = True) -> list[Any]:
    """Return the images that have a pose, in the order of the frames. See :func:`poses_of`."""
    images = [image for image in model.images.values() if image.has_pose and image.num_points3D >= MIN_POINTS]
    images.sort(key=_index)
    return _linked(images) if only_linked and len(images) > 1 else images


def _index(image: Any) -> int:
    return int(Path(image.name).stem)


def _linked(images: list[Any]) -> list[Any]:
    """Return the largest group of images that holds together: each shares enough points with another, and not with far
    fewer than most do, and with the image before or after it, and is not turned away from both."""
    links = _count_shared_points(images) >= MIN_POINTS
    partners = np.asarray(links.sum(1)).ravel() - 1
    is_near = links.diagonal(1)
    is_held = np.append(is_near, False) | np.append(False, is_near)
    turns = _turns(images, 1)
    # A camera in fast motion turns far from image to image, but then farther still to the next but one.
    is_held[1:-1] &= np.minimum(turns[:-1], turns[1:]) < np.maximum(_turns(images, 2), _MAX_TURN)
    held = np.flatnonzero(is_held & (partners >= min(_SHARE * np.median(partners), _ENOUGH_PARTNERS)))
    groups = connected_components(links[held][:, held])[1]
    return [images[i] for i in held[groups == np.bincount(groups).argmax()]] if len(held) else []


def _count_shared_points(images: list[Any]) -> csr_array:
    """Return the (N, N) numbers of points that two images both see."""
    sees = _sees(images)
    return sees @ sees.T


def _sees(images: list[Any]) -> csr_array:
    """Return for (N, P) images and points 1 where the image sees the point."""
    points = [[point.point3D_id for point in image.points2D if point.has_point3D()] for image in images]
    rows = np.repeat(np.arange(len(images)), [len(seen) for seen in points])
    columns = np.unique(np.concatenate(points), return_inverse=True)[1]
    return csr_array((np.ones(len(rows)), (rows, columns)))


def _turns(images: list[Any], step: int) -> NDArray[np.float64]:
    """Return the degrees that the camera turns from each image to the one that many images later."""
    rotations = [image.cam_from_world().rotation for image in images]
    return np.rad2deg([first.angle_to(second) for first, second in zip(rotations, rotations[step:], strict=False)])


def poses_of(model: Any, only_linked: bool = True) -> dict[int, NDArray[np.float64]]:
    """Return the (3, 4) camera-to-world poses, with OpenCV camera axes, by the index of the frame.

    Args:
        model: COLMAP's. Frames that see fewer than MIN_POINTS points have no pose.
        only_linked: neither have frames that share as many with too few others, or with neither of the frames before
            and after them, or are turned away from both: they, or their group, may lie anywhere.
    """
    return {_index(image): image.cam_from_world().inverse().matrix() for image in placed_images(model, only_linked)}


def is_placed(model: Any) -> bool:
    """Return whether a model places three frames or more: fewer have no world."""
    return len(placed_images(model)) > 2


def is_sound(model: Any, max_pixels: float) -> bool:
    """Return whether a model's mean error of reprojection is small, and its path has no break.

    A mapper may throw frames far out where it sees nothing, and join parts that look alike the wrong way round. Where
    one part ends and the next begins, frames that follow each other, also across lost ones, share few points, or the
    camera turns at once.
    """
    images = placed_images(model)
    if len(images) < 2 or model.compute_mean_reprojection_error() >= max_pixels or _breaks(images).any():
        return False
    return not any(_turns(images, 1)[np.diff([_index(image) for image in images]) == 1] >= _MAX_TURN)


def breaks_of(model: Any) -> list[int]:
    """Return the indices of frames that have a pose, and after which the path breaks.

    The next frame has a pose and shares few points with it. Or few points hold the parts before and after it together:
    those that two frames or more of each part see. Such a part may be degrees off, though its tracks fit
    (benchmarks/LOG.md).
    """
    images = placed_images(model)
    indices = np.array([_index(image) for image in images])
    breaks = _breaks(images) & (np.diff(indices) == 1)
    inside = slice(_SHORTEST_PART - 1, 1 - _SHORTEST_PART)
    breaks[inside] |= _count_holding_points(images)[inside] < MIN_POINTS
    return indices[:-1][breaks].tolist()


def _count_holding_points(images: list[Any]) -> NDArray[np.int64]:
    """Return for all images but the last how many points two images or more up to it and after it see."""
    sees = _sees(images).tocsc()
    first, end = sees.indptr[:-1], sees.indptr[1:]
    first, end = first[end - first >= 4], end[end - first >= 4]
    begins = np.bincount(sees.indices[first + 1], minlength=len(images))
    ends = np.bincount(sees.indices[end - 2], minlength=len(images))
    return np.cumsum(begins - ends)[:-1]


def _breaks(images: list[Any]) -> NDArray[np.bool_]:
    return _count_shared_points(images).diagonal(1) < MIN_POINTS


def stand_upright(model: Any) -> None:
    """Turn and move the world of a model: z is up if its frames were held level, and the origin is amid them.

    The axes run along the scene: from above, the rectangle along x and y that holds nearly all points is the smallest.
    Hash grids have these axes, and a scene along them needs fewer of their cells (benchmarks/LOG.md).
    """
    poses = torch.from_numpy(np.stack(list(poses_of(model).values())))
    transform = auto_orient_and_center_poses((homogeneous(poses) @ OPENCV_TO_OPENGL).float(), "vertical", "poses")[1]
    model.transform(pycolmap.Sim3d(transform.double().numpy()))
    points = np.stack([point.xyz for point in model.points3D.values()])

    def area(turn: Rotation) -> float:
        low, high = np.quantile(turn.apply(points)[:, :2], [0.01, 0.99], axis=0)
        return float(np.prod(high - low))

    turn = min((Rotation.from_euler("z", angle, degrees=True) for angle in range(90)), key=area)
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(turn.as_matrix()), np.zeros(3)))


def intrinsics_of(model: Any) -> CameraIntrinsics:
    """Return the intrinsics that a model has: those of COLMAP's SIMPLE_RADIAL, which it estimates."""
    (camera,) = model.cameras.values()
    focal_length, cx, cy, k1 = (float(value) for value in camera.params)
    distortion = (k1, 0.0, 0.0, 0.0, 0.0)
    return CameraIntrinsics(camera.width, camera.height, focal_length, focal_length, cx, cy, distortion=distortion)


def trajectory_of(model: Any, times: NDArray[np.int64], source: str | Path) -> Trajectory:
    """Return the camera-to-world poses of the frames that :func:`poses_of` a model has, with OpenCV camera axes.

    Args:
        model: COLMAP's.
        times: (N,) of all frames in nanoseconds.
        source: the file or folder of the frames, for messages.
    """
    poses = poses_of(model)
    indices = sorted(poses)
    return Trajectory(times[indices], torch.from_numpy(np.stack([poses[i] for i in indices])), source)
