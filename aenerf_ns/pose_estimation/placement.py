"""Place images by COLMAP: take the better model of its two mappers, and adjust it to all tracks."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.time_window import runs_of
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.errors import DataError
from aenerf_ns.pose_estimation.colmap_model import (
    MIN_POINTS,
    breaks_of,
    is_placed,
    is_sound,
    poses_of,
    stand_upright,
    trajectory_of,
)
from aenerf_ns.pose_estimation.colmap_workspace import ColmapWorkspace
from aenerf_ns.pose_estimation.picture import draw_poses, observations_of
from aenerf_ns.pose_estimation.scene_box import box_of

# Share of the pairs of images whose matches judge the models, and are used for nothing else.
_HELD_OUT = 0.05
# Share of these matches by which the incremental mapper must be better: where both agree alike, the global one's poses
# come out better (benchmarks/LOG.md).
_GLOBAL_LEAD = 0.03
# A fit, with this lead, from which on the incremental mapper, which takes longest, is not asked: it fits 93 % at most.
_GOOD_FIT = 0.93
# Rounds of adjustment to all tracks: pixels and degrees that an observation may be off, and pixels beyond which an
# observation counts less. At first, most are off by more.
_ROUNDS = ((12.0, 8.0, 1.0), (4.0, 2.0, 0.5))
# A round before them for a model whose path has a break: matches across the break are off by many pixels.
_MENDING = (24.0, 16.0, 2.0)

# Gaps or breaks that the summary names.
_MAX_SHOWN = 10


@dataclass(frozen=True)
class EstimatedPoses:
    """The poses that structure from motion finds for images in the order of time.

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
        breaks: times in nanoseconds of the frames after which the path breaks
            (:func:`~aenerf_ns.pose_estimation.colmap_model.breaks_of`).
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
    breaks: tuple[int, ...] = ()
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
            "breaks_ns": list(self.breaks),
            "summary": self.summary(),
        }

    def summary(self) -> str:
        """Return a line of figures, a line that names the times of breaks, and one of frames without a pose, if any."""
        pieces = f" in the largest of {len(self.model_sizes)} models" if len(self.model_sizes) > 1 else ""
        line = (
            f"COLMAP: {len(self.trajectory)} of {len(self.frame_times)} {self.images} registered{pieces}, "
            f"{self.num_points} points, reprojection error {self.reprojection_error:.2f} px"
        )
        if self.agreement is not None:
            line += f", {self.mapper} mapper; {self.agreement:.0%} of the matches that were kept apart fit the poses"
        if self.breaks:
            times = _shortened([f"{time * 1e-9:.3f} s" for time in self.breaks], "times")
            line += (
                f"\nThe path breaks after {times}: fewer than {MIN_POINTS} points hold the {self.images} before and "
                "after together. Parts may be degrees off, or lie the wrong way round."
            )
        gaps = [f"{start * 1e-9:.3f} to {end * 1e-9:.3f} s ({count})" for start, end, count in self.gaps()]
        if gaps:
            longest = self.max_pose_gap()
            near = "" if longest is None else f" at most {longest * 1e-9:.3g} s apart"
            line += (
                f"\nFrames without a pose: {_shortened(gaps, 'runs')}. Between registered frames{near} poses are "
                "interpolated; other events are not used."
            )
        return line


def _shortened(items: list[str], name: str) -> str:
    rest = len(items) - _MAX_SHOWN
    return ", ".join([*items[:_MAX_SHOWN], f"and {rest} more {name}"] if rest > 0 else items)


