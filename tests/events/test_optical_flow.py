"""The optical flow of events against motions that are known."""

import numpy as np
import pytest
from helpers.streams import make_stream

from aenerf_ns.events.optical_flow import optical_flow
from aenerf_ns.events.stream import EventStream

# Pixels per second of the left and of the right half of the image.
VELOCITIES = np.array([[60.0, -20.0], [-30.0, 45.0]])


def moving_dots(width: int, height: int, size: float) -> EventStream:
    """The events of dots of some size that move, the bright ones in front of dark ones."""
    rng = np.random.default_rng(0)
    duration, per_half = 0.15, 40
    columns = []
    for half, velocity in enumerate(VELOCITIES):
        center = rng.uniform([half * width / 2, 0], [(half + 1) * width / 2, height], (per_half, 2))
        sign = rng.choice([-1, 1], per_half)
        for _ in range(40):
            t = rng.uniform(0, duration, per_half)
            place = center + velocity * size * (t - duration / 2)[:, None] + rng.uniform(0, size, (per_half, 2))
            columns.append(np.column_stack([place, t * 1e9, sign]))
    rows = np.concatenate(columns)
    x, y, _, _ = rows.T
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & ((x < width / 2) == (np.arange(len(x)) // 1600 < 1))
    return make_stream(sorted(rows[inside].tolist(), key=lambda row: row[2]), width, height)


@pytest.mark.parametrize(("width", "height", "binning"), [(96, 64, 1), (288, 192, 2)])
def test_every_tile_has_the_velocity_of_its_events(width: int, height: int, binning: int) -> None:
    velocities, side = optical_flow(moving_dots(width, height, float(binning)))
    assert side == 16 * binning
    assert velocities.shape == (-(-height // side), -(-width // side), 2)
    half = width // 2 // side
    for columns, expected in ((slice(0, half), VELOCITIES[0]), (slice(half, 2 * half), VELOCITIES[1])):
        found = velocities[:, columns].reshape(-1, 2) / binning
        # One step of the search is 1.5 pixels in 0.15 seconds.
        assert np.median(np.abs(found - expected), axis=0) == pytest.approx([0, 0], abs=10)


def test_what_does_not_move_has_no_flow() -> None:
    events = moving_dots(96, 64, 1.0)
    still = EventStream(events.x // 8 * 8, events.y // 8 * 8, events.t, events.p, 96, 64)
    velocities, _ = optical_flow(still)
    assert np.median(np.hypot(*velocities.reshape(-1, 2).T)) == 0
    assert not optical_flow(events[:0])[0].any()


def test_the_flow_is_seeded() -> None:
    events = moving_dots(96, 64, 1.0)
    assert np.array_equal(optical_flow(events)[0], optical_flow(events)[0])
