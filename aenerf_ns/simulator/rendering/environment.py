"""Light from far away: a sky, or a panorama."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike

from aenerf_ns.errors import DataError, reading
from aenerf_ns.files.limits import require_at_most, require_file
from aenerf_ns.pose_estimation.video import silent_opencv
from aenerf_ns.simulator.arrays import Array, Panorama

# 16384 x 8192 pixels, uncompressed.
_MAX_BYTES = 1 << 29
_COARSE_ROWS = 32
_SKY_ROWS = 512
_BRIGHT = 4.0
"""Radiance above this multiple of the mean (the sun, lamps, windows) is sampled separately."""


def split(radiance: Panorama) -> tuple[Panorama, Panorama]:
    """Split an environment into an even part and a bright part, which add up to the whole.

    The even part is halved to at most 32 rows, as long as its sides are even.

    Sampling a light of a few texels like the sky gives noise, and sampling the sky like the sun takes many samples, so
    each part is sampled in its own way.
    """
    solid_angle = row_weights(len(radiance))[:, None]
    luminance = radiance.mean(axis=-1)
    mean = float((luminance * solid_angle).sum() / solid_angle.sum() / luminance.shape[1])
    even = np.minimum(1.0, _BRIGHT * mean / np.maximum(luminance, 1e-12))[..., None] * radiance
    coarse = even
    while len(coarse) > _COARSE_ROWS and len(coarse) % 2 == 0 and coarse.shape[1] % 2 == 0:
        weight = row_weights(len(coarse)).reshape(-1, 2, 1, 1)
        rows = (coarse.reshape(-1, 2, *coarse.shape[1:]) * weight).sum(axis=1) / weight.sum(axis=1)
        coarse = 0.5 * (rows[:, 0::2] + rows[:, 1::2])
    return coarse.astype(np.float32), (radiance - even).astype(np.float32)


def row_weights(rows: int) -> Array:
    """Return the solid angle (rows,) of each row, up to a factor."""
    return -np.diff(np.cos(np.pi * np.arange(rows + 1) / rows))


def sky(nadir: ArrayLike, zenith: ArrayLike) -> Panorama:
    """Make a sky whose radiance is linear in the direction's height, from ``nadir`` (3,) to ``zenith`` (3,)."""
    up = 0.5 + 0.5 * np.cos(np.pi * (np.arange(_SKY_ROWS) + 0.5) / _SKY_ROWS)[:, None]
    column = (1 - up) * np.asarray(nadir, np.float64) + up * np.asarray(zenith, np.float64)
    return np.repeat(column[:, None].astype(np.float32), 2, axis=1)


def load_environment(path: Path, turn_degrees: float = 0.0, gain: float = 1.0) -> Panorama:
    """Read a Radiance .hdr panorama.

    Turn it by ``turn_degrees`` about the vertical, counterclockwise seen from above, and scale its light by ``gain``.

    Raises:
        DataError: the file is missing or is not a panorama.
    """
    require_file(path, "put it there, or correct its name")
    with reading(path):
        require_at_most(path, _MAX_BYTES)
        with path.open("rb") as file:
            begin = file.read(2)
    picture = None
    with silent_opencv(), suppress(cv2.error):
        # It is read from the file, because imdecode leaves temporary files behind for pictures that are too large.
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if begin == b"#?" else None
    if picture is None or picture.ndim != 3 or picture.dtype != np.float32:
        raise DataError(path, "not a Radiance picture", "give an equirectangular .hdr file")
    rows, columns = picture.shape[:2]
    if columns != 2 * rows:
        raise DataError(path, f"{columns} x {rows} pixels", "give an equirectangular .hdr, twice as wide as high")
    if not np.isfinite(picture).all() or picture.min() < 0 or picture.max() == 0:
        raise DataError(path, "radiance that is negative, infinite, or nowhere positive", "give another picture")
    if (brightest := gain * picture.max()) >= 1e12:
        raise DataError(path, f"its light times the gain of {gain:g} is {brightest:.3g}", "give a smaller gain")
    radiance = gain * picture[..., 2::-1]
    # A counterclockwise turn moves the content at +x towards +y, which is to the left.
    shift = turn_degrees / 360.0 * columns
    whole, part = int(np.floor(shift)), shift - np.floor(shift)
    radiance = (1 - part) * np.roll(radiance, -whole, axis=1) + part * np.roll(radiance, -whole - 1, axis=1)
    return np.ascontiguousarray(radiance, np.float32)
