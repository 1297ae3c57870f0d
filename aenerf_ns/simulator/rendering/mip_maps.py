"""Mip-mapped lookup in pictures of any size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.simulator.rendering.vectors import length


class MipMaps(NamedTuple):
    """Pictures and their successive halvings, L levels in all, stored one after the other."""

    texels: NDArray  # (M, 3) uint16 or float32
    level: NDArray[np.int64]  # (L, 3) first texel, rows and columns
    first_level: NDArray[np.int64]  # (pictures + 1,)


def mip_maps(pictures: Sequence[NDArray[np.float32]], bits16: bool) -> MipMaps:
    """Build mip maps of pictures (rows, columns, 3). Every level keeps the mean of its picture, to a thousandth.

    With ``bits16``, values are stored as 16-bit integers, clipped to [0, 1], which halves the memory.
    """
    kind = np.uint16 if bits16 else np.float32
    texels: list[NDArray] = [np.zeros((0, 3), kind)]
    level, first_level, start = [], [0], 0
    for picture in pictures:
        while True:
            rows, columns = picture.shape[:2]
            stored = np.rint(picture.clip(0, 1) * 65535) if bits16 else picture
            texels.append(stored.astype(kind).reshape(-1, 3))
            level.append((start, rows, columns))
            start += rows * columns
            if rows == columns == 1:
                break
            half = (max(1, columns // 2), max(1, rows // 2))
            halved = cv2.resize(picture, half, interpolation=cv2.INTER_AREA)
            picture = np.asarray(halved, np.float32).reshape(half[1], half[0], -1)
        first_level.append(len(level))
    return MipMaps(np.concatenate(texels), np.array(level, np.int64).reshape(-1, 3), np.array(first_level, np.int64))


@numba.njit(cache=True, error_model="numpy")
def lookup(maps, picture, u, v, footprint, repeats):
    """Interpolate a picture at (u, v), in widths and heights of the picture, trilinearly.

    ``footprint`` is the side of the region to average, in texels of the finest level. Columns repeat. Rows repeat too
    if ``repeats``; otherwise the first and the last row extend to infinity.
    """
    first, last = maps.first_level[picture], maps.first_level[picture + 1] - 1
    detail = min(math.log2(max(footprint, 1.0)), float(last - first))
    base = int(detail)
    red, green, blue = 0.0, 0.0, 0.0
    for step in range(2):
        weight = 1.0 - abs(detail - (base + step))
        if weight <= 0.0:
            continue
        start, rows, columns = maps.level[first + base + step]
        x, y = (u - math.floor(u)) * columns - 0.5, v * rows - 0.5
        if repeats:
            y = (v - math.floor(v)) * rows - 0.5
        i, j = int(math.floor(x)), int(math.floor(y))
        fx, fy = x - i, y - j
        left, right = (columns - 1 if i < 0 else i), (0 if i + 1 >= columns else i + 1)
        if repeats:
            low, high = (rows - 1 if j < 0 else j), (0 if j + 1 >= rows else j + 1)
        else:
            low, high = max(0, min(j, rows - 1)), max(0, min(j + 1, rows - 1))
        low, high = start + low * columns, start + high * columns
        a, b = weight * (1.0 - fx) * (1.0 - fy), weight * fx * (1.0 - fy)
        c, d = weight * (1.0 - fx) * fy, weight * fx * fy
        texels = maps.texels
        for texel, part in ((low + left, a), (low + right, b), (high + left, c), (high + right, d)):
            red += part * texels[texel, 0]
            green += part * texels[texel, 1]
            blue += part * texels[texel, 2]
    return red, green, blue


@numba.njit(cache=True, error_model="numpy")
def panorama(maps, direction, footprint):
    """Interpolate an equirectangular picture (see `Panorama`) in a direction of any length."""
    turn = math.atan2(direction[1], direction[0]) / (2.0 * math.pi)
    down = math.acos(max(-1.0, min(1.0, direction[2] / length(direction)))) / math.pi
    return lookup(maps, 0, 0.5 - turn, down, footprint, False)
