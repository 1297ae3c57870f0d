"""Pairs of events: the rays and counts of a batch on small exact cases."""

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.small_models import CAMERA, EPOCH, make_batch, make_correction, make_sampler
from helpers.streams import make_stream

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.errors import DataError
from aenerf_ns.events.polarity_drift import PolarityDrift
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.simulator.esim import EventSimulator
from aenerf_ns.simulator.options import SensorNoise
from aenerf_ns.supervision.base import ChangeSupervision
from aenerf_ns.supervision.event_pairs import PairLossCoefficients, PairSupervisionConfig


def test_rays_lie_at_both_ends_of_each_interval(random_poses: torch.Tensor) -> None:
    sensor = SensorModel(refractory_period=1_000)
    sampler = make_sampler(random_poses, sensor)
    rays, batch = sampler.sample(40)
    make_correction(sampler.pixel_rays.trajectory, mode="off").apply_to_raybundle(rays)
    assert rays.origins.shape == (40, 3)
    assert rays.directions.dtype == torch.float32
    starts, ends = (torch.round(rays.times[:, 0] * 1e9).long() + EPOCH).chunk(2)
    pixel_directions, _ = CAMERA.pixel_directions()
    known = {
        (EPOCH + 6_000, EPOCH + 250_000_000): ((3, 1), -1),
        (EPOCH + 101_000, EPOCH + 600_000_000): ((0, 2), -1),
        (EPOCH + 250_001_000, EPOCH + 10**9): ((3, 1), 1),
    }
    seen = set()
    for i, interval in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
        (x, y), polarity = known[interval]
        seen.add(interval)
        assert batch.num_positive[i] - batch.num_negative[i] == polarity
        for ray, time in ((i, interval[0]), (i + 20, interval[1])):
            pose = sampler.pixel_rays.trajectory.interpolate(time)
            torch.testing.assert_close(rays.origins[ray], pose[:, 3].float())
            direction = pose[:, :3] @ torch.from_numpy(pixel_directions[y, x])
            torch.testing.assert_close(rays.directions[ray], direction.float(), rtol=0, atol=1e-6)
    assert seen == set(known)


def test_a_pair_spans_several_events(random_poses: torch.Tensor) -> None:
    sampler = make_sampler(random_poses, SensorModel(), max_events_per_pair=3)
    rays, batch = sampler.sample(8000)
    starts, ends = torch.round(rays.times[:, 0] * 1e9).long().chunk(2)
    columns = (starts, ends, batch.num_positive, batch.num_negative, batch.last_num_negative, batch.last_interval)
    rows = np.stack([column.numpy() for column in columns], -1).round(6)
    # All that end with an event of their pixel, never beyond its first.
    found = Counter(map(tuple, rows.tolist()))
    one, two = (250_000_000, 10**9, 1, 0, 0, 0.75), (5_000, 10**9, 1, 1, 0, 0.75)
    assert found.keys() == {(100_000, 600_000_000, 0, 1, 1, 0.5999), (5_000, 250_000_000, 0, 1, 1, 0.249995), one, two}
    # One event in half of the cases: log 2 / log 4.
    assert found[one] / found[two] == pytest.approx(1, abs=0.2)


def test_pairs_count_less_the_more_their_pixel_misses(random_poses: torch.Tensor) -> None:
    # The middle one of a pixel's three events is 250 ms after the first, 750 ms before the last.
    sensor = SensorModel(refractory_period=62_500_000)
    _, batch = make_sampler(random_poses, sensor, max_events_per_pair=3).sample(400)
    longer = batch.num_positive + batch.num_negative > 1
    assert longer.any()
    assert not longer.all()
    # The rates before and after it are -1 / 187.5 ms and 1 / 687.5 ms, so -1 / 275 ms in the middle of its blindness:
    # the pixel misses 0.23 thresholds. One eighth counts here. The rest counts after the next event.
    assert (batch.num_positive[longer] == 1).all()
    assert (batch.num_negative[longer] == 1.125).all()
    torch.testing.assert_close(batch.weight, 0.25 / (0.25 + 0.25 * 0.125 * longer))


@pytest.mark.parametrize("max_events_per_pair", [1, 3])
def test_a_third_ray_lies_between_the_last_two_events(random_poses: torch.Tensor, max_events_per_pair: int) -> None:
    sampler = make_sampler(
        random_poses, SensorModel(refractory_period=1_000), max_events_per_pair=max_events_per_pair, temporal=True
    )
    rays, batch = sampler.sample(6000)
    start, end, within = rays.times[:, 0].chunk(3)
    assert ((batch.num_positive + batch.num_negative).max() > 1) == (max_events_per_pair > 1)
    single = batch.num_positive + batch.num_negative == 1
    torch.testing.assert_close(batch.last_interval[single], (end - start)[single].float())
    assert (batch.last_num_positive + batch.last_num_negative == 1).all()
    part = 1 - (end - within) / batch.last_interval
    assert part.min() >= 0
    assert part.max() <= 1
    # A normal distribution of mean 0.5 and deviation 0.25, cut at two deviations, has the deviation 0.22.
    assert part.mean().item() == pytest.approx(0.5, abs=0.02)
    assert part.std().item() == pytest.approx(0.22, abs=0.01)
    # A batch to log the loss on has none.
    assert len(sampler.sample(10, training=False)[0]) == 10


