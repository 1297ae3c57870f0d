"""Images of the events, with their features matched by COLMAP."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.errors import DataError
from aenerf_ns.events.filters import EventFilters, EventSelection
from aenerf_ns.events.polarity_drift import drift_of_events
from aenerf_ns.pose_estimation.colmap_workspace import ColmapWorkspace, work_folder
from aenerf_ns.progress import progress_bar
from aenerf_ns.reconstruction.batches import EVENTS_PER_PIXEL, batches_of
from aenerf_ns.reconstruction.images import NetworkImages
from aenerf_ns.reconstruction.two_sided import log_intensities
from aenerf_ns.reconstruction.weights import load_network
from aenerf_ns.recording.recording import Capture

# Batches of events from one image to the next, each of as many events as networks are made for.
_BATCHES = 3
# Pixels that the picture moves from one image to the next, at most. A sensor that is slow or has high thresholds gives
# few events for a motion.
_MAX_MOTION = 4.5
# Of the filter, from one image to the next. Features should show where they are now, which matters more than true
# brightness.
_DECAY = 0.126
# Pixels: standard deviation of a Gaussian, and the percentiles of the picture that are shown black and white.
_BLUR, _PERCENTILES = 0.8, (1.0, 99.0)
# Pairs of images whose motion is measured, about; number, least quality and distance of their corners.
_NUM_MOTIONS, _CORNERS = 100, (200, 0.02, 4)
# Pixels that a match must have moved. What a sensor adds or loses leaves ghosts where the scene was, which stand still.
_MIN_MOTION = 0.5
MIN_IMAGES = 3
"""Images that poses are estimated from, at least."""


@contextmanager
def match_event_images(
    capture: Capture, window: TimeWindow, source: str | Path, seed: int, weights: Path | None, folder: Path | None
) -> Iterator[tuple[ColmapWorkspace, NDArray[np.int64], list[NDArray[np.uint8]]]]:
    """Make images of the events (:func:`images_of_events`), and match their features.

    Args:
        capture, window, weights: see :func:`images_of_events`.
        source: the dataset, for messages.
        seed: of COLMAP's random samples.
        folder: see :func:`~aenerf_ns.pose_estimation.colmap_workspace.work_folder`.

    Yields:
        COLMAP's workspace, and the times and images.

    Raises:
        DataError: there are too few events for three images.
    """
    camera = capture.event_camera
    times, pictures = images_of_events(capture, window, weights)
    with work_folder(folder) as place, progress_bar() as progress:
        workspace = ColmapWorkspace(place, len(times), seed, progress, _MIN_MOTION)
        workspace.add_frames(pictures, (camera.width, camera.height), source)
        workspace.find_features(None if capture.intrinsics_origin == "guessed" else camera)
        workspace.match()
        yield workspace, times, pictures


def images_of_events(
    capture: Capture, window: TimeWindow, weights: Path | None = None
) -> tuple[NDArray[np.int64], list[NDArray[np.uint8]]]:
    """Make an image whenever the picture has got about one event per pixel, or has moved far from the last one.

    Args:
        capture: the events and the camera's intrinsics.
        window: events outside it are left out.
        weights: file of a network that makes the images; by default, a filter makes them.

    Returns:
        The (N,) times in nanoseconds, increasing, of the light that the images show, and the images: (height, width)
        gray, or (height, width, 3) where a network makes them.

    Raises:
        DataError: there are too few events for three images.
    """
    camera, events = capture.event_camera, capture.event_file
    num_pixels = camera.width * camera.height
    # Pixels that fire by themselves would be features that do not move.
    filters = EventFilters(start=window.start, end=window.end, hot_pixels=True)
    kept = EventSelection(events.path, camera.width, camera.height, filters, capture.sensor.bayer_pattern)
    kept.find_hot_pixels(events.tracked("Looking for hot pixels"))

    def make_images(num_events: int, drift: NDArray[np.float32] | None) -> list[tuple[int, NDArray[np.uint8]]]:
        chunks = kept.filtered(events.tracked("Making images of the events"))
        if weights is not None:
            network = NetworkImages(load_network(weights), capture.sensor, "cpu")
            batches = batches_of(chunks, num_events // _BATCHES)
            return list(islice(network(batches), _BATCHES - 1, None, _BATCHES))
        decay = _DECAY * num_pixels / num_events
        states = log_intensities(batches_of(chunks, num_events), capture.sensor, decay, drift)
        return [(time, _stretched(state)) for time, state in states]

    num_events = round(_BATCHES * EVENTS_PER_PIXEL * num_pixels)
    images = make_images(num_events, None)
    if len(images) < MIN_IMAGES:
        remedy = f"poses can be estimated from {MIN_IMAGES} images or more: record for longer, or widen the time window"
        raise DataError(events.path, f"its events make {len(images)} images of {num_events:,} events each", remedy)
    share = _MAX_MOTION / max(_motion([image for _, image in images]), _MAX_MOTION)
    drift = None
    if weights is None:
        drift = drift_of_events(kept.filtered(events.tracked("Comparing the pixels")), capture.sensor.refractory_period)
    if share < 1 or (drift is not None and drift.any()):
        images = make_images(round(share * num_events), drift)
    times = np.array([moment for moment, _ in images], np.int64) - capture.sensor.image_lag
    # Events of one time may end one image and begin the next.
    later = np.append(True, np.diff(times) > 0)
    return times[later], [image for (_, image), is_later in zip(images, later, strict=True) if is_later]


def _stretched(state: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return (height, width) display values of log-intensities, in which features stand out."""
    smooth = cv2.GaussianBlur(state, (0, 0), _BLUR)
    low, high = np.percentile(smooth, _PERCENTILES)
    return np.rint(np.clip((smooth - low) / max(high - low, 1e-9), 0, 1) * 255).astype(np.uint8)


def _motion(images: list[NDArray[np.uint8]]) -> float:
    """Return the pixels that features move from one image to the next: the median, 0 where none can be tracked."""
    moved = []
    for i in range(0, len(images) - 1, max(len(images) // _NUM_MOTIONS, 1)):
        # The images of networks are gray in three equal channels, unless the sensor sees color.
        here, there = (cv2.cvtColor(one, cv2.COLOR_RGB2GRAY) if one.ndim == 3 else one for one in images[i : i + 2])
        corners = cv2.goodFeaturesToTrack(here, *_CORNERS)
        if corners is None:
            continue
        ends, found, _ = cv2.calcOpticalFlowPyrLK(here, there, corners, np.empty_like(corners))
        back, found_back, _ = cv2.calcOpticalFlowPyrLK(there, here, ends, np.empty_like(ends))
        distances, errors = (np.linalg.norm(np.subtract(place, corners), axis=2)[:, 0] for place in (ends, back))
        is_tracked = np.logical_and(found, found_back)[:, 0] & (errors < 1)
        if is_tracked.any():
            moved.append(float(np.median(distances[is_tracked])))
    return float(np.median(moved)) if moved else 0.0
