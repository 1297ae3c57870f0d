"""Camera poses from the frames of a video, by COLMAP."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from aenerf_ns.camera.alignment import Similarity, align, align_most, pose_errors, rotation_angle
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.errors import DataError
from aenerf_ns.pose_estimation.colmap_workspace import ColmapWorkspace, work_folder
from aenerf_ns.pose_estimation.placement import EstimatedPoses, place_images
from aenerf_ns.progress import progress_bar

# Beyond these errors, a pose is not inaccurate but wrong: COLMAP put the camera elsewhere.
_FLIP_DEGREES = 90.0
_MISPLACED_DEGREES = 5.0
_MISPLACED_EXTENTS = 0.1
# Frames whose orientation is tried for the world, of many: each is compared with all.
_MAX_TRIED = 500


def estimate_poses(
    frames: Iterable[Path | NDArray[np.uint8]],
    times: ArrayLike,
    camera: CameraIntrinsics | tuple[int, int],
    source: str | Path,
    seed: int = 0,
    folder: Path | None = None,
    adjusted: bool = True,
) -> EstimatedPoses:
    """Estimate the poses of a video by COLMAP, on the CPU.

    Every frame is matched with its neighbors, and a hundred frames with each other.
    :func:`~aenerf_ns.pose_estimation.placement.place_images` places the frames. Intrinsics and distortion that are
    given stay as given. A seed gives the same poses again, to the last bit on one machine with one version of COLMAP.

    Args:
        frames: (height, width) gray or (height, width, 3) RGB arrays, or files that hold such pictures, in the order of
            time.
        times: (N,) times in nanoseconds, increasing.
        camera: intrinsics of the frames. Or width and height of the frames in pixels: COLMAP then estimates one focal
            length and the radial distortion k1, and the principal point is the middle of the image.
        source: the file or folder of the frames, for messages.
        seed: of COLMAP's random samples.
        folder: see :func:`~aenerf_ns.pose_estimation.colmap_workspace.work_folder`.
        adjusted: whether to ask both mappers, and to adjust the better model by a robust loss. Otherwise the poses are
            those of COLMAP's incremental mapper as it leaves them, which have larger errors (benchmarks/LOG.md).

    Raises:
        DataError: there are fewer than three frames, a frame is of another size than the camera, the times do not
            increase, or COLMAP places no frames.
    """
    times = np.asarray(times, np.int64)
    if len(times) < 3:
        remedy = "poses can be estimated from three frames or more: list them in images.txt, or give others"
        raise DataError(source, f"{len(times)} frames", remedy)
    if len(backward := np.flatnonzero(np.diff(times) <= 0)):
        raise DataError(source, f"frame {backward[0] + 1} is not after the frame before it", "sort the frames by time")
    begin = time.perf_counter()
    given = camera if isinstance(camera, CameraIntrinsics) else None
    size = (camera.width, camera.height) if isinstance(camera, CameraIntrinsics) else camera
    remedy = "it needs a moving camera and sharp, textured frames: a shorter exposure, a higher frame rate, more pixels"
    with work_folder(folder) as place, progress_bar() as progress:
        workspace = ColmapWorkspace(place, len(times), seed, progress)
        workspace.add_frames(frames, size, source)
        workspace.find_features(given)
        workspace.match()
        return place_images(workspace, times, given, source, "frames", remedy, begin, adjusted=adjusted)


def compare_with_truth(estimated: Trajectory, truth: Tensor) -> tuple[Trajectory, dict[str, float]]:
    """Map estimated poses to the true world by one Sim(3), and compute their errors.

    Only position, orientation and scale of the whole world are taken from the truth. The similarity aligns the frames
    that agree with most other frames, by :func:`~aenerf_ns.camera.alignment.align_most`. So a few misplaced frames do
    not turn the world away from the rest. Where no majority agrees, it aligns all by least squares. All frames are
    mapped, and none is removed.

    Args:
        estimated: the estimated poses.
        truth: (N, 3, 4) true poses at the same times, with the same camera axes.

    Returns:
        The mapped trajectory, and its errors in the units of the truth. The errors of
        :func:`~aenerf_ns.camera.alignment.pose_errors` follow another alignment, of all frames. The others are those of
        the mapped trajectory: medians and maxima of rotation and translation error; the number of ``misplaced_frames``
        (off by more than 5 degrees or a tenth of the extent) and of ``flipped_frames`` (off by more than 90 degrees).
        ``extent`` is the root mean square distance of the true positions from their mean.
    """
    poses, truth = estimated.camera_to_worlds, truth.double()
    extent = Trajectory(estimated.times, truth).extent
    aligned = _align_majority(poses, truth)(poses)
    degrees = torch.rad2deg(rotation_angle(aligned, truth))
    distances = (aligned - truth)[..., 3].norm(dim=-1)
    misplaced = (degrees > _MISPLACED_DEGREES) | (distances > _MISPLACED_EXTENTS * extent)
    return Trajectory(estimated.times, aligned, estimated.source), {
        **pose_errors(aligned, truth),
        "median_rotation_error_degrees": float(degrees.median()),
        "median_translation_error": float(distances.median()),
        "largest_rotation_error_degrees": float(degrees.max()),
        "largest_translation_error": float(distances.max()),
        "extent": extent,
        "misplaced_frames": int(misplaced.sum()),
        "flipped_frames": int((degrees > _FLIP_DEGREES).sum()),
    }


def _align_majority(poses: Tensor, truth: Tensor) -> Similarity:
    """Align the frames that agree on the world's orientation if they are the majority, else all frames."""
    # Each frame alone gives an orientation of the world.
    turns = truth[..., :3] @ poses[..., :3].mT
    tried = turns[:: -(-len(turns) // _MAX_TRIED)]
    degrees = torch.rad2deg(torch.stack([rotation_angle(turns, turn.expand_as(turns)) for turn in tried]))
    agree = degrees[degrees.median(1).values.argmin()] <= _MISPLACED_DEGREES
    if 2 * agree.sum() <= len(poses):
        return align(poses, truth)
    return align_most(poses[agree], truth[agree])
