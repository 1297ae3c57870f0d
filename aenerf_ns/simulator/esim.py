"""Simulate an event sensor: ESIM (Rebecq et al., CoRL 2018) with the corrections of Robust e-NeRF (Low and Lee, 2023).

Between two frames the log-intensity of every pixel is linear in time, and every threshold crossing is solved for its
time. So a pixel may fire any number of events between two frames.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aenerf_ns.camera.image_encoding import LUMINANCE
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.simulator.options import SensorNoise

_MIN_CONTRAST_THRESHOLD = 0.01
_BRIGHT_REDUCTION = 0.75

NOISELESS = SensorNoise()

Events = tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.int64], NDArray[np.int8]]


@numba.njit(cache=True)
def _fire(time, positive, packing, keys, position):
    """Write the key of an event, unless ``keys`` is empty, and return the position after it."""
    first_time, time_shift, pixel_key = packing
    if len(keys) > 0:
        keys[position] = (time - first_time) << time_shift | pixel_key | positive
    return position + 1


@numba.njit(cache=True)
def _linear_events(interval, reference_log, reference_time, sensor, packing, keys, position):
    """Fire the events of one pixel while its log-intensity is linear.

    Args:
        interval: log-intensity at its start and at its end, and these times.
        reference_log, reference_time: state of the pixel. The pixel has its reference if the time lies before the
            interval. Otherwise it takes its reference at that time, which may lie in a later interval.
        sensor: positive and negative threshold, and refractory period.
        packing, keys, position: see `_fire`.

    Returns:
        the new reference, its time, and the position after the last event.
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
        position = _fire(time, polarity > 0, packing, keys, position)
        if refractory_period > 0:
            # Counted from the rounded time stamp. The log-intensity then changed by exactly the threshold over the
            # interval [t_prev + refractory period, t] that a reader of the stream forms.
            reference_time = time + refractory_period
        else:
            reference_log = crossing_log
    return reference_log, reference_time, position


@numba.njit(cache=True)
def _pixel_events(
    interval, reference_log, reference_time, sensor, noise_times, noise_polarities, packing, keys, position
):
    """Fire the events of one pixel in one frame interval, which noise events cut into pieces.

    A noise event acts like any other: the pixel is blind for the refractory period, or takes the log-intensity of that
    moment as its reference. For the arguments and the values returned see `_linear_events`.
    """
    start_log, end_log, start_time, end_time = interval
    piece_log, piece_time = start_log, start_time
    for i in range(len(noise_times) + 1):
        time = noise_times[i] if i < len(noise_times) else end_time
        log = start_log + (end_log - start_log) * ((time - start_time) / (end_time - start_time))
        piece = piece_log, log if time < end_time else end_log, piece_time, time
        reference_log, reference_time, position = _linear_events(
            piece, reference_log, reference_time, sensor, packing, keys, position
        )
        piece_log, piece_time = log, time
        if i < len(noise_times) and reference_time < time:
            position = _fire(time, noise_polarities[i] > 0, packing, keys, position)
            reference_log = log
            if sensor[2] > 0:
                reference_time = time + sensor[2]
    return reference_log, reference_time, position


@numba.njit(cache=True)
def _frame_events(frames, times, references, thresholds, refractory_period, noise, bits):
    """Fire the events of all pixels in one frame interval: count them in one pass and write them in a second one.

    Args:
        frames, times: log-intensity (H, W) and time at the start and at the end.
        references: log-intensity and time (H, W) of the pixels' references, changed in place.
        thresholds: positive and negative (H, W).
        refractory_period: of all pixels.
        noise: pixels, times and polarities of noise events, sorted by pixel, row by row, then by time.
        bits: numbers of bits that hold x and y.

    Returns:
        keys that hold time, y, x and polarity, from the highest bits to the lowest. Sorting the keys orders the stream.
    """
    height, width = frames[0].shape
    x_bits, y_bits = bits
    noise_pixels, noise_times, noise_polarities = noise
    keys = np.empty(0, np.int64)
    position = 0
    for is_written in (False, True):
        if is_written:
            keys = np.empty(position, np.int64)
        position, last = 0, 0
        for y in range(height):
            for x in range(width):
                first = last
                while last < len(noise_pixels) and noise_pixels[last] == y * width + x:
                    last += 1
                log, time, position = _pixel_events(
                    (frames[0][y, x], frames[1][y, x], times[0], times[1]),
                    references[0][y, x],
                    references[1][y, x],
                    (thresholds[0][y, x], thresholds[1][y, x], refractory_period),
                    noise_times[first:last],
                    noise_polarities[first:last],
                    (times[0], x_bits + y_bits + 1, (y << x_bits | x) << 1),
                    keys,
                    position,
                )
                if is_written:
                    references[0][y, x], references[1][y, x] = log, time
    return keys