def place_images(
    workspace: ColmapWorkspace,
    times: NDArray[np.int64],
    camera: CameraIntrinsics | None,
    source: str | Path,
    images: str,
    remedy: str,
    begin: float,
    *,
    adjusted: bool = True,
    max_lost: int | None = None,
    pictures: Sequence[NDArray[np.uint8]] | None = None,
) -> EstimatedPoses:
    """Place images whose features are matched.

    COLMAP's global mapper places the images, and its incremental mapper where the global one's model has a break or few
    of the matches kept apart fit it. The model that more of them fit is adjusted in two rounds, the images that it
    lacks are placed again, and its poses are taken; where both fit alike, the global mapper's. If it still has a break,
    the other model is tried.

    Args:
        workspace: the images and their matches.
        times: (N,) times of the images in nanoseconds.
        camera: intrinsics, which stay as they are. Without them one focal length and the radial distortion k1 are
            estimated first.
        source: the file or folder of the images, for messages.
        images, max_lost: see :class:`EstimatedPoses`.
        remedy: what helps where no image is placed.
        begin: when the command began, by time.perf_counter.
        adjusted: see :func:`~aenerf_ns.pose_estimation.from_frames.estimate_poses`.
        pictures: the images, if they shall be drawn.

    Raises:
        DataError: COLMAP places no images.
    """
    camera = camera or workspace.estimate_intrinsics(_ROUNDS)
    features, pairs = workspace.count_features_and_pairs()
    found = _map_images(workspace, adjusted) if camera else {}
    models: dict[str, Any] = {}
    for mapper, (model, *_) in found.items():
        models[mapper] = _refine(workspace, model, len(times)) if adjusted else model
        if _is_sound(models[mapper]):
            break
    sound = _sound(models)
    mapper = max(models, key=lambda one: (is_placed(models[one]), sound[one]), default="")
    if camera is None or not mapper or not is_placed(models[mapper]):
        problem = f"they have {features:.0f} features (median), and {pairs} pairs of {images} match"
        raise DataError(source, f"COLMAP places none of {len(times)} {images}: {problem}", remedy)

    model = models[mapper]
    placed = poses_of(model).keys()
    others = [other for other in found[mapper][1:] if not poses_of(other).keys() <= placed]
    agreement, error = workspace.agreement(model), model.compute_mean_reprojection_error()
    stand_upright(model)
    return EstimatedPoses(
        frame_times=times,
        trajectory=trajectory_of(model, times, source),
        camera=camera,
        model_sizes=[one.num_reg_images() for one in (model, *others)],
        num_points=model.num_points3D(),
        reprojection_error=error,
        features=features,
        seconds=time.perf_counter() - begin,
        scene_box=box_of(model),
        images=images,
        mapper=mapper,
        agreement=agreement,
        breaks=tuple(times[breaks_of(model)].tolist()),
        max_lost=max_lost,
        draw=None if pictures is None else partial(draw_poses, pictures, observations_of(model, len(times))),
    )


def _map_images(workspace: ColmapWorkspace, adjusted: bool) -> dict[str, list[Any]]:
    """Return the models of the mappers that are asked, the largest first, and the mapper that fits better first."""
    found: dict[str, list[Any]] = {}
    shares: dict[str, float] = {}
    mappers: dict[str, Callable[[], list[Any]]] = {"incremental": workspace.reconstruct}
    if adjusted:
        workspace.hold_out_matches(_HELD_OUT)
        # Not side by side: the global mapper then gives other poses each time.
        mappers = {"global": workspace.reconstruct_globally, **mappers}
    for mapper, place in mappers.items():
        models = place()
        if models:
            found[mapper] = models
            share = workspace.agreement(models[0]) or 0.0
            shares[mapper] = share + (_GLOBAL_LEAD if mapper == "global" else 0.0)
            if shares[mapper] >= _GOOD_FIT and _is_sound(models[0]):
                break
    sound = _sound({mapper: models[0] for mapper, models in found.items()})
    order = sorted(found, key=lambda mapper: (sound[mapper], shares[mapper]), reverse=True)
    return {mapper: found[mapper] for mapper in order}


def _refine(workspace: ColmapWorkspace, model: Any, num_images: int) -> Any:
    """Adjust a model to all tracks, and place the images that it lacks."""

    def adjust(model: Any, rounds: Iterable[tuple[float, float, float]]) -> Any:
        for limits in rounds:
            model = workspace.adjust(model, *limits) if is_placed(model) else model
        return model

    model = adjust(model, _ROUNDS if _is_sound(model) else (_MENDING, *_ROUNDS))
    if not is_placed(model) or len(poses := poses_of(model)) == num_images:
        return model
    # Where images are lost, the model often has a bend. Now that the model is better, more of them find their place
    # (benchmarks/LOG.md).
    start = workspace.triangulate(poses, *_ROUNDS[-1][:2])
    more = adjust((workspace.reconstruct(start=start) or [model])[0], _ROUNDS[1:])
    is_better = len(poses_of(more)) >= len(poses) and (_is_sound(more) or not _is_sound(model))
    return more if is_better else model


def _sound(models: Mapping[str, Any]) -> dict[str, bool]:
    """Return which models have no fault: a fragment of the path has none because it is short, and does not count."""
    sizes = {mapper: len(poses_of(model)) for mapper, model in models.items()}
    return {mapper: 2 * sizes[mapper] >= max(sizes.values()) and _is_sound(model) for mapper, model in models.items()}


def _is_sound(model: Any) -> bool:
    return is_sound(model, max_pixels=_ROUNDS[-1][0])
