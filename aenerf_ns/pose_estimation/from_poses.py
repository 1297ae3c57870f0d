"""Camera poses from given poses and the events: refined where feature tracks in images of the events know better."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from aenerf_ns.camera.alignment import rotation_angle
from aenerf_ns.camera.time_window import TimeWindow, runs_of
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.errors import DataError
from aenerf_ns.pose_estimation.bundle_adjustment import Array, Tracks, move_poses, tracks_of
from aenerf_ns.pose_estimation.event_images import MIN_IMAGES, match_event_images
from aenerf_ns.pose_estimation.picture import draw_poses, observations_of
from aenerf_ns.pose_estimation.refinement import PoseRefinement, SharedError
from aenerf_ns.pose_estimation.scene_box import box_of
from aenerf_ns.recording.recording import Recording

# Pixels and degrees that an observation may be off, round by round.
_ROUNDS = ((12.0, 8.0), (8.0, 5.0), (5.0, 3.0), *[(4.0, 2.0)] * 4)
_MIN_TRACKS = 50
_MAX_IMAGES = 1000
# From this share of corrections of a visible size on, the clock and the mount are named.
_MIN_SHARE, _MIN_DEGREES = 0.5, 0.2
# Of the scene's distance. Wherever refinement worked, a mount was moved by a hundredth of it (benchmarks/LOG.md).
_MAX_MOUNT_SHARE = 0.4
# A given motion between images is kept if it is off by less than this in degrees, or as much by translation, or by less
# than this times what a spline is; and if there are fewer images than this.
_SMALL_JUMP, _CLEARLY, _MIN_JUDGED = 0.05, 2.0, 16


@dataclass(frozen=True)
class RefinedPoses:
    """Given poses, corrected by tracks.

    Attributes:
        trajectory: at the times of the given poses, in their world.
        report: figures as plain values for JSON. Its ``summary`` is a line of them.
        scene_box: (2, 3) corners of a box around what the camera goes around; None if it does not.
        draw: draws the images, their tracks and paths (:func:`~aenerf_ns.pose_estimation.picture.draw_poses`), given
            the paths.
    """

    trajectory: Trajectory
    report: dict[str, Any]
    scene_box: Tensor | None
    draw: Callable[[Mapping[str, Array]], Image.Image]


def refine_poses(
    recording: Recording,
    window: TimeWindow,
    source: str | Path,
    seed: int = 0,
    weights: Path | None = None,
    folder: Path | None = None,
) -> RefinedPoses:
    """Refine the poses of a recording by its events, on the CPU.

    COLMAP matches images that are made of the events (:func:`match_event_images`), and triangulates tracks from the
    poses. The poses then follow the tracks, as far as these are to be trusted more
    (:class:`~aenerf_ns.pose_estimation.refinement.PoseRefinement`), in some rounds. Intrinsics stay as they are. Given
    poses between images are moved as their neighbors are, or replaced by a spline through the images' poses
    (:func:`poses_between_images`). A seed gives the same poses again, to the last bit on one machine with one version
    of COLMAP.

    Args:
        recording: its events, poses and intrinsics.
        window, source, seed, weights, folder: see :func:`match_event_images`.

    Raises:
        DataError: there are too few events for three images with a pose, or too few tracks, or the tracks contradict
            the poses (:func:`require_near_mount`).
    """
    begin = time.perf_counter()
    given = recording.trajectory
    # Images of other times would be matched for nothing.
    window = TimeWindow(max(given.start, window.start), min(given.end, window.end))
    if window.start >= window.end:
        raise DataError(source, "none of its poses are in the time window", "widen it")
    with match_event_images(recording, window, source, seed, weights, folder) as (workspace, all_times, pictures):
        images = np.flatnonzero(given.known_time(recording.max_pose_gap).contains(all_times))
        # Time and memory grow with the number's third and second power.
        images = images[:: math.ceil(len(images) / _MAX_IMAGES) or 1]
        if len(images) < MIN_IMAGES:
            problem = f"only {len(images)} of {len(all_times)} images of its events are from the time of its poses"
            raise DataError(source, problem, "check that events and poses share one clock: aenerf check")
        times = all_times[images]
        poses = given.interpolate(times).numpy()

        def triangulate(poses: Array, limits: tuple[float, float]) -> tuple[Any, Tracks]:
            model = workspace.triangulate(dict(zip(images.tolist(), poses, strict=True)), *limits)
            if model.num_points3D() < _MIN_TRACKS:
                raise DataError(
                    source,
                    f"{model.num_points3D()} tracks of {len(images)} images of the events fit its poses",
                    "poses are refined where the camera moves sideways and sees textured surfaces, and their errors "
                    "are a few degrees; try aenerf check, or estimate poses anew (--poses events)",
                )
            return model, tracks_of(model, images.tolist())

        model, tracks = triangulate(poses, _ROUNDS[0])
        offsets = tracks.positions[tracks.points] - poses[tracks.images, :, 3]
        depth = float(np.median(np.linalg.norm(offsets, axis=1)))
        refinement = PoseRefinement((times - times[0]) * 1e-9, poses, depth, seed)
        refinement.follow(tracks)
        for limits in _ROUNDS[1:]:
            model, tracks = triangulate(refinement.poses, limits)
            refinement.follow(tracks)
    require_near_mount(refinement.shared_error(), depth, source)
    observations = observations_of(model, len(pictures))
    trajectory, is_interpolated = poses_between_images(given, times, refinement, depth)
    report = {**_report(refinement, times, model.num_points3D()), "seconds": time.perf_counter() - begin}
    if is_interpolated:
        report["summary"] += "; between images, a smooth path fits better than the given motion, and is taken"
    draw = partial(draw_poses, [pictures[i] for i in images], [observations[i] for i in images])
    return RefinedPoses(trajectory, report, box_of(model), draw)


def require_near_mount(found: SharedError, depth: float, source: str | Path) -> None:
    """Raise a DataError if the tracks move the camera far in its mount, as no rig is off.

    Around an object that is nearly a change of scale, which tracks do not tell, and the other errors stay.
    """
    distance = float(np.linalg.norm(found.mount[:3]))
    if distance > _MAX_MOUNT_SHARE * depth:
        raise DataError(
            source,
            f"its poses fit the tracks only if the camera were moved by {distance:.2g} of their units in its mount, "
            f"and the scene is {depth:.2g} away",
            "they are too wrong, or too few for so fast a motion, to be refined: estimate them anew (--poses events)",
        )


def poses_between_images(
    given: Trajectory, times: NDArray[np.int64], refinement: PoseRefinement, depth: float
) -> tuple[Trajectory, bool]:
    """Return the refined poses at the times of the given ones, and whether those between images are a spline.

    Given poses that are moved as the neighboring images are keep the given motion. Where errors jump from pose to pose,
    a spline through the images' poses is better. Both predict images that are left out: every second, and three of
    four. The errors with half and with a quarter of the images tell by extrapolation what is left with all of them.

    Args:
        given: the given poses.
        times: (N,) of the images in nanoseconds.
        refinement: of their poses.
        depth: of the scene, in the units of the poses.
    """
    images, twists = Trajectory(times, torch.from_numpy(refinement.poses), given.source), refinement.twists

    def moved(at: Tensor, kept: Trajectory) -> Tensor:
        chosen = np.isin(times, kept.times)
        twists_there = [np.interp(at, times[chosen], column[chosen]) for column in twists.T]
        return torch.from_numpy(move_poses(given.interpolate(at).numpy(), np.stack(twists_there, -1)))

    def error(predict: Callable[[Tensor, Trajectory], Tensor], step: int) -> float:
        """Return the root mean square over the time without gaps, in radians, with each ``step``-th image."""
        kept = Trajectory(images.times[::step], images.camera_to_worlds[::step], given.source)
        at = images.knots_known_to(kept)
        found, refined = predict(at, kept), images.interpolate(at)
        squares = rotation_angle(found, refined).square() + ((found - refined)[..., 3] / depth).square().sum(-1)
        spans = torch.from_numpy(np.gradient(times.astype(np.float64))[np.isin(times, at)])
        return float((spans * squares).sum() / spans.sum()) ** 0.5

    poses, is_interpolated = moved(given.times, images), False
    if len(times) >= _MIN_JUDGED:
        ways = moved, lambda at, kept: kept.interpolate(at)
        of_motion, of_spline = (error(way, 2) ** 2 / max(error(way, 4), 1e-12) for way in ways)
        is_interpolated = of_motion > max(_CLEARLY * of_spline, math.radians(_SMALL_JUMP))
    if is_interpolated:
        between = given.knots_known_to(images)
        poses[torch.isin(given.times, between)] = images.interpolate(between)
    return Trajectory(given.times, poses, given.source), is_interpolated


def _report(refinement: PoseRefinement, times: NDArray[np.int64], num_tracks: int) -> dict[str, Any]:
    """Return the figures of a refinement of images at (N,) times in nanoseconds."""
    shared_error, is_weak = refinement.shared_error(), refinement.is_weak()
    translation, angle = map(float, np.sqrt(np.square(refinement.twists).reshape(-1, 2, 3).sum(-1).mean(0)))
    degrees = math.degrees(angle)
    summary = (
        f"Poses refined: {num_tracks:,} tracks in {len(times)} images of the events move them by {degrees:.2g} degrees "
        f"and {translation:.2g} of their units (root mean square)"
    )
    if shared_error.share > _MIN_SHARE and degrees > _MIN_DEGREES:
        summary += f"; {shared_error.summary()}"
    if is_weak.any():
        summary += (
            f"; for {is_weak.mean():.0%} of the images the tracks know no better than the given poses, which nearly "
            "stay"
        )
    return {
        "images": len(times),
        "tracks": num_tracks,
        "correction_degrees": degrees,
        "correction_translation": translation,
        "shared_error": shared_error.report(),
        # First and last times of runs of images whose given poses nearly stay.
        "weak_stretches_ns": [(int(times[first]), int(times[end - 1])) for first, end in runs_of(is_weak)],
        "summary": summary,
    }
