"""The simulator against closed forms and against a slow reference that follows the sensor's definition."""

import math
from typing import Any, get_args

import numpy as np
import pytest

from aenerf_ns.events.sensor import BayerPattern, SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.simulator.esim import EventSimulator
from aenerf_ns.simulator.options import SENSORS, SensorName, SensorNoise

WIDTH, HEIGHT = 7, 6
LOG_EPSILON = 1e-3


def make_simulator(
    positive: float,
    negative: float,
    width: int = WIDTH,
    height: int = HEIGHT,
    refractory_period: int = 0,
    bayer_pattern: BayerPattern = "",
    seed: int = 0,
    **noise: Any,
) -> EventSimulator:
    sensor = SensorModel(positive, negative, refractory_period, bayer_pattern)
    return EventSimulator(width, height, sensor, SensorNoise(**noise), log_epsilon=LOG_EPSILON, seed=seed)


def simulate(simulator: EventSimulator, images: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, ...]:
    events = EventStream.concatenate([simulator(image, int(time)) for image, time in zip(images, times, strict=True)])
    return events.x, events.y, events.t, events.p


def to_images(log_frames: np.ndarray) -> np.ndarray:
    return np.exp(log_frames) + 1.0 - LOG_EPSILON


def log_of(images: np.ndarray) -> np.ndarray:
    return np.log(images + LOG_EPSILON)


def reference_events(
    log_frames: np.ndarray, times: np.ndarray, positive: float, negative: float, refractory: int, start: int
) -> list[tuple[int, int]]:
    """Times and polarities of one pixel, by walking along its piecewise-linear signal from one deed to the next."""

    def signal(time: int) -> float:
        return float(np.interp(time, times, log_frames))

    events: list[tuple[int, int]] = []
    if start >= times[-1]:
        return events
    reference, now = signal(start), start
    for k in range(len(times) - 1):
        t0, t1, l0, l1 = int(times[k]), int(times[k + 1]), float(log_frames[k]), float(log_frames[k + 1])
        while now < t1 and l1 != l0:
            level = reference + positive if l1 > l0 else reference - negative
            if (level > l1) if l1 > l0 else (level < l1):
                break
            time = max(round(t0 + (level - l0) / (l1 - l0) * (t1 - t0)), max(now, t0) + 1)
            events.append((time, 1 if l1 > l0 else -1))
            if refractory:
                now = time + refractory
                if now < times[-1]:
                    reference = signal(now)
            else:
                reference = level
    return events


@pytest.mark.parametrize("refractory", [0, 3_000, 400_000, 2_500_000])
def test_agrees_with_slow_reference(refractory: int) -> None:
    rng = np.random.default_rng(2)
    times = 10_000_000_000 + np.cumsum(rng.integers(200_000, 900_000, 60))
    images = to_images(np.cumsum(rng.normal(0, 0.5, (len(times), HEIGHT, WIDTH)), axis=0) - 1.0)
    simulator = make_simulator(0.2, 0.3, refractory_period=refractory, contrast_threshold_spread=0.05, seed=4)
    positive, negative = simulator.positive_contrast_threshold, simulator.negative_contrast_threshold
    simulator(images[0], times[0])
    starts = simulator._reference_time.copy()
    x, y, t, p = simulate(simulator, images[1:], times[1:])
    log_frames = log_of(images)
    total = 0
    for row, column in np.ndindex(HEIGHT, WIDTH):
        mine = (x == column) & (y == row)
        here = (row, column)
        expected = reference_events(
            log_frames[:, row, column], times, positive[here], negative[here], refractory, int(starts[here])
        )
        np.testing.assert_allclose(t[mine], [time for time, _ in expected], atol=1, rtol=0)
        np.testing.assert_array_equal(p[mine], [polarity for _, polarity in expected])
        if refractory:
            assert np.all(np.diff(t[mine]) > refractory)
        total += len(expected)
    assert total == len(t) > 100
    assert (x.dtype, y.dtype, t.dtype, p.dtype) == (np.uint16, np.uint16, np.int64, np.int8)


def test_initial_reference_times_fill_the_refractory_period() -> None:
    simulator = make_simulator(0.1, 0.1, 60, 50, refractory_period=1_000_000)
    simulator(np.ones((50, 60)), 0)
    # A steady rise of one threshold each 2 ms: a pixel fires exactly 2 ms after it took its reference.
    t = simulator(np.exp(0.5) * (1 + LOG_EPSILON) * np.ones((50, 60)) - LOG_EPSILON, 10_000_000).t
    first = np.sort(t)[:3000] - 2_000_000
    assert 0 <= first.min() < 10_000
    assert 990_000 < first.max() < 1_000_000
    assert abs(first.mean() - 500_000) < 25_000


