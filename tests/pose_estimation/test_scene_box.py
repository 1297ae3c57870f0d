"""The box around what the camera goes around."""

from __future__ import annotations

import numpy as np
import pytest

from aenerf_ns.pose_estimation.bundle_adjustment import Tracks
from aenerf_ns.pose_estimation.scene_box import box_around
from aenerf_ns.simulator.paths import look_at


def look_around(radius: float, turn: float) -> np.ndarray:
    """(20, 3, 4) poses on a part of a circle around the origin, in radians."""
    angles = np.linspace(0, turn, 20)
    return np.stack([look_at((radius * np.cos(a), radius * np.sin(a), 0.4), (0.0, 0.0, 0.0))[:3] for a in angles])


def tracks(num_wrong: int = 0) -> Tracks:
    """Tracks of 2000 points in the cube of side 2, seen four times each. Half of those far out are seen once."""
    positions = np.random.default_rng(0).uniform(-1, 1, (2000, 3))
    positions[:num_wrong] *= 100
    points = np.repeat(np.arange(2000), np.where(np.arange(2000) < num_wrong // 2, 1, 4))
    return Tracks(np.zeros(len(points), np.int64), points, np.zeros((len(points), 2)), positions, 100.0)


@pytest.mark.parametrize("num_wrong", [0, 30])
def test_the_box_holds_what_is_seen_and_little_more(num_wrong: int) -> None:
    box = box_around(tracks(num_wrong), look_around(3.0, 2 * np.pi))
    assert box is not None
    np.testing.assert_allclose(box, [[-1.19] * 3, [1.19] * 3], atol=0.03)


@pytest.mark.parametrize(
    ("radius", "turn"),
    [
        pytest.param(0.5, 6.0, id="within"),
        pytest.param(1.1, 6.0, id="passing the margin"),
        pytest.param(3.0, 1.4, id="from one side"),
    ],
)
def test_no_box_where_the_camera_does_not_go_around(radius: float, turn: float) -> None:
    assert box_around(tracks(), look_around(radius, turn)) is None
