"""Camera poses from the events alone: COLMAP on images that are made of them."""

from __future__ import annotations

import time
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.errors import DataError
from aenerf_ns.pose_estimation.colmap_model import is_placed, is_sound, poses_of, stand_upright, trajectory_of
from aenerf_ns.pose_estimation.event_images import match_event_images
from aenerf_ns.pose_estimation.from_frames import EstimatedPoses
from aenerf_ns.pose_estimation.picture import draw_poses, observations_of
from aenerf_ns.pose_estimation.scene_box import box_of
from aenerf_ns.recording.recording import Capture

# Share of the pairs of images whose matches judge the models, and are used for nothing else.
_HELD_OUT = 0.05
# Share of these matches by which the incremental mapper must be better: where both agree alike, the global one's poses
# come out better (benchmarks/LOG.md).
_GLOBAL_LEAD = 0.03
# A fit, with this lead, from which on the incremental mapper, which takes longest, is not asked: it fits 93 % at most.
_GOOD_FIT = 0.93
# Images without a pose in a row across which poses are interpolated. Images follow each other as the picture moves, so
# poses across many of them are wrong, and so is what their events are trained on.
_MAX_LOST = 2
# Rounds of adjustment to all tracks: pixels and degrees that an observation may be off, and pixels beyond which an
# observation counts less. At first, most are off by more.
_ROUNDS = ((12.0, 8.0, 1.0), (4.0, 2.0, 0.5))


def estimate_poses_from_events(
    capture: Capture,
    window: TimeWindow,
    source: str | Path,
    seed: int = 0,
    weights: Path | None = None,
    folder: Path | None = None,
) -> EstimatedPoses:
    """Estimate the poses of an event camera from its events, on the CPU.

    COLMAP matches images that are made of the events (:func:`match_event_images`). Its global mapper places the images,
    and its incremental mapper where few of the matches kept apart fit the global one's model. The model that more of
    them fit is adjusted in two rounds, the images that it lacks are placed again, and its poses are taken; where both
    fit alike, the global mapper's. Intrinsics stay as they are; where they are only guessed, one focal length and the
    radial distortion k1 are estimated first. A seed gives the same poses again, to the last bit on one machine with one
    version of COLMAP.

    Args:
        capture, window, source, seed, weights, folder: see :func:`match_event_images`.

    Raises:
        DataError: there are too few events for three images, or COLMAP places no images.
    """
    begin = time.perf_counter()
    with match_event_images(capture, window, source, seed, weights, folder) as (workspace, times, pictures):
        is_calibrated = capture.intrinsics_origin != "guessed"
        camera = capture.event_camera if is_calibrated else workspace.estimate_intrinsics(_ROUNDS)
        features, pairs = workspace.count_features_and_pairs()
        workspace.hold_out_matches(_HELD_OUT)

        found: dict[str, list[Any]] = {}
        fits: dict[str, tuple[bool, float]] = {}
        # Not side by side: the global mapper then gives other poses each time.
        mappers = {"global": workspace.reconstruct_globally, "incremental": workspace.reconstruct}
        for mapper, place in mappers.items() if camera else ():
            found[mapper] = place()
            if found[mapper]:
                share = workspace.agreement(found[mapper][0]) or 0.0
                lead = _GLOBAL_LEAD if mapper == "global" else 0.0
                fits[mapper] = is_sound(found[mapper][0], _ROUNDS[-1][0]), share + lead
                if fits[mapper] >= (True, _GOOD_FIT):
                    break

        def adjust(model: Any, rounds: Iterable[tuple[float, float, float]]) -> Any:
            for limits in rounds:
                model = workspace.adjust(model, *limits) if is_placed(model) else model
            return model

        model = None
        for mapper in sorted(fits, key=fits.__getitem__, reverse=True):
            model = adjust(found[mapper][0], _ROUNDS)
            # Where images are lost, the model often has a bend. Now that the model is better, more of them find their
            # place (benchmarks/LOG.md).
            if is_placed(model) and len(poses := poses_of(model)) < len(times):
                start = workspace.triangulate(poses, *_ROUNDS[-1][:2])
                more = adjust((workspace.reconstruct(start=start) or [model])[0], _ROUNDS[1:])
                model = more if is_placed(more) else model
            if is_placed(model):
                break
        if camera is None or model is None or not is_placed(model):
            raise DataError(
                source,
                f"COLMAP places none of {len(times)} images of the events: they have {features:.0f} features (median), "
                f"and {pairs} pairs of images match",
                "poses need a camera that moves sideways and sees textured surfaces; "
                + ("check the calibration too" if is_calibrated else "a calibration helps"),
            )

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
        images="images of the events",
        mapper=mapper,
        agreement=agreement,
        max_lost=_MAX_LOST,
        draw=partial(draw_poses, pictures, observations_of(model, len(times))),
    )
