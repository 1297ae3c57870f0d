"""Optical flow of events: how the image moves, tile by tile, by contrast maximization (Gallego et al. 2018)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.events.event_images import TILE, image_size, sharpest
from aenerf_ns.events.stream import EventStream

# The image moves by at most this many pixels of the images of warped events from the first event to the last. From one
# displacement that is tried to the next, events at the ends move by half of the step.
_MAX_DISPLACEMENT, _STEP = 15.0, 1.5


def optical_flow(events: EventStream) -> tuple[NDArray[np.float64], int]:
    """Return the velocity that gives the events of a tile the sharpest edges, without knowing poses or depth.

    Where a tile sees edges of one direction only, the velocity along the edges is undetermined.

    Args:
        events: of a time so short that the motion is nearly even, and so long that edges move by some pixels.

    Returns:
        (R, C, 2) velocities along x and y in pixels of the sensor per second, 0 in tiles without events. And the side
        of a tile in pixels of the sensor.
    """
    width, height, binning = image_size(events.width, events.height)
    if len(events) == 0:
        return np.zeros((height // TILE, width // TILE, 2)), TILE * binning
    duration = max(int(events.t[-1] - events.t[0]), 1)
    part = (events.t - events.t[0]) / duration - 0.5
    # An event is anywhere within its pixel.
    jitter = np.random.default_rng(0).uniform(0, 1, (2, len(events)))
    x, y = (np.stack([events.x, events.y]) + jitter) / binning

    along = np.arange(-_MAX_DISPLACEMENT, _MAX_DISPLACEMENT + _STEP / 2, _STEP)
    tried = np.stack(np.meshgrid(along, along), -1).reshape(-1, 2)
    length = np.hypot(*tried.T)
    # Slow ones first, because the first of equally good ones is taken.
    tried = tried[np.argsort(length, kind="stable")][: (length <= _MAX_DISPLACEMENT).sum()]
    warps = (
        (np.stack([x, -part * across, y, -part * down, np.zeros_like(x)]).astype(np.float32), 1)
        for across, down in tried
    )
    best, _, _ = sharpest(warps, events.p.astype(np.float32), height, width)
    return tried[best] * (binning * 1e9 / duration), TILE * binning
