"""Images of simulated events against the intensity that triggered them."""

from collections.abc import Iterator

import cv2
import numpy as np
from helpers.streams import make_stream
from numpy.typing import NDArray

from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.reconstruction.batches import EVENTS_PER_PIXEL, batches_of
from aenerf_ns.reconstruction.images import filtered_images
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
        yield simulator(radiance(index), index * STEP)


def test_images_are_those_of_the_light() -> None:
    stream = list(events())
    images = list(filtered_images(batches_of(stream, int(EVENTS_PER_PIXEL * SIZE**2)), SENSOR))
    assert len(images) == sum(map(len, stream)) // 358 > 200
    for time, image in images[100:-60:10]:
        truth = np.log(radiance(round(time / STEP)))
        assert np.corrcoef(np.log(image[..., 0].ravel()), truth.ravel())[0, 1] > 0.9
        assert (image == image[..., :1]).all()


def test_display_values() -> None:
    stream = make_stream([(0, 0, 1, 1), (1, 0, 2, -1), *[(2, 0, 3, 1)] * 9, *[(3, 0, 4, 1)] * 300], 100, 100)
    ((_, image),) = filtered_images(batches_of([stream], len(stream)), SensorModel(0.5, 0.5))
    ratios = (image[0, :2, 0] / image[2, 3, 0]) ** 2.2
    np.testing.assert_allclose(ratios, np.exp([0.5, -0.5]), rtol=0.02)
    assert image[0, 2, 0] == 255
    assert image[2, 3, 0] == round(255 * 0.18 ** (1 / 2.2))


def test_filter_sees_colors() -> None:
    rows = [(x, y, 0, 1 if y % 2 == 0 and x % 2 == 0 else -1) for y in range(6) for x in range(8)]
    stream = make_stream(rows, 8, 6)
    color, gray = (
        next(filtered_images(batches_of([stream], len(stream)), SensorModel(bayer_pattern=pattern)))[1]
        for pattern in ("RGGB", "")
    )
    assert (color[..., 0] > color[..., 1]).all()
    assert (color[..., 1] == color[..., 2]).all()
    assert (gray[..., 0] == gray[..., 2]).all()
