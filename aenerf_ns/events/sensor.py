"""The event sensor model: contrast thresholds, refractory period, bandwidth and Bayer pattern."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError

BayerPattern = Literal["", "RGGB", "BGGR", "GRBG", "GBRG"]


# The radiance that a dark pixel seems to see where its bandwidth is concerned, over the mean one: v2e's 20 / 255 of
# white, for a recording whose mean is 0.4 of white.
_DARK_RADIANCE = 0.2

# The largest event sensors have 1 million pixels. The directions of so many pixels take 0.5 GB for a moment.
_MAX_PIXELS = 1 << 22
# Real thresholds are 0.05 to 1. Only their ratio matters, so other units than log-radiance are accepted too.
_THRESHOLDS = (1e-4, 1e3)
# Nanoseconds. Refractory periods are microseconds to milliseconds long.
_MAX_REFRACTORY_PERIOD = 10**12
# Hertz. Photoreceptors follow 1 Hz to 10 kHz. More stands for pixels that follow at once.
_BANDWIDTHS = (1e-6, 1e15)
# Over the mean radiance. An edge in an image of the events lags as a pixel of this radiance does: the dark side of an
# edge lags more, but fires fewer events.
_EDGE_RADIANCE = 2.0


@dataclass(frozen=True)
class SensorModel:
    """The sensor model: how a pixel turns log-radiance into events (paper, eq. 5).

    Attributes:
        positive_contrast_threshold: C+, the rise of log-radiance that triggers an event of polarity +1.
        negative_contrast_threshold: C−, the fall of log-radiance (a positive number) that triggers one of polarity −1.
        refractory_period: τ in nanoseconds. A pixel is blind for this time after each of its events.
        bayer_pattern: the color filters of the first two pixels of the first row and of the second, "RGGB" where pixel
            (0, 0) is red; "" for a monochrome sensor.
        bandwidth: cutoff frequency in Hz of the low-pass filter through which a pixel sees log-radiance, for a pixel
            that sees the recording's mean radiance. 0 if it is not known: pixels are then taken to follow at once.

    Raises:
        ValueError: a threshold is below 1e-4 or above 1e3, the refractory period is negative or beyond 1000 s, the
            bandwidth is neither 0 nor from 1e-6 to 1e15 Hz, or the pattern is unknown.
    """

    positive_contrast_threshold: float = 0.25
    negative_contrast_threshold: float = 0.25
    refractory_period: int = 0
    bayer_pattern: BayerPattern = ""
    bandwidth: float = 0.0

    def __post_init__(self) -> None:
        for name in ("positive_contrast_threshold", "negative_contrast_threshold"):
            low, high = _THRESHOLDS
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} must be from {low:g} to {high:g}, not {getattr(self, name):g}")
        if not 0 <= self.refractory_period <= _MAX_REFRACTORY_PERIOD:
            raise ValueError(
                f"refractory_period must be from 0 to {_MAX_REFRACTORY_PERIOD:g} ns, not {self.refractory_period:g}"
            )
        low, high = _BANDWIDTHS
        if self.bandwidth != 0 and not low <= self.bandwidth <= high:
            raise ValueError(f"bandwidth must be 0, or from {low:g} to {high:g} Hz, not {self.bandwidth:g}")
        if self.bayer_pattern not in get_args(BayerPattern):
            known = ", ".join(f'"{pattern}"' for pattern in get_args(BayerPattern))
            raise ValueError(f'bayer_pattern must be one of {known}, not "{self.bayer_pattern}"')

    @property
    def num_channels(self) -> int:
        """Number of radiance channels the sensor sees: 1 for a monochrome sensor, 3 for a color one."""
        return 3 if self.bayer_pattern else 1

    def time_constant(self, radiance: Any) -> Any:
        """Return the seconds by which the pixels' low-pass filter lags, given radiances over their mean."""
        return (1 + _DARK_RADIANCE) / (2 * math.pi * self.bandwidth * (radiance + _DARK_RADIANCE))

    @property
    def image_lag(self) -> int:
        """Nanoseconds from the light to the image of the events that shows it; 0 without a bandwidth."""
        return round(1e9 * self.time_constant(_EDGE_RADIANCE)) if self.bandwidth > 0 else 0

    def channels(self, width: int, height: int) -> NDArray[np.int64]:
        """Return the (height, width) radiance channels that the filters of raw pixels pass: 0 red, 1 green, 2 blue; 0
        for all pixels of a monochrome sensor."""
        colors = np.array(["RGB".index(color) for color in self.bayer_pattern or "RRRR"]).reshape(2, 2)
        return np.tile(colors, (-(-height // 2), -(-width // 2)))[:height, :width]


def sensor_values(stated: object) -> dict[str, Any]:
    """Return by their names in :class:`SensorModel` the values that an event camera, or the options, state: those
    attributes of the same names, ``refractory_period_ns`` and ``bandwidth_hz``, that are not None."""
    names = {field.name: field.name for field in fields(SensorModel)}
    names |= {"refractory_period": "refractory_period_ns", "bandwidth": "bandwidth_hz"}
    values = {name: getattr(stated, key, None) for name, key in names.items()}
    return {name: value for name, value in values.items() if value is not None}


def states_thresholds(stated: object) -> bool:
    """Return whether an event camera, or the options, state a contrast threshold."""
    return any(name.endswith("contrast_threshold") for name in sensor_values(stated))


def require_event_sensor_size(
    width: int, height: int, source: str | Path, remedy: str = "give the size of the sensor"
) -> None:
    """Raise a DataError for a number of pixels that no event sensor has, before anything of that size is allocated."""
    if width * height > _MAX_PIXELS:
        problem = f"an event sensor of {width} x {height} pixels is too large"
        raise DataError(source, problem, f"{remedy}, at most {_MAX_PIXELS:,} pixels")
