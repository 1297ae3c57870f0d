"""The high-pass filter against its closed form."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.streams import make_stream

from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.reconstruction.high_pass import HighPassFilter

EPOCH = 1_600_000_000_000_000_000
SECOND = 1_000_000_000


@pytest.mark.parametrize(
    ("cutoff", "per_event", "expected"), [(0.06, 0.06, 0.191870), (6.28, 0.0, -0.008299), (0.0, 0.0, 0.25)]
)
def test_worked_case(cutoff: float, per_event: float, expected: float) -> None:
    made = HighPassFilter(4, 3, SensorModel(0.25, 0.25), cutoff, per_event)
    events = [(2, 1, EPOCH + t * SECOND // 10, p) for t, p in ((1, 1), (2, 1), (5, -1))]
    # The state goes on from one piece of the stream to the next.
    made.add(make_stream(events[:1]))
    made.add(make_stream(events[1:]))
    found = made.log_intensity(EPOCH + SECOND)
    assert found[1, 2] == pytest.approx(expected, abs=5e-7)
    assert np.count_nonzero(found) == 1


def test_state_is_a_sum_of_exponentials() -> None:
    rng = np.random.default_rng(0)
    times = EPOCH + np.sort(rng.integers(0, SECOND, 300))
    rows = [(*rng.integers(0, (4, 3)), t, p) for t, p in zip(times, rng.choice([-1, 1], 300), strict=True)]
    positive, negative, cutoff, per_event = 0.3, 0.2, 2.0, 0.1
    made = HighPassFilter(4, 3, SensorModel(positive, negative), cutoff, per_event)
    made.add(make_stream(rows))
    end = EPOCH + SECOND
    expected = np.zeros((3, 4))
    for index, (x, y, t, p) in enumerate(rows):
        later = sum((other[0], other[1]) == (x, y) for other in rows[index + 1 :])
        step = positive if p > 0 else -negative
        expected[y, x] += step * np.exp(-cutoff * (end - t) / SECOND - per_event * later)
    np.testing.assert_allclose(made.log_intensity(end), expected, rtol=0, atol=1e-12)


def test_display_values() -> None:
    made = HighPassFilter(4, 3, SensorModel(0.5, 0.5), 0.0, 0.0)
    image = made.image(make_stream([(0, 0, 1, 1), (1, 0, 2, -1), *[(2, 0, 3, 1)] * 9]))
    ratios = (image[0, :2] / image[2, 3]) ** 2.2
    np.testing.assert_allclose(ratios, np.exp([0.5, -0.5]), rtol=0.02)
    assert image[0, 2] == 255
    assert image[2, 3] == round(255 * 0.18 ** (1 / 2.2))
