"""Images of events, smoothed and with the edges found, in tiles: what contrast is computed from."""

from __future__ import annotations

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


def tile_contrast(net: NDArray[np.float32], total: NDArray[np.float32]) -> tuple[NDArray, NDArray]:
    """Return the (R, C) squared contrasts of the tiles, less that of noise, and their (R, C) squared brightness.

    Args:
        net: (height, width) sums of polarities.
        total: (height, width) numbers of events.
    """
    coarse, edges = _smooth(total), _edges(net)
    return _tile_sums(edges * edges - _noise_energy() * coarse), _tile_sums(coarse * coarse)


def best_of(energies: NDArray[np.float64], brightnesses: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return for each tile which of several warps gives it the most contrast.

    Args:
        energies: (warps, R, C) squared contrasts.
        brightnesses: (warps, R, C) squared brightnesses.

    Returns:
        (R, C) indices. The first of equally good warps is taken.
    """
    # With the ratio alone, tiles would choose the warp that leaves them empty.
    return (energies / (brightnesses + brightnesses.mean() + 1e-12)).argmax(0)


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