def test_stream_order_and_range() -> None:
    rng = np.random.default_rng(3)
    simulator = make_simulator(0.01, 0.01)
    simulator(rng.uniform(0, 1, (HEIGHT, WIDTH)), 0)
    events = simulator(rng.uniform(0, 1, (HEIGHT, WIDTH)), 50)  # far more events than time stamps
    assert len(events) > 1000
    assert events.t.min() > 0
    assert events.t.max() <= 50
    pixel = events.y.astype(np.int64) * WIDTH + events.x
    np.testing.assert_array_equal(np.lexsort((pixel, events.t)), np.arange(len(events)))


def test_color_filters_and_luminance() -> None:
    before, after = np.ones((4, 6, 3)), np.ones((4, 6, 3))
    for channel, pixels in enumerate(
        ([(0, 0)], [(0, 1), (1, 0)], [(1, 1)])  # (y, x) modulo 2 behind red, green and blue filters
    ):
        after[:] = before
        after[..., channel] = 1.3
        color = make_simulator(0.2, 0.2, 6, 4, bayer_pattern="RGGB")
        color(before, 0)
        events = color(after, 1000)
        assert sorted(set(zip((events.y % 2).tolist(), (events.x % 2).tolist(), strict=True))) == pixels
        assert len(events) == 6 * len(pixels)
    gray, luminance = make_simulator(0.2, 0.2, 6, 4), make_simulator(0.2, 0.2, 6, 4)
    rgb = np.random.default_rng(0).uniform(0, 3, (2, 4, 6, 3))
    weights = np.array([0.2126, 0.7152, 0.0722])
    from_rgb = simulate(gray, rgb, np.array([0, 10**6]))
    from_luminance = simulate(luminance, (rgb * weights).sum(-1), np.array([0, 10**6]))
    assert len(from_rgb[0]) > 20
    np.testing.assert_allclose(from_rgb[2], from_luminance[2], atol=1, rtol=0)


def test_threshold_spread() -> None:
    simulator = make_simulator(0.25, 0.1, 200, 200, contrast_threshold_spread=0.05)
    positive, negative = simulator.positive_contrast_threshold, simulator.negative_contrast_threshold
    assert abs(positive.mean() - 0.25) < 1e-3
    assert abs(positive.std() - 0.05) < 1e-3
    assert negative.min() == 0.01
    assert abs(np.mean(negative == 0.01) - 0.0359) < 0.005  # the normal distribution below -1.8 deviations
    assert abs(np.corrcoef(positive.ravel(), negative.ravel())[0, 1]) < 0.02


def test_leak_fires_in_steady_light() -> None:
    simulator = make_simulator(0.2, 0.2, 50, 40, contrast_threshold_spread=0.03, leak_rate=4.0, seed=1)
    start = 1_700_000_000 * 10**9
    images = np.full((3, 40, 50), 0.3)
    x, y, t, p = simulate(simulator, images, start + np.array([0, 10**9, 5 * 10**9]))
    assert (p == 1).all()
    threshold = simulator.positive_contrast_threshold
    for row, column in ((0, 0), (7, 3), (39, 49)):
        mine = (x == column) & (y == row)
        period = threshold[row, column] / (4.0 * 0.2)
        np.testing.assert_allclose((t[mine] - start) * 1e-9, period * np.arange(1, mine.sum() + 1), atol=2e-8)
        assert mine.sum() == int(5 / period)


def test_shot_noise_has_its_rate() -> None:
    image = np.zeros((80, 100))
    image[:, 50:] = 1.0
    simulator = make_simulator(0.2, 0.2, 100, 80, shot_noise_rate=2.0)
    x, y, t, p = simulate(simulator, np.stack([image] * 11), np.arange(11) * 5 * 10**8)
    seconds, pixels = 5.0, 80 * 50
    dark, bright = (x < 50).sum(), (x >= 50).sum()
    for count, rate in ((dark, 2.0), (bright, 0.5)):
        expected = rate * seconds * pixels
        assert abs(count - expected) < 4 * math.sqrt(expected)
    assert abs(p.sum()) < 4 * math.sqrt(len(p))
    assert abs(t.mean() - 2.5e9) < 4 * 5e9 / math.sqrt(12 * len(t))
    # Poisson: the variance of a pixel's count is its mean.
    counts = np.bincount(y.astype(int) * 100 + x, minlength=8000).reshape(80, 100)[:, :50]
    assert abs(counts.var() / counts.mean() - 1) < 0.1


