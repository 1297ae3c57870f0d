"""The ratio of the contrast thresholds, against that of simulated sensors."""

import numpy as np
import pytest
from helpers.streams import EventsInMemory, make_stream

from aenerf_ns.checking.thresholds import PolarityBalance
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.simulator.esim import EventSimulator
from aenerf_ns.simulator.options import SENSORS

WIDTH, HEIGHT = 40, 30


def ratio_of(events: EventStream, refractory_period: int) -> tuple[float, float] | None:
    file = EventsInMemory(events)
    balance = PolarityBalance(file, refractory_period)
    for chunk in file.chunks():
        balance.add(chunk)
    return balance.ratio()


@pytest.mark.parametrize("thresholds", [(0.3, 0.2), (0.2, 0.3), (0.25, 0.25)])
@pytest.mark.parametrize("name", ["ideal", "davis346"])
def test_balance_gives_the_ratio(thresholds: tuple[float, float], name: str) -> None:
    model, noise = SENSORS[name]
    simulator = EventSimulator(WIDTH, HEIGHT, SensorModel(*thresholds, model.refractory_period), noise)
    # 2 s of light that changes at random within a factor of 7 every 10 ms.
    light = np.exp(np.random.default_rng(0).uniform(-2, 0, (201, HEIGHT, WIDTH)))
    parts = [simulator(image, 10_000_000 * index) for index, image in enumerate(light)]
    ratio, uncertainty = ratio_of(EventStream.concatenate(parts), model.refractory_period)
    truth = thresholds[0] / thresholds[1]
    assert abs(ratio - truth) < uncertainty < 0.05 * truth


def test_what_moves_once_through_the_picture_tells_no_ratio() -> None:
    # One half of the pixels becomes brighter and does not fall again, and most of the other one becomes darker.
    rows = [
        (x, y, 1000 * k, 1 if x < WIDTH // 2 else -1) for k in range(8) for y in range(HEIGHT) for x in range(WIDTH)
    ]
    rows = [row for row in rows if row[3] > 0 or row[1] % 4]
    ratio, uncertainty = ratio_of(make_stream(rows, WIDTH, HEIGHT), 0)
    assert ratio == pytest.approx(0.73, abs=0.01)
    assert uncertainty > (1 - ratio) / 2


def test_refractory_period_weighs() -> None:
    # An event after an interval of 3 refractory periods stands for 3 / 2 thresholds, and after less than 2 for 2. The
    # first event of a change stands for one.
    times, polarities = [1000, 4000, 5500, 9000, 9100], [1, 1, 1, -1, 1]
    events = make_stream([(0, 0, time, p) for time, p in zip(times, polarities, strict=True)], 1, 1)
    file = EventsInMemory(events)
    np.testing.assert_allclose(PolarityBalance(file, 1000).add(events), [1, 1.5, 2, 1, 1])
    np.testing.assert_array_equal(PolarityBalance(file, 0).add(events), 1)


def test_few_events_give_no_ratio() -> None:
    assert ratio_of(make_stream([(0, 0, time, 1) for time in range(100)]), 0) is None
