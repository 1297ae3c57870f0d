"""Check the events alone: their number, polarities, thresholds, and where on the sensor they lie."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.checking.frames import FrameChanges
from aenerf_ns.checking.noise import NoiseRate
from aenerf_ns.checking.result import CheckResult
from aenerf_ns.checking.thresholds import PolarityBalance
from aenerf_ns.events.filters import find_hot_pixels, hot_pixel_summary
from aenerf_ns.recording.recording import Capture

_BLOCKS = " ▁▂▃▄▅▆▇█"
_MILLISECOND = 1_000_000
# Shares of the events beyond which something is wrong.
_MIN_POLARITY_SHARE, _MAX_REPEATED_SHARE, _MAX_HOT_PIXEL_SHARE = 0.02, 0.05, 0.01
# Of the polarities with the change from frame to frame.
_MIN_CORRELATION = -0.4
# Frames that fit the events less have another clock, or are too few, and tell no size of the thresholds.
_MIN_FIT = 0.6
# A ratio of the thresholds that differs from the estimate by so many times its uncertainty is clearly another.
_THRESHOLD_DEVIATIONS = 2.0
# Share of the events at each side that does not count for the extent of the events.
_OUTLIER_SHARE = 1e-3
# Events that begin at the corner, within the first share of the sensor, and end within the second do not fill it.
_CORNER_SHARE, _FILLED_SHARE = 0.02, 0.75
# Nor do events that end within this share, wherever they begin: what is in the middle reaches beyond it.
_HALF_SHARE = 0.52
# By the width of the sensor. No lens of an event camera is wider or longer.
_FOCAL_LENGTHS = (0.15, 30.0)
# Distance of the principal point from the middle, as a share of the sensor.
_MAX_PRINCIPAL_POINT = 0.2
# The times of fewer events are whole milliseconds by chance.
_MIN_PAIRS = 2_000


def check_events(result: CheckResult, noise: NoiseRate, bayer_pattern: str | None) -> None:
    """Describe the events, and look for repeated ones, coarse times and hot pixels."""
    statistics, figures, problems = result.statistics, result.figures, result.problems
    count, seconds = statistics.num_events, max(statistics.end - statistics.start, 1) * 1e-9
    height, width = statistics.counts.shape
    figures.append(
        f"Events: {count:,} in {seconds:.3f} s (from {statistics.start} to {statistics.end} ns), "
        f"{count / seconds:,.0f} a second, {count / statistics.counts.size:.1f} a pixel of {width} x {height}; "
        f"{(statistics.counts == 0).mean():.1%} of the pixels have none"
    )
    highest = max(result.events_per_second)
    figures.append(f"Rate over time, 0 to {highest:,.0f} events a second:\n  |{_histogram(statistics.rate)}|")
    positive = statistics.num_positive / count
    figures.append(f"Polarity: {positive:.1%} positive")
    if not _MIN_POLARITY_SHARE < positive < 1 - _MIN_POLARITY_SHARE:
        problems.append(
            f"{positive:.1%} of the events are positive: check that the polarities were written as they were recorded"
        )
    repeated = statistics.num_repeated / count
    figures.append(f"Events with the pixel and time of another: {repeated:.2%}")
    if repeated > _MAX_REPEATED_SHARE:
        problems.append(
            f"{repeated:.1%} of the events have the pixel and time of another: check that no events were written "
            "twice, and that their times kept all their digits"
        )
    pairs = statistics.pair_times - statistics.start
    if len(pairs) >= _MIN_PAIRS and (pairs % _MILLISECOND == 0).all():
        problems.append(
            "all times of events are whole milliseconds: the camera's have microseconds, which tell the order of the "
            "events; write them with all their digits"
        )
    hot = find_hot_pixels(statistics.counts, bayer_pattern)
    figures.append(hot_pixel_summary(hot, statistics.counts))
    noise_rate = noise.rate(hot)
    if noise_rate is not None:
        noise_share = min(noise_rate * seconds * statistics.counts.size / count, 1)
        figures.append(f"Noise: at most {noise_rate:.2g} events a second a pixel, {noise_share:.1%} of all")
    share = statistics.counts[hot].sum() / count
    if share > _MAX_HOT_PIXEL_SHARE:
        problems.append(
            f"hot pixels make {share:.1%} of the events: leave them out with aenerf convert --drop-hot-pixels"
        )


def check_polarity(result: CheckResult, correlation: float | None) -> None:
    """Compare the polarities with the change from frame to frame, where there are frames."""
    if correlation is None:
        return
    result.figures.append(f"Correlation of the polarities with the change from frame to frame: {correlation:+.2f}")
    if correlation < _MIN_CORRELATION:
        result.problems.append(
            f"events fall where the frames become brighter (correlation {correlation:+.2f}): the polarities look "
            "reversed. Write p as -p, unless the frames are negatives or have another clock"
        )


def check_thresholds(
    result: CheckResult, capture: Capture, changes: FrameChanges, balance: PolarityBalance, correlation: float
) -> None:
    """Estimate the contrast thresholds and the bandwidth."""
    estimate, sensor = balance.ratio(), capture.sensor
    if estimate is None:
        return
    ratio, uncertainty = estimate
    used = sensor.positive_contrast_threshold / sensor.negative_contrast_threshold
    figure = f"Contrast thresholds: C+/C- is {ratio:.2f} +/- {uncertainty:.2f} by the balance of the polarities"
    figure += f" ({'assumed' if capture.has_assumed_thresholds else 'given'}: {used:.2f})"
    if correlation > _MIN_FIT:
        size, low, high = changes.negative_threshold(ratio)
        figure += f"; by the frames, C- is {size:.2f} ({low:.2f} to {high:.2f}) and C+ {ratio * size:.2f}"
    # Reversed polarities reverse the ratio.
    is_reversed = correlation < _MIN_CORRELATION
    if abs(ratio - used) > _THRESHOLD_DEVIATIONS * uncertainty and not is_reversed:
        value = f"{ratio * sensor.negative_contrast_threshold:.3g}"
        if capture.has_assumed_thresholds:
            result.sensor_options = {"positive-contrast-threshold": value}
        else:
            figure += f". If the given ones were a guess, give the format --positive-contrast-threshold {value}"
    result.figures.append(figure)
    bandwidth = changes.bandwidth(ratio) if correlation > _MIN_FIT else None
    if bandwidth is not None:
        frequency, low, high = bandwidth
        given = f"given: {sensor.bandwidth:.0f}" if sensor.bandwidth > 0 else "to state it: --bandwidth-hz"
        result.figures.append(
            f"Bandwidth at the mean radiance, by the frames: {frequency:.0f} Hz ({low:.0f} to {high:.0f}; {given})"
        )


def check_principal_point(result: CheckResult, camera: CameraIntrinsics) -> None:
    """Compare the principal point with the middle of the sensor."""
    if _is_off_center(camera):
        result.problems.append(
            f"the principal point ({camera.cx:g}, {camera.cy:g}) is far from the middle of {camera.width} x "
            f"{camera.height} pixels, as of another resolution: check the intrinsics, unless this is a part of a "
            "larger sensor"
        )


def _is_off_center(camera: CameraIntrinsics) -> bool:
    shares = camera.cx / camera.width, camera.cy / camera.height
    return any(abs(share - 0.5) > _MAX_PRINCIPAL_POINT for share in shares)


def check_lens(result: CheckResult, camera: CameraIntrinsics) -> None:
    """Compare the lens with the sensor and with where the events are."""
    height, width = result.statistics.counts.shape
    # A hot pixel may lie anywhere.
    rows, columns = (
        np.searchsorted(np.cumsum(counts), np.array([_OUTLIER_SHARE, 1 - _OUTLIER_SHARE]) * counts.sum())
        for counts in (result.statistics.counts.sum(1), result.statistics.counts.sum(0))
    )
    begin, end = (np.array([columns[i] / width, rows[i] / height]) for i in (0, 1))
    if (end < _HALF_SHARE).all() or ((begin < _CORNER_SHARE).all() and end.min() < _FILLED_SHARE):
        result.problems.append(
            f"all events lie in the first {columns[1] + 1} x {rows[1] + 1} of {width} x {height} pixels: if they were "
            "binned or cropped, give the intrinsics of that size (binned by 2: half the focal lengths and the "
            "principal point)"
        )
    point = camera.cx, camera.cy
    if not _is_off_center(camera) and math.dist(point, (height / 2, width / 2)) < math.dist(
        point, (width / 2, height / 2)
    ):
        result.problems.append(
            f"the principal point ({camera.cx:g}, {camera.cy:g}) seems to have x and y swapped, for {width} x {height} "
            "pixels: check the intrinsics"
        )
    low, high = _FOCAL_LENGTHS
    if not low * width < camera.fx < high * width:
        result.problems.append(
            f"a focal length of {camera.fx:g} pixels is {camera.fx / width:.2g} times the width of the sensor: give it "
            "in pixels (millimeters by the size of a pixel)"
        )


def _histogram(values: NDArray[np.int64]) -> str:
    """Draw each value as one character; only 0 is blank."""
    levels = np.ceil(values / max(values.max(), 1) * (len(_BLOCKS) - 1)).astype(int)
    return "".join(_BLOCKS[level] for level in levels)
