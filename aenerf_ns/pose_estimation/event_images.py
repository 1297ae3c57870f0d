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
from aenerf_ns.pose_estimation.colmap_workspace import ColmapWorkspace, work_folder
from aenerf_ns.progress import progress_bar, tracked
from aenerf_ns.reconstruction.batches import EVENTS_PER_PIXEL, batches_of
from aenerf_ns.reconstruction.images import NetworkImages
from aenerf_ns.reconstruction.two_sided import log_intensities
from aenerf_ns.reconstruction.weights import load_network
from aenerf_ns.recording.recording import Capture

# Batches of events from one image to the next, each of as many events as networks are made for.
_BATCHES = 3
# Of the filter. Features should show where they are now, which matters more than true brightness.
_DECAY = 0.12
# Pixels: standard deviation of a Gaussian, and the percentiles of the picture that are shown black and white.
_BLUR, _PERCENTILES = 0.8, (1.0, 99.0)
MIN_IMAGES = 3
"""Images that poses are estimated from, at least."""


@contextmanager
def match_event_images(
    capture: Capture,
    window: TimeWindow,
    source: str | Path,
    seed: int,
    weights: Path | None,
    folder: Path | None,
) -> Iterator[tuple[ColmapWorkspace, NDArray[np.int64], list[NDArray[np.uint8]]]]:
    """Make images of the events whenever the picture has got about one event per pixel, and match their features.

    Args:
        capture: the events and the camera's intrinsics.
        window: events outside it are left out.
        source: the dataset, for messages.
        seed: of COLMAP's random samples.
        weights: file of a network that makes the images; by default, a filter makes them.
        folder: see :func:`~aenerf_ns.pose_estimation.colmap_workspace.work_folder`.

    Yields:
        COLMAP's workspace, and the (N,) times in nanoseconds, increasing, and the images: (height, width) gray, or
        (height, width, 3) where a network makes them.

    Raises:
        DataError: there are too few events for three images.
    """
    camera, events = capture.event_camera, capture.event_file
    num_events = round(_BATCHES * EVENTS_PER_PIXEL * camera.width * camera.height)
    # Pixels that fire by themselves would be features that do not move.
    filters = EventFilters(start=window.start, end=window.end, hot_pixels=True)
    kept = EventSelection(events.path, events.width, events.height, filters, capture.sensor.bayer_pattern)
    kept.find_hot_pixels(tracked(events.chunks(), "Looking for hot pixels", events.count()))
    chunks = kept.filtered(tracked(events.chunks(), "Making images of the events", events.count()))
    if weights is None:
        states = log_intensities(batches_of(chunks, num_events), capture.sensor, _DECAY)
        images = [(time, _stretched(state)) for time, state in states]
    else:
        network = NetworkImages(load_network(weights), capture.sensor, "cpu")
        images = list(islice(network(batches_of(chunks, num_events // _BATCHES)), _BATCHES - 1, None, _BATCHES))
    if len(images) < MIN_IMAGES:
        raise DataError(
            events.path,
            f"its events make {len(images)} images of {num_events:,} events each",
            f"poses can be estimated from {MIN_IMAGES} images or more: record for longer, or widen the time window",
        )
    times = np.array([moment for moment, _ in images], np.int64)
    # Events of one time may end one image and begin the next.
    later = np.append(True, np.diff(times) > 0)
    times, pictures = times[later], [image for (_, image), is_later in zip(images, later, strict=True) if is_later]
    with work_folder(folder) as place, progress_bar() as progress:
        workspace = ColmapWorkspace(place, len(times), seed, progress)
        workspace.add_frames(pictures, (camera.width, camera.height), source)
        workspace.find_features(None if capture.intrinsics_origin == "guessed" else camera)
        workspace.match()
        yield workspace, times, pictures


def _stretched(state: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return (height, width) display values of log-intensities, in which features stand out."""
    smooth = cv2.GaussianBlur(state, (0, 0), _BLUR)
    low, high = np.percentile(smooth, _PERCENTILES)
    return np.rint(np.clip((smooth - low) / max(high - low, 1e-9), 0, 1) * 255).astype(np.uint8)