def test_a_share_of_the_pairs_ends_at_uniform_moments(random_poses: torch.Tensor) -> None:
    sampler = make_sampler(random_poses, SensorModel(refractory_period=1_000), max_events_per_pair=3, share=0.75)
    rays, batch = sampler.sample(40_000)
    starts, ends = rays.times[:, 0].chunk(2)
    between = batch.ends_between_events
    assert between.sum() == 15_000
    count = batch.num_positive + batch.num_negative
    # Nothing has happened since the pair's start, or since an event that is counted: the pixel's middle one.
    assert set(count[between].tolist()) == {0, 1}
    assert set(count[~between].tolist()) == {1, 2}
    # As many as the intervals take up, and at any time within.
    intervals = [(0.000_101, 0.6), (0.000_006, 0.25), (0.250_001, 1.0)]
    total = sum(end - start for start, end in intervals)
    for index, (start, end) in enumerate(intervals):
        inside = between & (batch.last_interval - (end - start)).abs().lt(1e-6)
        assert inside.sum() / 15_000 == pytest.approx((end - start) / total, abs=0.02)
        assert ends[inside].min() == pytest.approx(start, abs=0.005)
        assert ends[inside].max() == pytest.approx(end, abs=0.005)
        assert ends[inside].mean() == pytest.approx((start + end) / 2, abs=0.02)
        longer = inside & (count == 1)
        assert longer.any() == (index == 2)
        assert torch.allclose(starts[longer], torch.tensor(0.000_006, dtype=torch.float64))
        assert torch.allclose(starts[inside & ~longer], torch.tensor(start, dtype=torch.float64))


@pytest.mark.parametrize("refractory_period", [0, 500_000])
def test_the_lag_of_a_slow_pixel_is_allowed_for(random_poses: torch.Tensor, refractory_period: int) -> None:
    """One pixel sees log-radiance swing ten times a second, and follows it by milliseconds too late."""
    # A dark pixel seems to see a fifth of the mean.
    mean = 5 * 20 / 255

    def log_radiance(seconds: np.ndarray) -> np.ndarray:
        return np.log(mean / np.i0(0.5)) + 0.5 * np.sin(20 * math.pi * seconds)

    given = SensorModel(0.05, 0.04, refractory_period)
    simulator = EventSimulator(CAMERA.width, CAMERA.height, given, SensorNoise(bandwidth=100), log_epsilon=0.0)
    picture = np.ones((CAMERA.height, CAMERA.width))
    parts = []
    for seconds in np.arange(0, 1, 1e-3):
        picture[1, 3] = np.exp(log_radiance(seconds))
        parts.append(simulator(picture, EPOCH + round(1e9 * seconds)))
    stream = EventStream.concatenate(parts)
    assert set(stream.x.tolist()) == {3}
    sensor = replace(given, bandwidth=100 * (mean + 20 / 255) / (1 + 20 / 255))
    torch.manual_seed(0)
    sampler = make_sampler(random_poses, sensor, max_events_per_pair=20, share=0.25, stream=stream)
    rays, batch = sampler.sample(4000)
    supervision = PairSupervisionConfig().setup(sensor=sensor, loss_coefficients=PairLossCoefficients())
    outputs = {"log_radiance": torch.from_numpy(log_radiance(rays.times.numpy())).float()}
    rendered, change = supervision.changes(outputs, batch)
    as_told = ChangeSupervision.changes(supervision, outputs, batch)[1]
    # At first the pixel's signal is at the mean. It swings in within some ten milliseconds.
    known = ~batch.ends_between_events & (rays.times[:2000, 0] > 0.05)
    assert (rendered - as_told)[known].square().mean().sqrt() > 0.05
    assert (rendered - change)[known].square().mean().sqrt() < 0.01


