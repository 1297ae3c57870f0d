"""Camera poses from the frames of a video, by COLMAP."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from torch import Tensor

from aenerf_ns.camera.alignment import Similarity, align, pose_errors, rotation_angle
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.time_window import runs_of
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.errors import DataError
from aenerf_ns.pose_estimation.colmap_model import intrinsics_of, stand_upright, trajectory_of
from aenerf_ns.pose_estimation.colmap_workspace import ColmapWorkspace, work_folder
from aenerf_ns.pose_estimation.scene_box import box_of
from aenerf_ns.progress import progress_bar

# Beyond these errors, a pose is not inaccurate but wrong: COLMAP put the camera elsewhere.
_FLIP_DEGREES = 90.0
_MISPLACED_DEGREES = 5.0
_MISPLACED_EXTENTS = 0.1
# Frames whose orientation is tried for the world, of many: each is compared with all.
_MAX_TRIED = 500

_MAX_GAPS_SHOWN = 10


@dataclass(frozen=True)
class EstimatedPoses:
    """The poses that structure from motion finds in a video.

    Attributes:
        frame_times: (N,) times of all frames in nanoseconds.
        trajectory: poses of the frames that the largest model places well, camera-to-world, OpenCV camera axes, in a
            world of arbitrary heading and scale, with z up if the frames were held level, and the origin amid them.
        camera: intrinsics of the frames, as they were given or as COLMAP estimates them.
        model_sizes: numbers of frames that the models place, the largest first. More than one model means that the
            video fell apart into pieces whose relative poses are not known. COLMAP drops pieces of less than 10 frames.
        num_points: 3D points of the largest model.
        reprojection_error: mean over their observations, in pixels.
        features: median number of features in a frame.
        seconds: how long the last command took.
        scene_box: (2, 3) corners of a box around what the camera goes around; None if it does not.
        images: what the frames are, for people to read.
        mapper: COLMAP's mapper whose model was taken, incremental or global.
        agreement: share of the matches kept apart that fit the poses; None where none were kept apart.
        max_lost: frames in a row without a pose across which poses are interpolated; None for any number.
        draw: draws the images, their tracks and paths (:func:`~aenerf_ns.pose_estimation.picture.draw_poses`), given
            the paths; None where the images were not kept.
    """

    frame_times: NDArray[np.int64]
    trajectory: Trajectory
    camera: CameraIntrinsics
    model_sizes: list[int]
    num_points: int
    reprojection_error: float
    features: float
    seconds: float
    scene_box: Tensor | None = None
    images: str = "frames"
    mapper: str = "incremental"
    agreement: float | None = None
    max_lost: int | None = None
    draw: Callable[[Mapping[str, NDArray[np.float64]]], Image.Image] | None = None

    def gaps(self) -> list[tuple[int, int, int]]:
        """Return first time, last time (nanoseconds) and number of frames of every run of frames without a pose."""
        lost = ~np.isin(self.frame_times, self.trajectory.times.numpy())
        times = self.frame_times
        return [(int(times[first]), int(times[end - 1]), end - first) for first, end in runs_of(lost)]

    def max_pose_gap(self) -> int | None:
        """Return the nanoseconds between two poses beyond which none are known between them; None for no limit.

        It is the longest interval with at most ``max_lost`` lost frames, if there are intervals with more.
        """
        placed = np.flatnonzero(np.isin(self.frame_times, self.trajectory.times.numpy()))
        num_lost, intervals = np.diff(placed) - 1, np.diff(self.frame_times[placed])
        if self.max_lost is None or (num_lost <= self.max_lost).all():
            return None
        return int(intervals[num_lost <= self.max_lost].max(initial=1))

    def report(self) -> dict[str, Any]:
        """Return the figures as plain values for JSON."""
        registered, frames = len(self.trajectory), len(self.frame_times)
        return {
            "frames": frames,
            "registered_frames": registered,
            "registered_fraction": registered / frames,
            "model_sizes": self.model_sizes,
            "gaps": [{"start_ns": start, "end_ns": end, "frames": count} for start, end, count in self.gaps()],
            "points": self.num_points,
            "mean_reprojection_error_pixels": self.reprojection_error,
            "median_features": self.features,
            "seconds": self.seconds,
            "mapper": self.mapper,
            "agreement": self.agreement,
            "summary": self.summary(),
        }

    def summary(self) -> str:
        """Return a line of figures, and a second line that names the times of frames without a pose, if any."""
        pieces = f" in the largest of {len(self.model_sizes)} models" if len(self.model_sizes) > 1 else ""
        line = (
            f"COLMAP: {len(self.trajectory)} of {len(self.frame_times)} {self.images} registered{pieces}, "
            f"{self.num_points} points, reprojection error {self.reprojection_error:.2f} px"
        )
        if self.agreement is not None:
            line += f", {self.mapper} mapper; {self.agreement:.0%} of the matches that were kept apart fit the poses"
        gaps = [f"{start * 1e-9:.3f} to {end * 1e-9:.3f} s ({count})" for start, end, count in self.gaps()]
        if len(gaps) > _MAX_GAPS_SHOWN:
            gaps = [*gaps[:_MAX_GAPS_SHOWN], f"and {len(gaps) - _MAX_GAPS_SHOWN} more runs"]
        if gaps:
            longest = self.max_pose_gap()
            near = "" if longest is None else f" at most {longest * 1e-9:.3g} s apart"
            line += (
                f"\nFrames without a pose: {', '.join(gaps)}. Between registered frames{near} poses are interpolated; "
                "other events are not used."
            )
        return line


def estimate_poses(
    frames: Iterable[Path | NDArray[np.uint8]],
    times: ArrayLike,
    camera: CameraIntrinsics | tuple[int, int],
    source: str | Path,
    seed: int = 0,
    folder: Path | None = None,
) -> EstimatedPoses:
    """Estimate the poses of a video by COLMAP's incremental structure from motion, on the CPU.

    Intrinsics and distortion that are given stay as given. Every frame is matched with its neighbors, and a hundred
    frames with each other. A seed gives the same poses again, to the last bit on one machine with one version of
    COLMAP.

    Args:
        frames: (height, width) gray or (height, width, 3) RGB arrays, or files that hold such pictures, in the order of
            time.
        times: (N,) times in nanoseconds, increasing.
        camera: intrinsics of the frames. Or width and height of the frames in pixels: COLMAP then estimates one focal
            length and the radial distortion k1, and the principal point is the middle of the image.
        source: the file or folder of the frames, for messages.
        seed: of COLMAP's random samples.
        folder: see :func:`~aenerf_ns.pose_estimation.colmap_workspace.work_folder`.

    Raises:
        DataError: there are fewer than three frames, a frame is of another size than the camera, the times do not
            increase, or COLMAP places no frames.
    """
    times = np.asarray(times, np.int64)
    if len(times) < 3:
        raise DataError(source, f"{len(times)} frames", "poses can be estimated from three frames or more")
    if len(backward := np.flatnonzero(np.diff(times) <= 0)):
        raise DataError(source, f"frame {backward[0] + 1} is not after the frame before it", "sort the frames by time")
    begin = time.perf_counter()
    given = camera if isinstance(camera, CameraIntrinsics) else None
    size = (camera.width, camera.height) if isinstance(camera, CameraIntrinsics) else camera
    with work_folder(folder) as place, progress_bar() as progress:
        workspace = ColmapWorkspace(place, len(times), seed, progress)
        workspace.add_frames(frames, size, source)
        workspace.find_features(given)
        workspace.match()
        models = workspace.reconstruct(refine_intrinsics=given is None)
        features, pairs = workspace.count_features_and_pairs()
    if not models:
        raise DataError(
            source,
            f"COLMAP places none of {len(times)} frames: they have {features:.0f} features (median), and {pairs} pairs "
            "of frames match",
            "it needs a moving camera and sharp, textured frames: a shorter exposure, a higher frame rate, more pixels",
        )
    model = models[0]
    stand_upright(model)
    return EstimatedPoses(
        frame_times=times,
        trajectory=trajectory_of(model, times, source),
        camera=given or intrinsics_of(model),
        model_sizes=[model.num_reg_images() for model in models],
        num_points=model.num_points3D(),
        reprojection_error=model.compute_mean_reprojection_error(),
        features=features,
        seconds=time.perf_counter() - begin,
        scene_box=box_of(model),
    )


def compare_with_truth(estimated: Trajectory, truth: Tensor) -> tuple[Trajectory, dict[str, float]]:
    """Map estimated poses to the true world by one Sim(3), and compute their errors.

    Only position, orientation and scale of the whole world are taken from the truth. The similarity aligns positions
    and orientations (:func:`~aenerf_ns.camera.alignment.align`) of the frames that agree with most other frames. So a
    few misplaced frames do not turn the world away from the rest. All frames are mapped, and none is removed.

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
    return align(poses[agree], truth[agree])