class EventSimulator:
    """Turn a sequence of linear-radiance frames into events.

    The sensor sees log(I + log_epsilon), which is linear in time between frames. A pixel fires when this signal differs
    from the pixel's reference by the contrast threshold. The reference then moves by exactly the threshold. With a
    refractory period, the pixel is blind until the period ends and takes the log-intensity of that moment as its new
    reference instead, as in Robust e-NeRF.

    Args:
        width, height: pixel columns and rows, at most 65536.
        sensor: contrast thresholds, refractory period and Bayer pattern. Initial reference times are random, uniform in
            [0, refractory period) after the first frame.
        noise: thresholds of single pixels are drawn once from N(C, contrast_threshold_spread) and clipped at 0.01. The
            leak makes the log-intensity rise by leak_rate · C+ a second. Shot noise falls with the intensity, to a
            quarter at 1 and above (v2e, Hu et al. 2021), and moves the reference as any event does.
        log_epsilon: added to the intensity before the logarithm.
        seed: of the thresholds, of the initial reference times, and of the noise.

    Example:
        One pixel whose radiance doubles in a millisecond: log-radiance rises by 0.69, and by 0.25 twice.

        >>> simulator = EventSimulator(1, 1, SensorModel(0.25, 0.25))
        >>> events = simulator([[0.1]], 0)
        >>> x, y, t, p = simulator([[0.2]], 1_000_000)
        >>> p
        array([1, 1], dtype=int8)
        >>> t
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
        self.shot_noise_rate = noise.shot_noise_rate
        self._bits = (width - 1).bit_length(), (height - 1).bit_length()
        self._channel_weights = np.array(LUMINANCE)
        if sensor.bayer_pattern:
            y, x = np.indices((height, width))
            self._channel_weights = np.eye(3)[sensor.color_filter[y & 1, x & 1]]
        self._leak = noise.leak_rate * sensor.positive_contrast_threshold * 1e-9
        self._rng = np.random.default_rng(seed)
        spread = noise.contrast_threshold_spread
        self.positive_contrast_threshold = self._draw_thresholds(sensor.positive_contrast_threshold, spread)
        self.negative_contrast_threshold = self._draw_thresholds(sensor.negative_contrast_threshold, spread)
        self._log_intensity: NDArray[np.float64] | None = None
        self._time_ns = 0

    def __call__(self, image: ArrayLike, time_ns: int) -> Events:
        """Show the sensor the next frame.

        Args:
            image: linear radiance (H, W), or linear RGB (H, W, 3), of which a monochrome sensor takes the Rec. 709
                luminance. A color sensor needs RGB.
            time_ns: time of the frame in nanoseconds, later than the previous frame's.

        Returns:
            x (N,) uint16, y (N,) uint16, t (N,) int64 in nanoseconds, p (N,) int8 of +1 or -1: the events in
            (previous frame, this frame], ordered by time, then by pixel. The first frame gives no events.

        Raises:
            ValueError: a wrong shape, a negative or non-finite radiance, or a time that does not increase.
        """
        intensity = self._to_intensity(np.asarray(image))
        time_ns = int(time_ns)
        if self._log_intensity is None:
            self._start_ns = self._time_ns = time_ns
        log_intensity = np.log(intensity + self.log_epsilon) + self._leak * (time_ns - self._start_ns)
        x_bits, y_bits = self._bits
        if self._log_intensity is None:
            self._reference_log = log_intensity.copy()
            self._reference_time = np.full(log_intensity.shape, time_ns, np.int64)
            if self.sensor.refractory_period > 0:
                self._reference_time += self._rng.integers(0, self.sensor.refractory_period, log_intensity.shape)
            keys = np.empty(0, np.int64)
        else:
            longest = np.iinfo(np.int64).max >> (x_bits + y_bits + 1)
            if not 0 < time_ns - self._time_ns <= longest:
                raise ValueError(
                    f"frame times must increase, by at most {longest} ns: got {time_ns} ns after {self._time_ns} ns"
                )
            keys = _frame_events(
                (self._log_intensity, log_intensity),
                (self._time_ns, time_ns),
                (self._reference_log, self._reference_time),
                (self.positive_contrast_threshold, self.negative_contrast_threshold),
                self.sensor.refractory_period,
                self._shot_noise(intensity, time_ns),
                self._bits,
            )
            keys.sort()
        events = (
            (keys >> 1 & (1 << x_bits) - 1).astype(np.uint16),
            (keys >> (1 + x_bits) & (1 << y_bits) - 1).astype(np.uint16),
            self._time_ns + (keys >> (1 + x_bits + y_bits)),
            (2 * (keys & 1) - 1).astype(np.int8),
        )
        self._log_intensity, self._time_ns = log_intensity, time_ns
        return events

    def _draw_thresholds(self, mean: float, spread: float) -> NDArray[np.float64]:
        thresholds = self._rng.normal(mean, spread, (self.height, self.width))
        return np.maximum(thresholds, _MIN_CONTRAST_THRESHOLD)

    def _shot_noise(self, intensity: NDArray[np.float64], time_ns: int) -> tuple[NDArray[np.int64], ...]:
        """Draw the shot-noise events of a frame interval: pixels, row by row, times and polarities."""
        seconds = (time_ns - self._time_ns) * 1e-9
        count = self._rng.poisson(self.shot_noise_rate * seconds * intensity.size)
        pixels = self._rng.integers(0, intensity.size, count)
        kept = self._rng.random(count) < 1 - _BRIGHT_REDUCTION * np.minimum(intensity.ravel()[pixels], 1)
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
        red, green, blue = np.moveaxis(image * self._channel_weights, -1, 0)
        return red + green + blue
