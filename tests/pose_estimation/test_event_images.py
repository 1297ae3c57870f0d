"""Images of the events that poses are estimated from."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from helpers.streams import EventsInMemory

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.pose_estimation import event_images
from aenerf_ns.pose_estimation.event_images import images_of_events
from aenerf_ns.recording.recording import Capture
from aenerf_ns.simulator.esim import EventSimulator

WIDTH, HEIGHT = 64, 48
# Pixels that the picture moves from one frame to the next, and in all frames.
STEP, LENGTH = 0.25, 300


def slide(threshold: float) -> Capture:
    """Move a texture past a sensor with these contrast thresholds, by one pixel a millisecond."""
    texture = cv2.GaussianBlur(np.random.default_rng(0).random((HEIGHT, WIDTH + LENGTH)), (0, 0), 1.5)
    texture = 0.05 + 0.9 * (texture - texture.min()) / np.ptp(texture)
    sensor = SensorModel(threshold, threshold)
    simulator = EventSimulator(WIDTH, HEIGHT, sensor)
    pieces = []
    for moved in np.arange(0, LENGTH, STEP):
        frame = cv2.warpAffine(texture, np.array([[1, 0, -moved], [0, 1, 0]]), (WIDTH, HEIGHT))
        pieces.append(simulator(frame, round(moved * 1e6)))
    camera = CameraIntrinsics(WIDTH, HEIGHT, 60.0, 60.0, WIDTH / 2, HEIGHT / 2)
    return Capture(EventsInMemory(EventStream.concatenate(pieces)), camera, sensor, camera, "linear")


@pytest.mark.parametrize(("threshold", "pixels"), [(0.2, 3.6), (0.4, 4.8)])
def test_images_of_any_sensor_lie_near_each_other(threshold: float, pixels: float) -> None:
    # One event per pixel comes with 3.6 and with 11.9 pixels of motion.
    times, _ = images_of_events(slide(threshold), TimeWindow(None, None))
    assert np.diff(times).mean() / 1e6 == pytest.approx(pixels, abs=0.2)


def test_what_stands_still_matches_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Match three pictures that move by 6 pixels above a ghost that stands still, and one of another place."""
    textures = [cv2.GaussianBlur(np.random.default_rng(seed).random((120, 180)), (0, 0), 1.5) for seed in range(3)]
    scene, ghost, other = (np.uint8(255 * (one - one.min()) / np.ptp(one)) for one in textures)
    pictures = [np.vstack([scene[:60, 6 * i :][:, :160], ghost[60:, :160]]) for i in range(3)] + [other[:, :160]]
    monkeypatch.setattr(event_images, "images_of_events", lambda *_: (np.arange(4), pictures))
    camera = CameraIntrinsics(160, 120, 150.0, 150.0, 80.0, 60.0)
    capture = SimpleNamespace(event_camera=camera, intrinsics_origin="given")
    with event_images.match_event_images(capture, TimeWindow(), "made", 0, None, None) as (workspace, _, _):
        features, pairs = workspace.count_features_and_pairs()
        workspace.hold_out_matches(1.1)
        matches = workspace.held_out
    assert features > 100
    assert pairs == len(matches) == 3
    for (first, second), (here, there) in matches:
        assert len(here) > 30
        moved = 150 * np.linalg.norm(here - there, axis=1)
        assert moved.min() >= 0.5
        assert np.median(moved) == pytest.approx(6 * (second - first), abs=0.01)
