"""What ``aenerf check`` finds in a recording: figures and problems."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from aenerf_ns.camera.alignment import rotation_angle
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.checking.contrast import WarpedEvents, choose_runs, contrast_of, longest_stretches
from aenerf_ns.checking.frames import FrameChanges
from aenerf_ns.checking.noise import NoiseRate
from aenerf_ns.checking.thresholds import PolarityBalance
from aenerf_ns.events.filters import find_hot_pixels, hot_pixel_summary
from aenerf_ns.events.statistics import EventStatistics, event_statistics
from aenerf_ns.events.stream import EventStream
from aenerf_ns.progress import progress_bar, tracked
from aenerf_ns.recording.poses_report import read_poses_report
from aenerf_ns.recording.recording import Recording

_RATE_PARTS = 60
_BLOCKS = " ▁▂▃▄▅▆▇█"
_MAX_GAPS_SHOWN = 5
_MILLISECOND = 1_000_000


# Shares of the events beyond which something is wrong.
_MIN_POLARITY_SHARE, _MAX_REPEATED_SHARE, _MAX_HOT_PIXEL_SHARE = 0.02, 0.05, 0.01
# Of the polarities with the change from frame to frame.
_MIN_CORRELATION = -0.4
# A ratio of the thresholds that differs from the estimate by so many times its uncertainty is clearly another.
_THRESHOLD_DEVIATIONS = 2.0
# Share of the events that have a pose, and of what is seen that is in the scene box.
_MIN_COVERED_SHARE, _MIN_IN_BOX_SHARE = 0.5, 0.5
# A gap is longer than this many median intervals of the poses. This share of the events may fall in gaps, and of the
# time in gaps with less than this share of the mean rate.
_GAP_FACTOR, _MAX_GAP_SHARE, _MIN_GAP_RATE = 5, 0.01, 0.01
# Contrast above that of the shuffled events by these standard deviations and by this factor is not noise.
_NOISE_DEVIATIONS, _NOISE_FACTOR = 4.0, 1.5
# One slice alone gives no verdict.
_MIN_SLICES = 2
# Nor do two or three about the clock: of the many offsets that are tried, one fits a hand's shaking by chance.
_MIN_CLOCK_SLICES = 4
# Share of the slices that, each by itself, must clearly fit another meaning of the poses for it to be named.
_MIN_SHARE_IN_FAVOR = 0.5
# Share of the slices that clearly fit another meaning of the poses, and not all the same one. With the poses of another
# path it is about half.
_MAX_ELSEWHERE_SHARE = 0.3
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
# Poses that differ by less are equal. This share of the events may fall between equal poses.
_EQUAL_POSES, _MAX_STILL_SHARE = 1e-12, 0.05
# A jump is faster than the steps around it, and than the median, by this factor.
_JUMP_FACTOR = 5
# Scene units to what is seen, or their inverse: poses in millimeters, or a short path that was scaled to one unit.
_MAX_DISTANCE = 50
# Fewer events give no contrast.
_MIN_EVENTS = 2_000
# The depth of a tile with less than this share of the mean contrast is not trusted.
_MIN_TILE_CONTRAST = 0.5


@dataclass
class CheckResult:
    """What a check finds.

    Attributes:
        statistics: of all events.
        figures: what was measured, in words: a text for each figure.
        problems: what is wrong with the recording and what to do about it, a line for each problem.
        planes: options of training, by name: a near and a far plane in scene units for a camera that stays equally far
            from everything. Empty for a scene with a box, and where no depth is known.
        sensor_options: options of the dataset's format, by name: a threshold in place of a guessed one.
        warped: the warped events, or None if too few events have a pose.
    """

    statistics: EventStatistics
    figures: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    planes: dict[str, str] = field(default_factory=dict)
    sensor_options: dict[str, str] = field(default_factory=dict)
    warped: WarpedEvents | None = None

    @property
    def events_per_second(self) -> list[float]:
        """Rate of the events in equal parts of their time."""
        counted = self.statistics
        return (counted.rate * (len(counted.rate) / max(counted.end - counted.start, 1) * 1e9)).tolist()


def check(recording: Recording, window: TimeWindow, scale: float) -> CheckResult:
    """Check a recording: its events, its poses, and whether the poses fit the events.

    Args:
        recording: the recording.
        window: the time that training uses.
        scale: scene units in a unit of the poses.

    Raises:
        DataError: the events cannot be read.
    """
    changes = FrameChanges(recording, window)
    balance = PolarityBalance(recording.event_file, recording.sensor.refractory_period)
    noise = NoiseRate(recording.event_file.width, recording.event_file.height)
    statistics, num_covered = _count_events(recording, window, changes, balance, noise)
    result = CheckResult(statistics)
    _check_events(result, noise, recording.sensor.bayer_pattern)
    correlation = changes.correlation()
    _check_polarity(result, correlation)
    _check_thresholds(result, recording, changes, balance, correlation or 0.0)
    _check_poses(result, recording, window, num_covered)
    num_problems = len(result.problems)
    _check_lens(result, recording.event_camera)
    _check_steps(result, recording.trajectory, window)
    is_simple = len(result.problems) > num_problems
    # The events are read once more only where there can be enough.
    runs = _read_runs(recording, window, num_covered) if num_covered >= _MIN_EVENTS else []
    runs = longest_stretches(runs, window, _MIN_EVENTS)
    if not runs:
        result.figures.append(
            f"Contrast of warped events: not computed, because no {_MIN_EVENTS} events have poses without a gap."
        )
        return result
    with progress_bar() as progress:
        progress.add_task("Warping events", total=None)
        result.warped = WarpedEvents(runs, recording.trajectory, recording.event_camera)
        poses_fit = _check_contrast(result, result.warped, is_simple)
    # Poses that do not fit give wrong depths.
    depth = _check_depth(result, result.warped, recording, scale) if poses_fit else None
    _describe_motion(result, recording, depth)
    return result


def _count_events(
    recording: Recording, window: TimeWindow, changes: FrameChanges, balance: PolarityBalance, noise: NoiseRate
) -> tuple[EventStatistics, int]:
    """Return statistics of the events, and the number of events that have a pose; hand all on to the other three."""
    file = recording.event_file
    num_covered = 0

    def chunks() -> Iterator[EventStream]:
        nonlocal num_covered
        for chunk in tracked(file.chunks(), "Reading events", file.count()):
            num_covered += int(window.contains(chunk.t).sum())
            changes.add(chunk, balance.add(chunk))
            noise.add(chunk)
            yield chunk

    statistics = event_statistics(chunks(), file.width, file.height, file.time_span(), _RATE_PARTS)
    return statistics, num_covered


def _read_runs(recording: Recording, window: TimeWindow, num_covered: int) -> list[EventStream]:
    """Read runs of consecutive events that have a pose, evenly spread over all events that have one."""
    file, camera = recording.event_file, recording.event_camera
    begins, length = choose_runs(num_covered, camera)
    parts: list[list[EventStream]] = [[] for _ in begins]
    position = 0
    for chunk in tracked(file.chunks(), "Choosing events", file.count()):
        covered = chunk[window.contains(chunk.t)]
        for part, begin in zip(parts, begins - position, strict=True):
            # Indices make a copy: a slice would keep the whole chunk in memory.
            part.append(covered[np.arange(len(covered))[max(begin, 0) : max(begin + length, 0)]])
        position += len(covered)
    return [EventStream.concatenate(part) for part in parts if part]


def _check_events(result: CheckResult, noise: NoiseRate, bayer_pattern: str | None) -> None:
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
    if len(pairs) >= _MIN_EVENTS and (pairs % _MILLISECOND == 0).all():
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


def _check_polarity(result: CheckResult, correlation: float | None) -> None:
    if correlation is None:
        return
    result.figures.append(f"Correlation of the polarities with the change from frame to frame: {correlation:+.2f}")
    if correlation < _MIN_CORRELATION:
        result.problems.append(
            f"events fall where the frames become brighter (correlation {correlation:+.2f}): the polarities look "
            "reversed. Write p as -p, unless the frames are negatives or have another clock"
        )


def _check_thresholds(
    result: CheckResult, recording: Recording, changes: FrameChanges, balance: PolarityBalance, correlation: float
) -> None:
    """Estimate the contrast thresholds."""
    estimate, sensor = balance.ratio(), recording.sensor
    if estimate is None:
        return
    ratio, uncertainty = estimate
    used = sensor.positive_contrast_threshold / sensor.negative_contrast_threshold
    figure = f"Contrast thresholds: C+/C- is {ratio:.2f} +/- {uncertainty:.2f} by the balance of the polarities"
    figure += f" ({'assumed' if recording.has_assumed_thresholds else 'given'}: {used:.2f})"
    if correlation > 0:
        size, low, high = changes.negative_threshold(ratio)
        figure += f"; by the frames, C- is {size:.2f} ({low:.2f} to {high:.2f}) and C+ {ratio * size:.2f}"
    # Reversed polarities reverse the ratio.
    is_reversed = correlation < _MIN_CORRELATION
    if abs(ratio - used) > _THRESHOLD_DEVIATIONS * uncertainty and not is_reversed:
        value = f"{ratio * sensor.negative_contrast_threshold:.3g}"
        if recording.has_assumed_thresholds:
            result.sensor_options = {"positive-contrast-threshold": value}
        else:
            figure += f". If the given ones were a guess, give the format --positive-contrast-threshold {value}"
    result.figures.append(figure)


def _check_poses(result: CheckResult, recording: Recording, window: TimeWindow, num_covered: int) -> None:
    statistics, figures, problems = result.statistics, result.figures, result.problems
    trajectory = recording.trajectory
    times = trajectory.times.numpy()
    intervals = np.diff(times)
    median = float(np.median(intervals))
    degrees = torch.rad2deg(rotation_angle(trajectory.camera_to_worlds[:-1], trajectory.camera_to_worlds[1:]))
    steps = trajectory.camera_to_worlds[..., 3].diff(dim=0).norm(dim=-1)
    figures.append(
        f"Poses: {len(trajectory)} from {trajectory.start} to {trajectory.end} ns, {1e9 / median:.1f} a second; "
        f"between two of them at most {degrees.max():.2g} degrees and {steps.max():.2g} of their units; the path "
        f"is {steps.sum():.3g} long"
    )
    estimation = read_poses_report(trajectory)
    if estimation is not None:
        figures.append(f"How they were found: {estimation.summary}")
    if recording.intrinsics_origin == "estimated":
        figures.append(f"The intrinsics were estimated with the poses: {recording.event_camera.summary()}")
    if recording.ground_truth is not None:
        figures.append(f"True poses: {len(recording.ground_truth)}, for evaluation")
    covered = num_covered / statistics.num_events
    figures.append(f"Events with a pose: {covered:.1%}")
    if covered < _MIN_COVERED_SHARE:
        problems.append(
            f"only {covered:.1%} of the events have a pose, the others are not used: check the clocks of events and "
            "poses, or cut the recording"
        )
    # The gaps of the window were already reported when the dataset was opened.
    known = np.isin(times[:-1], [first for first, _ in window.gaps])
    gaps = np.flatnonzero((intervals > _GAP_FACTOR * median) & ~known)
    if len(gaps):
        # The shares are those of the sampled pairs, each counted at its later event.
        segment = np.searchsorted(times, statistics.pair_times[:, 1]) - 1
        shares = np.bincount(segment + 1, minlength=len(times) + 1)[gaps + 1] / max(len(segment), 1)
        time_shares = np.diff(times.clip(window.start, window.end))[gaps] / (window.end - window.start)
        share = shares.sum()
        # Pairs of events span what lies between two recordings that were joined. A slow camera has some events, and a
        # camera that rests goes on from where it was.
        has_moved = ((steps > _JUMP_FACTOR * steps.median()) | (degrees > _JUMP_FACTOR * degrees.median())).numpy()
        empty_share = time_shares[(shares < _MIN_GAP_RATE * time_shares) & has_moved[gaps]].sum()
        longest = gaps[np.argsort(-intervals[gaps], kind="stable")[:_MAX_GAPS_SHOWN]]
        named = ", ".join(f"{intervals[i] * 1e-9:.3f} s after {times[i]} ns" for i in longest)
        figures.append(f"Gaps between poses: {len(gaps)}, with {share:.1%} of the events; the longest: {named}")
        where = ""
        if share > _MAX_GAP_SHARE:
            where = f"{share:.1%} of the events fall in gaps between poses"
        elif empty_share > _MAX_GAP_SHARE:
            where = f"{empty_share:.1%} of the time are in gaps between poses without events, as of joined recordings"
        if where:
            problems.append(
                f"{where}, where poses are interpolated: give the missing poses, or leave the gaps out "
                "(--max-pose-gap-ns of the dataparser)"
            )


def _check_lens(result: CheckResult, camera: CameraIntrinsics) -> None:
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
    shares = camera.cx / width, camera.cy / height
    if any(abs(share - 0.5) > _MAX_PRINCIPAL_POINT for share in shares):
        result.problems.append(
            f"the principal point ({camera.cx:g}, {camera.cy:g}) is far from the middle of {width} x {height} pixels, "
            "as of another resolution: check the intrinsics, unless this is a part of a larger sensor"
        )
    elif math.dist(point, (height / 2, width / 2)) < math.dist(point, (width / 2, height / 2)):
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


def _check_steps(result: CheckResult, trajectory: Trajectory, window: TimeWindow) -> None:
    """Look for poses that stand still while there are events, or jump."""
    times, poses = trajectory.times.numpy(), trajectory.camera_to_worlds
    still = np.flatnonzero(((poses[1:] - poses[:-1]).abs().flatten(1).amax(1) < _EQUAL_POSES).numpy())
    segment = np.searchsorted(times, result.statistics.pair_times[:, 1]) - 1
    share = float(np.isin(segment, still).mean()) if len(segment) else 0.0
    if share > _MAX_STILL_SHARE:
        result.problems.append(
            f"{share:.1%} of the events fall between poses that are equal (the first at {times[still[0]]} ns): "
            "tracking may have been lost there, or poses were repeated; leave these poses out, and see "
            "--max-pose-gap-ns"
        )
    seconds = np.diff(times) * 1e-9
    jumps = np.zeros(len(seconds), bool)
    for steps in (rotation_angle(poses[:-1], poses[1:]), poses[..., 3].diff(dim=0).norm(dim=-1)):
        rates = steps.numpy() / seconds
        padded = np.pad(rates, 3, mode="edge")
        around = np.max([padded[3 + k : 3 + k + len(rates)] for k in (-3, -2, 2, 3)], 0)
        jumps |= (rates > _JUMP_FACTOR * around) & (rates > _JUMP_FACTOR * np.median(rates))
    jumps &= window.contains(times[:-1]) & window.contains(times[1:])
    if jumps.any():
        result.problems.append(
            f"the poses jump (steps: {jumps.sum()}, the first after {times[:-1][jumps][0]} ns): tracking may have been "
            "lost there, or placeholders stand among the poses; leave these poses out"
        )


def _check_contrast(result: CheckResult, warped: WarpedEvents, is_simple: bool) -> bool:
    """Compare the given poses with the alternatives and with shuffled events, and return whether the poses fit.

    ``is_simple`` says that a simpler problem was found, which may be the reason of all that this finds.
    """
    still, alternatives = warped.compare_without_motion(), warped.compare_alternatives()
    shuffled = warped.shuffled_contrasts()
    figures, problems = result.figures, result.problems
    mean, deviation = float(shuffled.mean()), float(shuffled.std())
    num_slices, seconds = len(warped.spans), np.median([end - start for start, end in warped.spans]) * 1e-9
    figures.append(
        f"Contrast of events warped by the poses (slices: {num_slices} of {seconds:.3f} s): {still.given:.3f}; "
        f"not warped: {still.contrast:.3f}; shuffled: {mean:.3f} +/- {deviation:.3f}"
    )
    for c in alternatives:
        if not c.hypothesis.is_of_series or c.is_clearly_better:
            figures.append(f"  {c.contrast:.3f} (given {c.given:.3f}) if {c.hypothesis.name}")
    clocks = [c.hypothesis.clock_offset for c in alternatives if c.hypothesis.clock_offset and c.is_clearly_worse]
    if clocks:
        figures.append(f"  clearly less if the clock of the poses is off by {min(map(abs, clocks)) * 1e-9:g} s")
    noise = max(mean + _NOISE_DEVIATIONS * deviation, _NOISE_FACTOR * mean)
    if is_simple or num_slices < _MIN_SLICES:
        reason = "what is wrong above" if is_simple else "too few events"
        figures.append(f"Because of {reason}, the contrast does not tell whether poses, lens and clock are right.")
        return not is_simple
    better = [
        c
        for c in alternatives
        if c.is_clearly_better
        and c.contrast > noise
        and len(c.slices_in_favor)
        >= max(
            _MIN_CLOCK_SLICES if c.hypothesis.clock_offset else _MIN_SLICES,
            _MIN_SHARE_IN_FAVOR * num_slices,
        )
    ]
    if better:
        best = better[0]
        same = [c for c in better[1:] if best.is_like(c) and not c.hypothesis.is_of_series]
        others = "".join(f"; or as if {c.hypothesis.name}: {c.hypothesis.remedy}" for c in same)
        problems.append(
            f"the events look as if {best.hypothesis.name} (contrast {best.contrast:.3f} instead of {best.given:.3f}, "
            f"clearly in {len(best.slices_in_favor)} of {num_slices} slices). First make sure of the lens and the size "
            f"of the sensor. If that may be, {best.hypothesis.remedy}{others}"
        )
        return False
    undecided = [c.hypothesis for c in alternatives if c.is_inconclusive and not c.hypothesis.clock_offset]
    inconclusive = [hypothesis.name for hypothesis in undecided if not hypothesis.is_of_series]
    factors = sorted(hypothesis.focal_factor for hypothesis in undecided if hypothesis.is_of_series)
    if factors:
        inconclusive.append(f"the focal lengths are {' or '.join(map('{:g}'.format, factors))} times the given ones")
    if inconclusive:
        figures.append(f"This motion cannot tell whether {', or '.join(inconclusive)}.")
    in_favor_of_others = frozenset[int]().union(*(c.slices_in_favor for c in alternatives))
    if not still.is_clearly_worse:
        problems.append(
            "the poses do not sharpen the events, nor does any usual mistake explain it: check the intrinsics and the "
            "clock; or the camera moves too little to tell"
        )
    elif still.given <= noise:
        problems.append(
            f"the events are hardly sharper than the same events in a random order (contrast {still.given:.3f}, "
            f"shuffled {mean:.3f} +/- {deviation:.3f}): they are noise, or the poses are of another recording: check "
            "the polarities, the order of the columns and the poses"
        )
    elif len(in_favor_of_others) > max(_MAX_ELSEWHERE_SHARE * num_slices, _MIN_CLOCK_SLICES - 1):
        problems.append(
            f"{len(in_favor_of_others)} of {num_slices} slices of the events clearly fit another meaning of the poses, "
            "and not all the same one: the poses are of another recording, or wrong in places"
        )
    else:
        return True
    return False


def _check_depth(result: CheckResult, warped: WarpedEvents, recording: Recording, scale: float) -> float | None:
    """Describe how far away the scene is, and check that the scene box holds it.

    Returns:
        The median depth in the unit of the poses, or None if no tile has a depth.
    """
    energy, brightness, depth, point = (
        np.stack([getattr(part, name) for part in warped.given]) for name in ("energy", "brightness", "depth", "points")
    )
    trusted = (energy > _MIN_TILE_CONTRAST * contrast_of(warped.given) * brightness) & np.isfinite(depth)
    weight, depth, point = energy[trusted], depth[trusted], point[trusted]
    if len(depth) == 0:
        return None
    near, median, far = _quantiles(depth, weight, (0.03, 0.5, 0.97))
    low, high = np.array([_quantiles(column, weight, (0.03, 0.97)) for column in point.T]).T
    result.figures.append(
        f"What is seen is {near:.3g} to {far:.3g} away, in units of the poses (median {median:.3g}), within "
        f"{low.round(3).tolist()} to {high.round(3).tolist()} of their world"
    )
    box = recording.scene_box
    if box is None:
        result.planes = {
            "pipeline.model.near-plane": f"{0.7 * near * scale:.2g}",
            "pipeline.model.far-plane": f"{10 * far * scale:.2g}",
        }
        result.figures.append(f"Scene units: {scale:.3g} times those of the poses")
        if not 1 / _MAX_DISTANCE < median * scale < _MAX_DISTANCE:
            result.problems.append(
                f"what is seen is {median * scale:.2g} scene units away, where training resolves little: give the "
                f"format --auto-scale-poses False --scale-factor {1 / median:.1g}, which brings it to about 1, and let "
                "the check tell the planes for that (--format-options auto-scale-poses=False scale-factor=...)"
            )
    else:
        inside = ((point >= box[0].numpy()) & (point <= box[1].numpy())).all(1)
        share = weight[inside].sum() / weight.sum()
        result.figures.append(f"Within the scene box: {share:.1%} of it")
        if share < _MIN_IN_BOX_SHARE and len(warped.given) >= _MIN_SLICES:
            result.problems.append(
                f"the scene box holds only {share:.1%} of what is seen: state a larger scene_box, or none"
            )
    return median


def _describe_motion(result: CheckResult, recording: Recording, depth: float | None) -> None:
    """Describe how far the camera moves from an event of a pixel to the next event of that pixel."""
    trajectory, focal = recording.trajectory, recording.event_camera.fx
    covered = TimeWindow(trajectory.start, trajectory.end)
    pairs = result.statistics.pair_times
    pairs = pairs[covered.contains(pairs).all(1)]
    if len(pairs) == 0:
        return
    before, after = (trajectory.interpolate(times) for times in pairs.T)
    angles = rotation_angle(before, after).numpy()
    lengths = (after - before)[..., 3].norm(dim=-1).numpy()
    pixels = angles * focal + (0 if depth is None else lengths * focal / depth)
    columns = ((pairs[:, 1] - pairs[:, 0]) * 1e-6, angles, lengths, pixels)
    described = []
    for name, share in (("median", 0.5), ("95 %", 0.95)):
        interval, angle, length, pixel = (float(np.quantile(values, share)) for values in columns)
        described.append(
            f"{name} {interval:.3g} ms, {np.degrees(angle):.2g} degrees, {length:.2g} units, {pixel:.2g} px"
        )
    result.figures.append(f"Motion from an event of a pixel to its next: {'; '.join(described)}")


def _histogram(values: NDArray[np.int64]) -> str:
    """Draw each value as one character; only 0 is blank."""
    levels = np.ceil(values / max(values.max(), 1) * (len(_BLOCKS) - 1)).astype(int)
    return "".join(_BLOCKS[level] for level in levels)


def _quantiles(values: NDArray[np.float64], weights: NDArray[np.float64], shares: tuple[float, ...]) -> list[float]:
    """Return the value below which each share of the weight lies."""
    order = np.argsort(values)
    cumulated = np.cumsum(weights[order])
    return [float(values[order][np.searchsorted(cumulated, share * cumulated[-1])]) for share in shares]
