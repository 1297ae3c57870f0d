"""Camera poses from the events alone: COLMAP on images that are made of them."""

from __future__ import annotations

import time
from pathlib import Path

from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.pose_estimation.event_images import match_event_images
from aenerf_ns.pose_estimation.placement import EstimatedPoses, place_images
from aenerf_ns.recording.recording import Capture

# Images without a pose in a row across which poses are interpolated. Images follow each other as the picture moves, so
# poses across many of them are wrong, and so is what their events are trained on.
_MAX_LOST = 2


def estimate_poses_from_events(
    capture: Capture,
    window: TimeWindow,
    source: str | Path,
    seed: int = 0,
    weights: Path | None = None,
    folder: Path | None = None,
) -> EstimatedPoses:
    """Estimate the poses of an event camera from its events, on the CPU.

    COLMAP matches images that are made of the events (:func:`match_event_images`), and
    :func:`~aenerf_ns.pose_estimation.placement.place_images` places them. Intrinsics stay as they are; where they are
    only guessed, one focal length and the radial distortion k1 are estimated first. A seed gives the same poses again,
    to the last bit on one machine with one version of COLMAP.

    Args:
        capture, window, source, seed, weights, folder: see :func:`match_event_images`.

    Raises:
        DataError: there are too few events for three images, or COLMAP places no images.
    """
    begin = time.perf_counter()
    is_calibrated = capture.intrinsics_origin != "guessed"
    remedy = "poses need a camera that moves sideways and sees textured surfaces; " + (
        "check the calibration too" if is_calibrated else "a calibration helps"
    )
    with match_event_images(capture, window, source, seed, weights, folder) as (workspace, times, pictures):
        camera = capture.event_camera if is_calibrated else None
        return place_images(
            workspace,
            times,
            camera,
            source,
            "images of the events",
            remedy,
            begin,
            max_lost=_MAX_LOST,
            pictures=pictures,
        )
