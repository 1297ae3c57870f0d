"""The bandwidth of a sensor, from its events and the frames between which they lie."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from PIL import Image

from aenerf_ns.camera.image_encoding import decode
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.checking.frames import FrameChanges
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.simulator.esim import EventSimulator
from aenerf_ns.simulator.options import SensorNoise

WIDTH, HEIGHT = 40, 30


@pytest.mark.parametrize("bandwidth", [None, 100.0])
def test_frames_tell_the_bandwidth(tmp_path: Path, bandwidth: float | None) -> None:
    # Smooth patches from dark to bright that move by a pixel in 4 ms, there and back.
    coarse = np.random.default_rng(0).uniform(-3, 0, (HEIGHT // 5 + 1, 40))
    texture = cv2.resize(coarse, (200, HEIGHT))
    sensor = SensorModel(0.1, 0.1, 100_000)
    simulator = EventSimulator(WIDTH, HEIGHT, sensor, SensorNoise(bandwidth=bandwidth))
    parts, frames = [], []
    for millisecond in range(600):
        shift = abs(300 - millisecond) / 4
        positions = np.arange(WIDTH) + shift
        picture = np.exp([np.interp(positions, np.arange(200), row) for row in texture])
        parts.append(simulator(picture, 1_000_000 * millisecond))
        if millisecond % 40 == 30:
            levels = np.searchsorted(decode((np.arange(255) + 0.5) / 255, "srgb"), picture).astype(np.uint8)
            frames.append((1_000_000 * millisecond, tmp_path / f"{millisecond}.png"))
            Image.fromarray(levels).save(frames[-1][1])
    camera = CameraIntrinsics(WIDTH, HEIGHT, 40.0, 40.0, 20.0, 15.0)
    capture = SimpleNamespace(sensor=sensor, event_camera=camera, has_own_frames=True, image_encoding="srgb")
    changes = FrameChanges(capture, frames, TimeWindow())
    events = EventStream.concatenate(parts)
    for chunk in (events[:3000], events[3000:]):
        changes.add(chunk, np.ones(len(chunk)))
    found = changes.bandwidth(1.0)
    if bandwidth is None:
        assert found is None
    else:
        assert found is not None
        value, low, high = found
        assert low <= value <= high
        assert value == pytest.approx(simulator.recorded_sensor().bandwidth, rel=0.2)


def test_a_pixel_of_a_color_sensor_is_compared_with_its_own_channel(tmp_path: Path) -> None:
    # Red becomes brighter by a quarter, and blue darker. A pixel of either fires for the change behind its filter.
    before = np.full((HEIGHT, WIDTH, 3), (100, 100, 125), np.uint8)
    frames = [(0, tmp_path / "0.png"), (1_000_000, tmp_path / "1.png")]
    for (_, file), picture in zip(frames, (before, before[..., ::-1]), strict=True):
        Image.fromarray(np.ascontiguousarray(picture)).save(file)
    camera, sensor = CameraIntrinsics(WIDTH, HEIGHT, 40.0, 40.0, 20.0, 15.0), SensorModel(0.1, 0.1, 0, "RGGB")
    capture = SimpleNamespace(sensor=sensor, event_camera=camera, has_own_frames=True, image_encoding="linear")
    other = SimpleNamespace(**vars(capture) | {"has_own_frames": False})
    assert FrameChanges(other, frames, TimeWindow()).correlation() is None
    changes = FrameChanges(capture, frames, TimeWindow())
    rows, columns = np.nonzero(sensor.channels(WIDTH, HEIGHT) != 1)
    polarities = (1 - sensor.channels(WIDTH, HEIGHT)[rows, columns]).astype(np.int8)
    x, y = columns.astype(np.uint16), rows.astype(np.uint16)
    changes.add(EventStream(x, y, np.full(len(x), 500_000), polarities, WIDTH, HEIGHT), np.ones(len(x)))
    assert changes.correlation() == pytest.approx(1)
    assert changes.negative_threshold(1.0)[0] == pytest.approx(np.log(1.25), rel=0.05)