def test_signal_rates_lie_between_those_of_the_intervals(random_poses: torch.Tensor) -> None:
    # One pixel's events after 100, 300, 700 and 1000 ms: +, -, +. The first has no interval before it.
    rows = [(3, 1, EPOCH + 1_000_000 * t, p) for t, p in ((0, 1), (100, 1), (300, -1), (700, 1))]
    period = 50_000_000
    sensor = SensorModel(0.2, 0.3, period, bandwidth=10.0)
    sampler = make_sampler(random_poses, sensor, share=0.25, stream=make_stream(rows))
    torch.manual_seed(0)
    _, batch = sampler.sample(4000)
    first, second, third = 1 / 0.05, -1 / 0.15, 1 / 0.35
    # On the lines through the middles of two intervals: where the blindness after an event ends, and at an event.
    ends_of_blindness = [first, first + 0.5 * (second - first), second + 0.25 / 0.6 * (third - second)]
    at_events = [first + 1 / 6 * (second - first), second + 0.15 / 0.6 * (third - second), third]
    silent = batch.ends_between_events
    for i, (start, end, mean) in enumerate(zip(ends_of_blindness, at_events, (first, second, third), strict=True)):
        here = (batch.last_interval - (0.05, 0.15, 0.35)[i]).abs() < 1e-6
        for chosen, expected in ((here & ~silent, end), (here & silent, mean)):
            assert chosen.any()
            torch.testing.assert_close(batch.start_rate[chosen], torch.full((int(chosen.sum()),), start))
            torch.testing.assert_close(batch.end_rate[chosen], torch.full((int(chosen.sum()),), expected))
    assert batch.weight.isfinite().all()


def test_a_burst_of_noise_makes_no_great_lag() -> None:
    supervision = PairSupervisionConfig().setup(
        sensor=SensorModel(0.2, 0.3, bandwidth=10.0), loss_coefficients=PairLossCoefficients()
    )
    batch = make_batch(4)
    batch.start_rate, batch.end_rate = torch.tensor([0.0, 1e6, 0.0, -1e6]), torch.tensor([1e6, 0.0, -1e6, 0.0])
    outputs = {"log_radiance": torch.zeros(8, 1)}
    change, as_told = supervision.changes(outputs, batch)[1], ChangeSupervision.changes(supervision, outputs, batch)[1]
    # Four thresholds, each of its polarity.
    torch.testing.assert_close(change - as_told, torch.tensor([0.8, -0.8, -1.2, 1.2]))


@pytest.mark.parametrize("max_events_per_pair", [1, 3])
def test_the_drift_of_its_pixel_is_taken_off_a_pair(random_poses: torch.Tensor, max_events_per_pair: int) -> None:
    drift, variance = np.zeros((2, CAMERA.height, CAMERA.width), np.float32)
    drift[1, 3], variance[1, 3] = 0.1, 0.01
    found = PolarityDrift(drift, variance, spread=0.2)
    sampler = make_sampler(random_poses, SensorModel(), max_events_per_pair=max_events_per_pair, drift=found)
    _, batch = sampler.sample(400)
    number, surplus = batch.num_positive + batch.num_negative, batch.num_positive - batch.num_negative
    here = batch.pixel == CAMERA.width + 3
    assert here.any()
    assert not here.all()
    used = max_events_per_pair > 1
    torch.testing.assert_close(batch.drift, 0.1 * used * here * number)
    unknown = used * (0.01 * here * number**2 + 0.04 * surplus**2)
    torch.testing.assert_close(batch.weight, 0.25 / (0.25 + unknown))
    # A pixel that has gained too many positive events has become less bright than they say.
    supervision = PairSupervisionConfig().setup(sensor=SensorModel(), loss_coefficients=PairLossCoefficients())
    log_radiance = torch.zeros(2 * len(batch), 1)
    _, change = supervision.changes({"log_radiance": log_radiance}, batch)
    torch.testing.assert_close(change, 0.25 * (surplus - batch.drift))


@pytest.mark.parametrize("number", [0, 256])
def test_an_impossible_number_of_events_is_refused(number: int, random_poses: torch.Tensor) -> None:
    with pytest.raises(DataError, match=f"max-events-per-pair is {number}; give a number from 1 to 255"):
        make_sampler(random_poses, SensorModel(), max_events_per_pair=number)


def test_the_color_filter_is_that_of_the_raw_pixel(random_poses: torch.Tensor) -> None:
    _, batch = make_sampler(random_poses, SensorModel(bayer_pattern="RGGB")).sample(40)
    # Pixel (3, 1) is blue and pixel (0, 2) red.
    assert set(batch.channel.tolist()) == {0, 2}


def test_pixels_without_a_direction_are_not_sampled(random_poses: torch.Tensor) -> None:
    # This lens model folds over towards the corners, pixel (0, 2) among them.
    nowhere = CameraIntrinsics(4, 3, 0.1, 0.1, 30.0, 1.5, "radial_tangential", (-0.4, 0.0, 0.0, 0.0, 0.0))
    for share in (0.0, 1.0):
        with pytest.raises(DataError, match="no event lies on a pixel with a direction"):
            make_sampler(random_poses, SensorModel(), nowhere, share=share).prepare()
    folded = CameraIntrinsics(4, 3, 1.2, 1.2, 3.0, 1.5, "radial_tangential", (-0.4, 0.0, 0.0, 0.0, 0.0))
    assert not folded.pixel_directions()[1][2, 0]
    assert folded.pixel_directions()[1][1, 3]
    for share in (0.0, 1.0):
        _, batch = make_sampler(random_poses, SensorModel(bayer_pattern="RGGB"), folded, share=share).sample(40)
        assert set(batch.channel.tolist()) == {2}