@pytest.mark.parametrize("refractory", [0, 40_000_000])
def test_shot_noise_moves_the_reference(refractory: int) -> None:
    # A signal that rises and falls by many thresholds: between two events of noise there are others.
    times = np.arange(9) * 10**8
    log_frames = np.array([0, 1, -1, 0.5, 0.3, 2, 2.1, -1, 0.0]) - 1
    images = to_images(np.broadcast_to(log_frames[:, None, None], (9, HEIGHT, WIDTH)))
    simulator = make_simulator(0.2, 0.3, shot_noise_rate=8.0, refractory_period=refractory)
    x, y, t, p = simulate(simulator, images, times)
    signal = log_of(images)[:, 0, 0]
    noise = 0
    for row, column in np.ndindex(HEIGHT, WIDTH):
        mine = (x == column) & (y == row)
        change = np.interp(t[mine][1:], times, signal) - np.interp(t[mine][:-1] + refractory, times, signal)
        regular = np.abs(change - np.where(p[mine][1:] > 0, 0.2, -0.3)) < 1e-6
        # Whatever is not a threshold's step is noise, and never a larger step than a threshold.
        assert (change[~regular] < 0.2).all()
        assert (change[~regular] > -0.3).all()
        assert (np.diff(t[mine]) > (refractory or -1)).all()
        noise += (~regular).sum()
    expected = 8.0 * 0.8 * WIDTH * HEIGHT
    assert 0.1 * expected < noise < expected
    assert len(t) - noise > 3 * WIDTH * HEIGHT


def test_low_pass_follows_the_step_response() -> None:
    # The same step of the logarithm by 1, in light and a hundred times darker.
    simulator = make_simulator(0.2, 0.2, 2, 1, bandwidth=100.0)
    bright = 0.9
    after = np.array([[bright, bright / 100]])
    before = (after + LOG_EPSILON) / math.e - LOG_EPSILON
    times = np.append([0, 1], np.arange(1, 3001) * 20_000)
    x, _, t, p = simulate(simulator, np.concatenate([[before], np.repeat([after], 3001, axis=0)]), times)
    assert (p == 1).all()
    for column, radiance in enumerate(after[0]):
        floor = 20 / 255
        time_constant = (1 + floor) / (2 * math.pi * 100 * (radiance + floor))
        expected = -time_constant * np.log(1 - 0.2 * np.arange(1, 5))
        np.testing.assert_allclose(t[x == column] * 1e-9, expected[expected < 0.06], rtol=2e-3)
    # Seen by v2e's rule, white has 14 times the bandwidth of black.
    assert (x == 0).sum() == 4
    assert t[x == 1][0] > 9 * t[x == 0][0]
    # The bandwidth at the mean radiance.
    light = (after.mean() + 20 / 255) / (1 + 20 / 255)
    assert simulator.recorded_sensor().bandwidth == pytest.approx(100 * light, rel=1e-3)
    assert make_simulator(0.2, 0.2).recorded_sensor().bandwidth == 0


@pytest.mark.parametrize("coarse", [2, 10])
def test_low_pass_needs_no_finer_frames(coarse: int) -> None:
    # The time constant is 1.6 ms at white, and the light turns every 5 ms. Frames are 0.1 ms, or 0.2 and 1 ms apart.
    corners = np.random.default_rng(0).uniform(-3, 0, (31, HEIGHT, WIDTH))
    times = np.arange(1501) * 100_000
    logs = np.apply_along_axis(lambda column: np.interp(times / 5e6, np.arange(31), column), 0, corners)
    streams = []
    for step in (1, coarse):
        simulator = make_simulator(0.2, 0.2, bandwidth=100.0)
        streams.append(simulate(simulator, (np.exp(logs) - LOG_EPSILON)[::step], times[::step]))
    fine, other = ((y.astype(int) * WIDTH + x, t, p) for x, y, t, p in streams)
    assert len(fine[0]) > 1500
    assert abs(len(other[0]) - len(fine[0])) < 0.01 * len(fine[0])
    errors = []
    for pixel in range(WIDTH * HEIGHT):
        a, b = (stream[1][stream[0] == pixel] for stream in (fine, other))
        if len(a) == len(b):
            errors.append(np.abs(a - b))
    assert np.mean(np.concatenate(errors)) < 100_000 * coarse / 8


def test_leak_differs_from_pixel_to_pixel() -> None:
    simulator = make_simulator(0.2, 0.2, 60, 50, leak_rate=40.0, noise_rate_spread=0.1)
    x, y, t, p = simulate(simulator, np.full((3, 50, 60), 0.3), np.array([0, 1, 10]) * 10**9)
    rates = np.bincount(y.astype(int) * 60 + x, minlength=3000) / 10
    assert (p == 1).all()
    assert abs(np.log10(rates).mean() - math.log10(40)) < 0.01
    assert abs(np.log10(rates).std() - 0.1) < 0.01
    # The same pixels leak more in the second half.
    halves = [np.bincount((y.astype(int) * 60 + x)[half], minlength=3000) for half in (t < 5e9, t >= 5e9)]
    assert np.corrcoef(halves)[0, 1] > 0.98


