"""Images of events, smoothed and with the edges found, in tiles: what contrast is computed from."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

# The images of warped events are at most this wide: larger sensors are binned.
_MAX_WIDTH = 240
TILE = 16
"""Side of the tiles in pixels of the images."""
# Edges are the difference between the image smoothed by a Gaussian of this standard deviation and by two boxes of this
# width. The two boxes are about a Gaussian of 2.8 pixels.
_FINE, _COARSE = 0.7, 7


def image_size(width: int, height: int) -> tuple[int, int, int]:
    """Return width and height of the images of a sensor's events, and the binning.

    The size is a whole number of tiles. The binning is the number of the sensor's pixels along a pixel of the images.
    """
    binning = -(-width // _MAX_WIDTH)
    width, height = (-(-size // (binning * TILE)) * TILE for size in (width, height))
    return width, height, binning


def sharpest(
    warps: Iterable[tuple[NDArray[np.float32], float]], polarity: NDArray[np.float32], height: int, width: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return for each (R, C) tile which of several warps gives it the most contrast.

    Args:
        warps: lines and inverse depth of each, for :func:`accumulate`.
        polarity: (N,) polarities of the events.
        height, width: of the images in pixels, whole numbers of tiles.

    Returns:
        (R, C) indices of the warps, the first of equally good ones; the tiles' squared contrasts under these, less that
        of noise; and their squared brightness.
    """
    net, total = np.zeros((2, height, width), np.float32)
    measured = []
    for lines, inverse_depth in warps:
        accumulate(lines, polarity, np.float32(inverse_depth), net, total)
        coarse, edges = _smooth(total), _edges(net)
        measured.append((_tile_sums(edges * edges - _noise_energy() * coarse), _tile_sums(coarse * coarse)))
    energy, brightness = map(np.array, zip(*measured, strict=True))
    # With the ratio alone, tiles would choose the warp that leaves them empty.
    best = (energy / (brightness + brightness.mean() + 1e-12)).argmax(0)
    energy, brightness = (np.take_along_axis(values, best[None], 0)[0] for values in (energy, brightness))
    return best, energy, brightness


def _smooth(image: NDArray) -> NDArray:
    return cv2.blur(cv2.blur(image, (_COARSE, _COARSE)), (_COARSE, _COARSE))


def _edges(image: NDArray) -> NDArray:
    return cv2.GaussianBlur(image, (0, 0), _FINE) - _smooth(image)


@lru_cache(maxsize=1)
def _noise_energy() -> float:
    """Return the squared contrast that each event adds if all events are independent."""
    impulse = np.zeros((41, 41), np.float32)
    impulse[20, 20] = 1
    return float(np.square(_edges(impulse)).sum())


def _tile_sums(image: NDArray) -> NDArray[np.float64]:
    height, width = image.shape
    return image.reshape(height // TILE, TILE, width // TILE, TILE).sum((1, 3), dtype=np.float64)


@numba.njit(cache=True)
def accumulate(lines, polarity, inverse_depth, net, total):
    """Add up polarities and numbers of the events in each pixel of the reference view, on a plane at one depth.

    Each event goes to one pixel: spreading an event over its four nearest pixels would smooth the image by an amount
    that depends on the motion.

    Args:
        lines: (5, N) float32 of u0, u1, v0, v1, w: the reference view sees the event at u = u0 + u1 / depth and
            v = v0 + v1 / depth if w / depth < 1; NaN where it is behind the view.
        polarity: (N,) float32 polarities of the events.
        inverse_depth: float32, of the plane.
        net: (height, width) float32, which gets the sums of polarities.
        total: (height, width) float32, which gets the numbers of events.
    """
    net[:] = 0
    total[:] = 0
    height, width = net.shape
    for i in range(lines.shape[1]):
        u = lines[0, i] + lines[1, i] * inverse_depth
        v = lines[2, i] + lines[3, i] * inverse_depth
        # NaN fails this test too.
        if 0 <= u < width and 0 <= v < height and lines[4, i] * inverse_depth < 1:
            net[int(v), int(u)] += polarity[i]
            total[int(v), int(u)] += 1
