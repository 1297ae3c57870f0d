"""Images of simulated events against the intensity that triggered them."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.reconstruction.batches import EVENTS_PER_PIXEL
from aenerf_ns.reconstruction.high_pass import HighPassFilter
from aenerf_ns.reconstruction.images import FilteredImages, images_of
from aenerf_ns.simulator.esim import EventSimulator

SIZE = 32
STEP = 5_000_000
NUM_FRAMES = 400
SENSOR = SensorModel(0.2, 0.2)


def radiance(index: int) -> NDArray[np.float64]:
    """A smooth random texture that moves past the sensor on a circle."""
    texture = cv2.GaussianBlur(np.random.default_rng(3).normal(size=(96, 96)), (0, 0), 3)
    texture = np.exp(texture / texture.std() * 0.7) * 0.1
    angle = 2 * np.pi * index / 200
    at = 32 + 16 * np.cos(angle), 32 + 16 * np.sin(angle)
    shift = np.float64([[1, 0, -at[0]], [0, 1, -at[1]]])
    return cv2.warpAffine(texture, shift, (SIZE, SIZE), flags=cv2.INTER_LINEAR)


def events() -> Iterator[EventStream]:
    simulator = EventSimulator(SIZE, SIZE, SENSOR)
    for index in range(NUM_FRAMES):
        x, y, t, p = simulator(radiance(index), index * STEP)
        yield EventStream(x, y, t, p, SIZE, SIZE)


def test_image_correlates_with_the_truth() -> None:
    made = HighPassFilter(SIZE, SIZE, SENSOR)
    correlations = []
    for index, part in enumerate(events()):
        made.add(part)
        if index >= 100 and index % 50 == 0:
            found, truth = made.log_intensity(index * STEP), np.log(radiance(index))
            correlations.append(np.corrcoef(found.ravel(), truth.ravel())[0, 1])
    assert len(correlations) == 6
    assert min(correlations) > 0.8


def test_image_is_of_the_last_event() -> None:
    stream = list(events())
    images = list(images_of(stream, int(EVENTS_PER_PIXEL * SIZE**2), FilteredImages(SIZE, SIZE, SENSOR)))
    assert len(images) == sum(map(len, stream)) // 358
    time, image = images[-1]
    truth = np.log(radiance(round(time / STEP)))
    assert np.corrcoef(np.log(image[..., 0].ravel()), truth.ravel())[0, 1] == pytest.approx(0.95, abs=0.05)
    assert (image == image[..., :1]).all()
