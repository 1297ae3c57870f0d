"""Images of a stream of events, one for each batch."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from aenerf_ns.events.sensor import BayerPattern, SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.reconstruction.batches import normalize, voxel_grid
from aenerf_ns.reconstruction.networks import E2VID, NUM_BINS, FireNet
from aenerf_ns.reconstruction.two_sided import log_intensities

# Of the filter. In a room 0.03 to 0.06 come closest to the true images; at an object less is a little better still.
_DECAY = 0.05
# Radiance of a pixel that has not changed, as a share of display white: the photographers' middle gray.
_MIDDLE_GRAY = 0.18
# A state times this power is a display value. Then log-radiance is an exact multiple of the display value's logarithm.
_DISPLAY_POWER = 1 / 2.2
# The authors of the networks sharpen images: by this amount, with a blur of this standard deviation and size in pixels.
_SHARPENING, _BLUR, _BLUR_SIZE = 0.3, 1.0, 5


ImageSource = Callable[[Iterable[EventStream]], Iterator[tuple[int, NDArray[np.uint8]]]]
"""Yields for each batch of a stream the time in nanoseconds and the (height, width, 3) RGB display values, gray for a
monochrome sensor."""


def filtered_images(
    batches: Iterable[EventStream], sensor: SensorModel, drift: NDArray[np.float32] | None = None
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield images without a network; see :data:`ImageSource`.

    A display value is (0.18 exp(s))^(1 / 2.2), clipped to [0, 1], times 255, of a change of log-intensity s
    (:func:`~aenerf_ns.reconstruction.two_sided.log_intensities`).

    Args:
        batches: the stream in consecutive pieces.
        sensor: contrast thresholds and Bayer pattern.
        drift: (height, width), how the thresholds of the pixels differ.
    """
    pattern = sensor.bayer_pattern
    for time, state in log_intensities(batches, sensor, _DECAY, drift):
        # Not above display white, where the exponential of a hot pixel would overflow.
        log_radiance = np.minimum(state + math.log(_MIDDLE_GRAY), 0)
        values = np.rint(np.exp(_DISPLAY_POWER * log_radiance) * 255).astype(np.uint8)
        yield time, demosaic(values, pattern) if pattern else _gray_to_rgb(values)


class NetworkImages:
    """Images of a network, which sees a normalized voxel grid of each batch.

    The events of a color sensor go through the network five times, each time with a state of its own: the four
    half-resolution grids of its filters, whose images give the colors, and the whole grid, which gives the lightness.

    Args:
        network: with its weights.
        sensor: the Bayer pattern.
        device: that the network runs on.
    """

    def __init__(self, network: E2VID | FireNet, sensor: SensorModel, device: torch.device | str) -> None:
        self._network = network.to(device)
        self._pattern = sensor.bayer_pattern
        self._device = device
        self._states: dict[str, Any] = {}

    def __call__(self, batches: Iterable[EventStream]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield the images, each of the last event of its batch; see :data:`ImageSource`."""
        for batch in batches:
            yield int(batch.t[-1]), self._image(batch)

    def _image(self, events: EventStream) -> NDArray[np.uint8]:
        voxels = normalize(voxel_grid(events, NUM_BINS))
        gray = self._run("all", voxels)
        if not self._pattern:
            return _gray_to_rgb(gray)
        mosaic = np.empty_like(gray)
        for row in range(2):
            for column in range(2):
                mosaic[row::2, column::2] = self._run(f"{row}{column}", voxels[:, row::2, column::2])
        return _replace_lightness(demosaic(mosaic, self._pattern), gray)

    @torch.no_grad()
    def _run(self, name: str, voxels: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Return the (height, width) image of (bins, height, width) voxels that follow those of the same name."""
        height, width = voxels.shape[1:]
        lacking = [-size % self._network.multiple for size in (height, width)]
        # The authors put the larger part of an odd padding in front.
        padding = [(number - number // 2, number // 2) for number in lacking]
        padded = torch.from_numpy(np.pad(voxels, [(0, 0), *padding], mode="reflect"))[None].to(self._device)
        image, self._states[name] = self._network(padded, self._states.get(name))
        (top, _), (left, _) = padding
        values = image[0, 0, top : top + height, left : left + width].float().cpu().numpy()
        blurred = cv2.GaussianBlur(values, (_BLUR_SIZE, _BLUR_SIZE), _BLUR)
        sharpened = (1 + _SHARPENING) * values - _SHARPENING * blurred
        return np.rint(np.clip(sharpened, 0, 1) * 255).astype(np.uint8)


def demosaic(mosaic: NDArray[np.uint8], pattern: BayerPattern) -> NDArray[np.uint8]:
    """Interpolate the (height, width, 3) RGB picture of a (height, width) mosaic of a Bayer pattern linearly."""
    return np.asarray(cv2.cvtColor(mosaic, getattr(cv2, f"COLOR_Bayer{pattern}2RGB")), np.uint8)


def _replace_lightness(picture: NDArray[np.uint8], gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Give a (height, width, 3) RGB picture the lightness (CIELAB's L) of a (height, width) gray one."""
    lab = cv2.cvtColor(picture, cv2.COLOR_RGB2LAB)
    lab[..., 0] = cv2.cvtColor(_gray_to_rgb(gray), cv2.COLOR_RGB2LAB)[..., 0]
    return np.asarray(cv2.cvtColor(lab, cv2.COLOR_LAB2RGB), np.uint8)


def _gray_to_rgb(values: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.repeat(values[..., None], 3, -1)
