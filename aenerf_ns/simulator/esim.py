"""Simulate an event sensor: ESIM (Rebecq et al., CoRL 2018) with the corrections of Robust e-NeRF (Low and Lee, 2023).

Between two frames the log-intensity of every pixel is linear in time, and every threshold crossing is solved for its
time. So a pixel may fire any number of events between two frames. What makes a sensor real is in
:class:`~aenerf_ns.simulator.options.SensorNoise`.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aenerf_ns.camera.image_encoding import LUMINANCE
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.simulator.options import MIN_CONTRAST_THRESHOLD, SensorNoise

# Both from v2e (Hu et al., CVPRW 2021): the part of the shot noise that vanishes at white, and the radiance that a dark
# pixel seems to see where its bandwidth is concerned.
_BRIGHT_REDUCTION = 0.75
_DARK_RADIANCE = 20 / 255

NOISELESS = SensorNoise()


@numba.njit(cache=True)
def _linear_events(interval, reference_log, reference_time, sensor, pixel, events):
    """Fire the events of one pixel while its log-intensity is linear.

    Args:
        interval: log-intensity at its start and at its end, and these times.
        reference_log, reference_time: state of the pixel. The pixel has its reference if the time lies before the
            interval. Otherwise it takes its reference at that time, which may lie in a later interval.
        sensor: positive and negative threshold, and refractory period.
        pixel: its number.
        events: time, pixel and polarity of each event are appended to these.

    Returns:
        the new reference and its time.
    """
    start_log, end_log, start_time, end_time = interval
    positive_threshold, negative_threshold, refractory_period = sensor
    rise = end_log - start_log
    duration = end_time - start_time
    polarity = 1 if rise > 0.0 else -1
    step = positive_threshold if rise > 0.0 else -negative_threshold
    earliest = start_time
    while True:
        if reference_time >= start_time:
            if reference_time >= end_time:
                break
            reference_log = start_log + rise * ((reference_time - start_time) / duration)
            earliest = reference_time
            if refractory_period == 0:
                reference_time = start_time - 1
        crossing_log = reference_log + step
        # The comparison is made in log-intensity, not in time, so that rounding never loses or doubles an event.
        if rise == 0.0 or (end_log - crossing_log) * polarity < 0.0:
            break
        crossing = start_time + np.int64(np.rint(duration * ((crossing_log - start_log) / rise)))
        time = min(max(crossing, earliest + 1), end_time)
        events.append((time, pixel, polarity))
        if refractory_period > 0:
            # Counted from the rounded time stamp. The log-intensity then changed by exactly the threshold over the
            # interval [t_prev + refractory period, t] that a reader of the stream forms.
            reference_time = time + refractory_period
        else:
            reference_log = crossing_log
    return reference_log, reference_time


@numba.njit(cache=True)
def _frame_events(frames, times, references, thresholds, refractory_period, noise):
    """Fire the events of all pixels in one frame interval.

    Noise events cut the interval of their pixel into pieces. A noise event acts like any other: the pixel is blind for
    the refractory period, or takes the log-intensity of that moment as its reference.

    Args:
        frames, times: log-intensity (H, W) and time at the start and at the end.
        references: log-intensity and time (H, W) of the pixels' references, changed in place.
        thresholds: positive and negative (H, W).
        refractory_period: of all pixels.
        noise: pixels, times and polarities of noise events, sorted by pixel, row by row, then by time.

    Returns:
        (N, 3) times, pixels and polarities, pixel by pixel.
    """
    height, width = frames[0].shape
    start_time, end_time = times
    noise_pixels, noise_times, noise_polarities = noise
    events = [(np.int64(0), 0, np.int64(0)) for _ in range(0)]
    next_noise = 0
    for y in range(height):
        for x in range(width):
            pixel, sensor = y * width + x, (thresholds[0][y, x], thresholds[1][y, x], refractory_period)
            start_log, end_log = frames[0][y, x], frames[1][y, x]
            reference_log, reference_time = references[0][y, x], references[1][y, x]
            piece_log, piece_time = start_log, start_time
            is_cut = True
            while is_cut:
                is_cut = next_noise < len(noise_pixels) and noise_pixels[next_noise] == pixel
                time = noise_times[next_noise] if is_cut else end_time
                log = start_log + (end_log - start_log) * ((time - start_time) / (end_time - start_time))
                piece = piece_log, log if time < end_time else end_log, piece_time, time
                reference_log, reference_time = _linear_events(
                    piece, reference_log, reference_time, sensor, pixel, events
                )
                piece_log, piece_time = log, time
                if is_cut and reference_time < time:
                    events.append((time, pixel, noise_polarities[next_noise]))
                    reference_log = log
                    if refractory_period > 0:
                        reference_time = time + refractory_period
                next_noise += is_cut
            references[0][y, x], references[1][y, x] = reference_log, reference_time
    table = np.empty((len(events), 3), np.int64)
    for i, event in enumerate(events):
        table[i, 0], table[i, 1], table[i, 2] = event
    return table


@numba.njit(cache=True)
def _read_out(times, pixels, busy_until, waits_until, period):
    """Delay events by a readout that takes them one by one, in their order.

    Args:
        times: (N,) of the events, in order, after an arbitrary start. The delayed times replace them; -1 if lost.
        pixels: (N,) their pixels.
        busy_until: when the readout becomes free, on the same clock.
        waits_until: (H · W) when the last event of each pixel is read, changed in place. An event before that is lost.
        period: time that an event takes.

    Returns:
        when the readout becomes free, and the longest delay.
    """
    longest = 0.0
    for i in range(len(times)):
        time = times[i]
        if time < waits_until[pixels[i]]:
            times[i] = -1.0
            continue
        times[i] = max(time, busy_until)
        busy_until = times[i] + period
        waits_until[pixels[i]] = times[i]
        longest = max(longest, times[i] - time)
    return busy_until, longest


class EventSimulator:
    """Turn a sequence of linear-radiance frames into events.

    The sensor sees log(I + log_epsilon), which is linear in time between frames. A pixel fires when this signal differs
    from the pixel's reference by the contrast threshold. The reference then moves by exactly the threshold. With a
    refractory period, the pixel is blind until the period ends and takes the log-intensity of that moment as its new
    reference instead, as in Robust e-NeRF.

    Args:
        width, height: pixel columns and rows, at most 65536.
        sensor: contrast thresholds, of 0.01 or more, refractory period and Bayer pattern. Initial reference times are
            random, uniform in [0, refractory period) after the first frame.
        noise: thresholds of single pixels are drawn once from N(C, contrast_threshold_spread) and clipped at 0.01. A
            low-pass filter of first order follows the logarithm; its cutoff frequency is bandwidth · (I + ε) / (1 + ε),
            ε = 20 / 255. The leak makes the filtered signal rise by leak_rate · C+ a second. Shot noise falls with the
            intensity, to a quarter at 1 and above (v2e, Hu et al. 2021), and moves the reference as any event does.
            Readout and clock change the times of events only, and lose those of pixels that wait.
        log_epsilon: added to the intensity before the logarithm.
        seed: of the thresholds, of the initial reference times, and of the noise.

    Attributes:
        positive_contrast_threshold, negative_contrast_threshold: (H, W) of each pixel.
        num_lost_events, longest_delay: what the readout has lost, and its longest delay in nanoseconds, so far.

    Example:
        One pixel whose radiance doubles in a millisecond: log-radiance rises by 0.69, and by 0.25 twice.

        >>> simulator = EventSimulator(1, 1, SensorModel(0.25, 0.25))
        >>> events = simulator([[0.1]], 0)
        >>> events = simulator([[0.2]], 1_000_000)
        >>> events.p
        array([1, 1], dtype=int8)
        >>> events.t
        array([363275, 726549])
    """

    def __init__(
        self,
        width: int,
        height: int,
        sensor: SensorModel,
        noise: SensorNoise = NOISELESS,
        *,
        log_epsilon: float = 1e-3,
        seed: int = 0,
    ) -> None:
        self.width, self.height = width, height
        self.sensor = sensor
        self.log_epsilon = log_epsilon
        self.num_lost_events, self.longest_delay = 0, 0.0
        self._channel_weights = np.array(LUMINANCE)
        if sensor.bayer_pattern:
            self._channel_weights = np.eye(3)[sensor.channels(width, height)]
        self._rng = np.random.default_rng(seed)
        spread = noise.contrast_threshold_spread or 0.0
        self.positive_contrast_threshold = self._draw_thresholds(sensor.positive_contrast_threshold, spread)
        self.negative_contrast_threshold = self._draw_thresholds(sensor.negative_contrast_threshold, spread)
        # The rates of noise have a generator of their own, so that the first reference times do not depend on them.
        rng = np.random.default_rng((seed, 1))
        factors = 10 ** rng.normal(0.0, noise.noise_rate_spread or 0.0, (height, width))
        self._leak = (noise.leak_rate or 0.0) * factors * sensor.positive_contrast_threshold * 1e-9
        self._is_hot = rng.random(height * width) < (noise.hot_pixel_fraction or 0.0)
        shot_noise_rates = (noise.shot_noise_rate or 0.0) * factors.ravel()
        self._noise_rates = np.where(self._is_hot, noise.hot_pixel_rate or 0.0, shot_noise_rates).cumsum()
        self._bandwidth = noise.bandwidth
        self._tick = noise.time_resolution_ns or 1
        self._readout_period = 1e9 / noise.readout_rate if noise.readout_rate else 0.0
        self._busy_until, self._waits_until = 0.0, np.zeros(height * width)
        # Of the last frame: the intensity, its logarithm, that filtered, and the same with the leak.
        self._last: tuple[NDArray[np.float64], ...] = ()
        self._start_ns = self._time_ns = 0
        # Of the light that the bandwidth follows: the mean over the pixels, summed over the nanoseconds.
        self._sum_of_light = 0.0

    def __call__(self, image: ArrayLike, time_ns: int) -> EventStream:
        """Show the sensor the next frame.

        Args:
            image: linear radiance (H, W), or linear RGB (H, W, 3), of which a monochrome sensor takes the Rec. 709
                luminance. A color sensor needs RGB.
            time_ns: time of the frame in nanoseconds, later than the previous frame's.

        Returns:
            The events in (previous frame, this frame], ordered by time, then by pixel unless they wait or share a tick.
            The first frame gives no events. A readout may delay events beyond this frame, and the clock rounds down.

        Raises:
            ValueError: a wrong shape, a negative or non-finite radiance, or a time that does not increase.
        """
        intensity = self._to_intensity(np.asarray(image))
        time_ns = int(time_ns)
        log_intensity = np.log(intensity + self.log_epsilon)
        filtered = signal = log_intensity
        if not self._last:
            self._start_ns = self._time_ns = time_ns
            self._reference_log = log_intensity.copy()
            self._reference_time = np.full(log_intensity.shape, time_ns, np.int64)
            if self.sensor.refractory_period > 0:
                self._reference_time += self._rng.integers(0, self.sensor.refractory_period, log_intensity.shape)
            events = np.empty((0, 3), np.int64)
        else:
            if time_ns <= self._time_ns:
                raise ValueError(f"frame times must increase: got {time_ns} ns after {self._time_ns} ns")
            last_intensity, last_log, last_filtered, last_signal = self._last
            if self._bandwidth is not None:
                light = ((last_intensity + intensity) / 2 + _DARK_RADIANCE) / (1 + _DARK_RADIANCE)
                self._sum_of_light += light.mean() * (time_ns - self._time_ns)
                # The input of a first-order filter goes linearly from the last logarithm to this one. That takes this
                # many time constants of the filter.
                time_constants = 2e-9 * math.pi * self._bandwidth * light * (time_ns - self._time_ns)
                decay, rise = np.expm1(-time_constants), log_intensity - last_log
                filtered = log_intensity + (last_filtered - last_log) * (1 + decay) + rise * decay / time_constants
            signal = filtered + self._leak * (time_ns - self._start_ns)
            events = _frame_events(
                (last_signal, signal),
                (self._time_ns, time_ns),
                (self._reference_log, self._reference_time),
                (self.positive_contrast_threshold, self.negative_contrast_threshold),
                self.sensor.refractory_period,
                self._shot_noise(intensity, time_ns),
            )
        # A stable sort keeps the order of the pixels.
        t, pixels, p = events[np.argsort(events[:, 0], kind="stable")].T
        if self._readout_period > 0:
            delayed = (t - self._start_ns).astype(np.float64)
            self._busy_until, delay = _read_out(
                delayed, pixels, self._busy_until, self._waits_until, self._readout_period
            )
            self.longest_delay = max(self.longest_delay, delay)
            is_read = delayed >= 0
            self.num_lost_events += len(t) - np.count_nonzero(is_read)
            t, pixels, p = self._start_ns + delayed[is_read].astype(np.int64), pixels[is_read], p[is_read]
        self._last, self._time_ns = (intensity, log_intensity, filtered, signal), time_ns
        return EventStream.at_pixels(pixels, t - t % self._tick, p > 0, self.width, self.height)

    def recorded_sensor(self) -> SensorModel:
        """Return the sensor, with the bandwidth that a pixel has at the mean radiance of the frames."""
        mean_light = self._sum_of_light / max(self._time_ns - self._start_ns, 1)
        return replace(self.sensor, bandwidth=(self._bandwidth or 0.0) * mean_light)

    def readout_note(self) -> str:
        """Say how many events the readout lost, and how long it delayed others."""
        return (
            f"The readout of {1e3 / self._readout_period:.4g} million events a second is saturated at times: it delays "
            f"events by up to {self.longest_delay * 1e-6:.2g} ms, and {self.num_lost_events:,} events of pixels that "
            "wait for it are lost."
        )

    def _draw_thresholds(self, mean: float, spread: float) -> NDArray[np.float64]:
        thresholds = self._rng.normal(mean, spread, (self.height, self.width))
        return np.maximum(thresholds, MIN_CONTRAST_THRESHOLD)

    def _shot_noise(self, intensity: NDArray[np.float64], time_ns: int) -> tuple[NDArray[np.int64], ...]:
        """Draw the noise events of a frame interval: pixels, row by row, times and polarities."""
        seconds = (time_ns - self._time_ns) * 1e-9
        total = self._noise_rates[-1]
        count = self._rng.poisson(total * seconds)
        # Without the last sum, rounding never leads beyond the last pixel.
        pixels = np.searchsorted(self._noise_rates[:-1], total * self._rng.random(count), side="right")
        reduction = np.where(self._is_hot[pixels], 0.0, _BRIGHT_REDUCTION)
        kept = self._rng.random(count) < 1 - reduction * np.minimum(intensity.ravel()[pixels], 1)
        times = self._rng.integers(self._time_ns + 1, time_ns + 1, count)
        polarities = self._rng.integers(0, 2, count) * 2 - 1
        order = np.lexsort((times, pixels))
        order = order[kept[order]]
        return pixels[order], times[order], polarities[order]

    def _to_intensity(self, image: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the radiance (H, W) that each pixel sees through its filter."""
        size = (self.height, self.width)
        if image.shape != (*size, 3) and (image.shape != size or self.sensor.bayer_pattern):
            wanted = f"{(*size, 3)}" if self.sensor.bayer_pattern else f"{size} or {(*size, 3)}"
            raise ValueError(f"image must have shape {wanted}, got {image.shape}")
        image = image.astype(np.float64)
        num_invalid = np.count_nonzero(~((image >= 0) & (image < math.inf)))
        if num_invalid:
            raise ValueError(f"radiance must be finite and not negative, got {num_invalid} other values")
        if image.ndim == 2:
            return image
        # Not a matrix product, which may round equal pixels differently.
        return (image * self._channel_weights).sum(-1)
