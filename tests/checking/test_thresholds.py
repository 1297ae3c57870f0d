"""The ratio of the contrast thresholds, against that of simulated sensors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aenerf_ns.checking.thresholds import PolarityBalance
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.files.event_hdf5 import Hdf5EventFile, Hdf5EventWriter
from aenerf_ns.simulator.esim import EventSimulator
from aenerf_ns.simulator.options import SENSORS, SensorNoise

WIDTH, HEIGHT = 40, 30


def estimate(path: Path, sensor: SensorModel, noise: SensorNoise, refractory_period: int) -> tuple[float, float]:
    """Let a sensor see 2 s of light that changes at random within a factor of 7 every 10 ms, and weigh its events."""
    logs = np.random.default_rng(0).uniform(-2, 0, (201, HEIGHT, WIDTH))
    simulator = EventSimulator(WIDTH, HEIGHT, sensor, noise)
    with Hdf5EventWriter(path) as writer:
        for index, log in enumerate(logs):
            writer.append(EventStream(*simulator(np.exp(log), 10_000_000 * index), WIDTH, HEIGHT))
    file = Hdf5EventFile(path, WIDTH, HEIGHT)
    balance = PolarityBalance(file, refractory_period)
    for chunk in file.chunks():
        balance.add(chunk)
    ratio = balance.ratio()
    assert ratio is not None
    return ratio


@pytest.mark.parametrize("thresholds", [(0.3, 0.2), (0.2, 0.3), (0.25, 0.25)])
@pytest.mark.parametrize("name", ["ideal", "davis346"])
def test_balance_gives_the_ratio(thresholds: tuple[float, float], name: str, tmp_path: Path) -> None:
    model, noise = SENSORS[name]
    sensor = SensorModel(*thresholds, model.refractory_period)
    ratio, uncertainty = estimate(tmp_path / "events.h5", sensor, noise, sensor.refractory_period)
    truth = thresholds[0] / thresholds[1]
    assert abs(ratio - truth) < uncertainty < 0.05 * truth


def test_refractory_period_weighs(tmp_path: Path) -> None:
    # An event after an interval of 3 refractory periods stands for 3 / 2 thresholds, and after less than 2 for 2. The
    # first event of a change stands for one.
    columns = [0, 0, 0, 0, 0], [0, 0, 0, 0, 0], [1000, 4000, 5500, 9000, 9100], [1, 1, 1, -1, 1]
    x, y, t, p = (np.array(column) for column in columns)
    events = EventStream(x.astype(np.uint16), y.astype(np.uint16), t.astype(np.int64), p.astype(np.int8), 1, 1)

    with Hdf5EventWriter(tmp_path / "events.h5") as writer:
        writer.append(events)
    file = Hdf5EventFile(tmp_path / "events.h5", 1, 1)
    np.testing.assert_allclose(PolarityBalance(file, 1000).add(events), [1, 1.5, 2, 1, 1])
    np.testing.assert_array_equal(PolarityBalance(file, 0).add(events), 1)


def test_few_events_give_no_ratio(tmp_path: Path) -> None:
    with Hdf5EventWriter(tmp_path / "events.h5") as writer:
        zeros = np.zeros(100, np.uint16)
        writer.append(EventStream(zeros, zeros, np.arange(100), np.ones(100, np.int8), WIDTH, HEIGHT))
    file = Hdf5EventFile(tmp_path / "events.h5", WIDTH, HEIGHT)
    balance = PolarityBalance(file, 0)
    for chunk in file.chunks():
        balance.add(chunk)
    assert balance.ratio() is None