def test_hot_pixels_have_their_rate_in_any_light() -> None:
    image = np.zeros((80, 100))
    image[:, 50:] = 1.0
    simulator = make_simulator(0.2, 0.2, 100, 80, shot_noise_rate=1.0, hot_pixel_fraction=0.01, hot_pixel_rate=200.0)
    x, y, _, p = simulate(simulator, np.stack([image] * 11), np.arange(11) * 5 * 10**8)
    rates = np.bincount(y.astype(int) * 100 + x, minlength=8000) / 5
    is_hot = rates > 50
    assert 50 < is_hot.sum() < 110
    np.testing.assert_allclose(rates[is_hot], 200, atol=4 * math.sqrt(200 / 5))
    assert abs(rates[~is_hot].mean() - (1 + 0.25) / 2) < 0.05
    assert abs(p.mean()) < 0.02


def test_clock_ticks() -> None:
    rng = np.random.default_rng(6)
    images, times = rng.uniform(0, 1, (5, HEIGHT, WIDTH)), 7_777 + np.arange(5) * 10**6
    exact = simulate(make_simulator(0.05, 0.05), images, times)
    x, y, t, p = simulate(make_simulator(0.05, 0.05, time_resolution_ns=1000), images, times)
    np.testing.assert_array_equal(t, exact[2] // 1000 * 1000)
    for mine, other in zip((x, y, p), (exact[0], exact[1], exact[3]), strict=True):
        np.testing.assert_array_equal(mine, other)


@pytest.mark.parametrize("threshold", [0.02, 0.4])
def test_readout_delays_and_counts_what_it_loses(threshold: float) -> None:
    # Every pixel fires within 0.1 ms, once in each burst with the higher threshold. The readout takes 1 event in 10 us.
    rises = np.random.default_rng(7).uniform(0.5, 0.7, (1, HEIGHT, WIDTH))
    images = np.exp(rises * np.array([0, 1, 1, 2, 2]).reshape(5, 1, 1)) - LOG_EPSILON
    times = np.array([0, 100_000, 200_000, 5_000_000, 5_100_000])
    wanted = simulate(make_simulator(threshold, threshold), images, times)
    simulator = make_simulator(threshold, threshold, readout_rate=1e5)
    x, y, t, p = simulate(simulator, images, times)
    assert (np.diff(t) >= 9_999).all()
    assert len(t) + simulator.num_lost_events == len(wanted[0])
    # Nobody waits longer than all other pixels take.
    assert 100_000 < simulator.longest_delay < WIDTH * HEIGHT * 10_000
    if threshold > 0.1:
        assert simulator.num_lost_events == 0
        places = 10_000 * np.arange(len(t))
        np.testing.assert_allclose(t, np.maximum.accumulate(wanted[2] - places) + places, atol=1)
        for mine, other in zip((x, y, p), (wanted[0], wanted[1], wanted[3]), strict=True):
            np.testing.assert_array_equal(mine, other)
    else:
        assert simulator.num_lost_events > 50
        assert f"{simulator.num_lost_events:,} events of pixels that wait" in simulator.readout_note()


@pytest.mark.parametrize("name", get_args(SensorName))
def test_sensors_are_decided_by_name_and_seed(name: SensorName) -> None:
    rng = np.random.default_rng(5)
    images, times = rng.uniform(0, 1, (20, HEIGHT, WIDTH)), np.arange(20) * 10**7
    streams = []
    for seed in (1, 1, 2):
        simulator = EventSimulator(WIDTH, HEIGHT, *SENSORS[name], seed=seed)
        streams.append(b"".join(column.tobytes() for column in simulate(simulator, images, times)))
    assert streams[0] == streams[1]
    assert (streams[1] == streams[2]) == (name == "ideal")
    assert len(streams[0]) > 1000


def test_refuse_frame() -> None:
    simulator = make_simulator(0.2, 0.2)
    good = np.ones((HEIGHT, WIDTH))
    simulator(good, 5)
    with pytest.raises(ValueError, match=r"must increase.*got 5 ns after 5 ns"):
        simulator(good, 5)
    with pytest.raises(ValueError, match=r"shape .* got \(7, 6\)"):
        simulator(good.T, 6)
    for value in (np.nan, np.inf, -1e-9):
        bad = good.copy()
        bad[2, 3] = value
        with pytest.raises(ValueError, match="finite and not negative, got 1 other"):
            simulator(bad, 6)
    with pytest.raises(ValueError, match=r"shape \(6, 7, 3\), got \(6, 7\)"):
        make_simulator(0.2, 0.2, bayer_pattern="RGGB")(good, 0)
    # A refused frame leaves no trace.
    assert len(simulator(good, 7)) == 0
