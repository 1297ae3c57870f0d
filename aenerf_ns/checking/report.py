"""The figures and the problems that ``aenerf check`` finds in a recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch

from aenerf_ns.camera.alignment import rotation_angle
from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.checking.contrast import WarpedEvents, num_slices, slice_size
from aenerf_ns.checking.hypotheses import Comparison
from aenerf_ns.events.filters import find_hot_pixels, hot_pixel_summary
from aenerf_ns.events.statistics import EventStatistics, event_statistics
from aenerf_ns.events.stream import EventStream
from aenerf_ns.progress import progress_bar, tracked
from aenerf_ns.recording.recording import Recording

_RATE_PARTS = 60
_BLOCKS = " ▁▂▃▄▅▆▇█"
_MAX_SHOWN = 5

# A figure beyond its limit is a problem.
_MIN_POLARITY_SHARE = 0.02
_MAX_REPEATED_SHARE = 0.05
_MAX_HOT_SHARE = 0.01
_MIN_COVERED_SHARE = 0.5
# A gap is longer than this many median intervals of the poses.
_GAP_FACTOR = 5
_MAX_GAP_SHARE = 0.01
_MIN_IN_BOX_SHARE = 0.5

# Contrast above that of the shuffled events by so many standard deviations and by this factor is not noise.
_NOISE_DEVIATIONS, _NOISE_FACTOR = 4.0, 1.5
# Of slices that clearly fit another meaning of the poses. With right poses there is none on the recordings of the
# tests, and with the poses of another path about half.
_MAX_ELSEWHERE_SHARE = 0.2
# Fewer events give no contrast.
_MIN_EVENTS = 2_000
# The depth of a tile with less than this share of the mean contrast is not trusted.
_MIN_TILE_CONTRAST = 0.5


class Report:
    """Look a recording over: its events, its poses, and whether the poses fit the events.

    Args:
        recording: the recording.
        window: the time that training uses.
        scale: scene units in a unit of the poses.
        say: called with each figure, a line of text, as soon as it is known.

    Attributes:
        problems: what is wrong with the recording and what to do about it, a line for each problem.
        planes: options of training, by name: a near and a far plane in scene units for a camera that stays as far from
            everything. Empty for a scene with a box, and where no depth is known.
        statistics: of all events.
        warped: the warped events, or None if too few events have a pose.

    Raises:
        DataError: the events cannot be read.
    """

    def __init__(self, recording: Recording, window: TimeWindow, scale: float, say: Callable[[str], None]) -> None:
        self._recording = recording
        self._window = window
        self._scale = scale
        self._say = say
        self.problems: list[str] = []
        self.planes: dict[str, str] = {}
        self.warped: WarpedEvents | None = None
        statistics, num_covered = self._count()
        self.statistics = statistics
        self._report_events(statistics)
        self._report_poses(statistics, num_covered)
        if num_covered < _MIN_EVENTS:
            say(f"Contrast of warped events: not computed, because only {num_covered} events have a pose.")
            return
        runs = self._read_runs(num_covered)
        with progress_bar() as progress:
            progress.add_task("Warping events", total=None)
            self.warped = WarpedEvents(runs, recording.trajectory, recording.event_camera)
            still, alternatives = self.warped.without_motion(), self.warped.comparisons()
            shuffled = self.warped.shuffled()
        fits = self._report_contrast(self.warped, still, alternatives, shuffled)
        # Poses that do not fit give wrong depths.
        self._report_motion(statistics, self._report_depth(self.warped) if fits else None)

    def _count(self) -> tuple[EventStatistics, int]:
        """Return statistics of the events, and the number of events that have a pose."""
        file = self._recording.event_file
        num_covered = 0

        def chunks() -> Iterator[EventStream]:
            nonlocal num_covered
            for chunk in tracked(file.chunks(), "Reading events", file.count()):
                num_covered += int(self._window.contains(chunk.t).sum())
                yield chunk

        statistics = event_statistics(chunks(), file.width, file.height, file.time_span(), _RATE_PARTS)
        return statistics, num_covered

    def _read_runs(self, num_covered: int) -> list[EventStream]:
        """Read runs of consecutive events that have a pose, evenly spread over all events that have one."""
        file, camera = self._recording.event_file, self._recording.event_camera
        count = num_slices(num_covered, camera)
        length = num_covered if count == 1 else slice_size(camera)
        begins = np.linspace(0, num_covered - length, count).astype(np.int64)
        parts: list[list[dict[str, np.ndarray]]] = [[] for _ in begins]
        position = 0
        for chunk in tracked(file.chunks(), "Choosing events", file.count()):
            covered = chunk[self._window.contains(chunk.t)]
            for part, begin in zip(parts, begins - position, strict=True):
                taken = covered[max(begin, 0) : max(begin + length, 0)]
                # Copies, because views would keep whole chunks in memory.
                part.append({name: getattr(taken, name).copy() for name in ("x", "y", "t", "p")})
            position += len(covered)
        return [
            EventStream(
                **{name: np.concatenate([columns[name] for columns in part]) for name in ("x", "y", "t", "p")},
                width=camera.width,
                height=camera.height,
                source=file.path,
            )
            for part in parts
        ]

    def _report_events(self, statistics: EventStatistics) -> None:
        count, seconds = statistics.num_events, max(statistics.end - statistics.start, 1) * 1e-9
        camera = self._recording.event_camera
        self._say(
            f"Events: {count:,} in {seconds:.3f} s (from {statistics.start} to {statistics.end} ns), "
            f"{count / seconds:,.0f} a second, {count / statistics.counts.size:.1f} a pixel of {camera.width} x "
            f"{camera.height}; {(statistics.counts == 0).mean():.1%} of the pixels have none"
        )
        rate = statistics.rate / seconds * _RATE_PARTS
        self._say(f"Rate over time, 0 to {rate.max():,.0f} events a second:\n  |{_histogram(statistics.rate)}|")
        positive = statistics.num_positive / count
        self._say(f"Polarity: {positive:.1%} positive")
        if not _MIN_POLARITY_SHARE < positive < 1 - _MIN_POLARITY_SHARE:
            self.problems.append(
                f"{positive:.1%} of the events are positive: check that the polarities were written as they were "
                "recorded"
            )
        repeated = statistics.num_repeated / count
        self._say(f"Events with the pixel and time of another: {repeated:.2%}")
        if repeated > _MAX_REPEATED_SHARE:
            self.problems.append(
                f"{repeated:.1%} of the events have the pixel and time of another: check that no events were written "
                "twice, and that their times kept all their digits"
            )
        hot = find_hot_pixels(statistics.counts)
        self._say(hot_pixel_summary(hot, statistics.counts))
        share = statistics.counts[hot].sum() / count
        if share > _MAX_HOT_SHARE:
            self.problems.append(
                f"hot pixels make {share:.1%} of the events: leave them out with aenerf convert --drop-hot-pixels"
            )

    def _report_poses(self, statistics: EventStatistics, num_covered: int) -> None:
        trajectory = self._recording.trajectory
        times = trajectory.times.numpy()
        intervals = np.diff(times)
        median = float(np.median(intervals))
        degrees = torch.rad2deg(rotation_angle(trajectory.camera_to_worlds[:-1], trajectory.camera_to_worlds[1:]))
        steps = trajectory.camera_to_worlds[..., 3].diff(dim=0).norm(dim=-1)
        self._say(
            f"Poses: {len(trajectory)} from {trajectory.start} to {trajectory.end} ns, {1e9 / median:.1f} a second; "
            f"between two of them at most {degrees.max():.2g} degrees and {steps.max():.2g} of their units; the path "
            f"is {steps.sum():.3g} long"
        )
        if self._recording.ground_truth is not None:
            self._say(f"True poses: {len(self._recording.ground_truth)}, for evaluation")
        covered = num_covered / statistics.num_events
        self._say(f"Events with a pose: {covered:.1%}")
        if covered < _MIN_COVERED_SHARE:
            self.problems.append(
                f"only {covered:.1%} of the events have a pose, the others are not used: check the clocks of events "
                "and poses, or cut the recording"
            )
        # The gaps of the window are known: they were told when the dataset was opened.
        known = np.isin(times[:-1], [first for first, _ in self._window.gaps])
        gaps = np.flatnonzero((intervals > _GAP_FACTOR * median) & ~known)
        if len(gaps):
            # The share is that of the sampled pairs, each counted at its later event.
            segment = np.searchsorted(times, statistics.pair_times[:, 1]) - 1
            share = float(np.isin(segment, gaps).mean()) if len(segment) else 0.0
            longest = gaps[np.argsort(-intervals[gaps], kind="stable")[:_MAX_SHOWN]]
            named = ", ".join(f"{intervals[i] * 1e-9:.3f} s after {times[i]} ns" for i in longest)
            self._say(f"Gaps between poses: {len(gaps)}, with {share:.1%} of the events; the longest: {named}")
            if share > _MAX_GAP_SHARE:
                self.problems.append(
                    f"{share:.1%} of the events fall in gaps between poses, where they are interpolated: give the "
                    "missing poses, or leave the gaps out (--max-pose-gap-ns of the dataparser)"
                )

    def _report_contrast(
        self, warped: WarpedEvents, still: Comparison, alternatives: list[Comparison], shuffled: np.ndarray
    ) -> bool:
        """Compare the given poses with the alternatives and with shuffled events.

        Returns:
            Whether the poses fit the events.
        """
        seconds = warped.seconds
        mean, deviation = float(shuffled.mean()), float(shuffled.std())
        self._say(
            f"Contrast of events warped by the poses (slices: {len(seconds)} of {np.median(seconds):.3f} s): "
            f"{still.given:.3f}; not warped: {still.contrast:.3f}; shuffled: {mean:.3f} +/- {deviation:.3f}"
        )
        noise = max(mean + _NOISE_DEVIATIONS * deviation, _NOISE_FACTOR * mean)
        for c in alternatives:
            if not c.hypothesis.clock_offset or c.is_clearly_better:
                self._say(f"  {c.contrast:.3f} (given {c.given:.3f}) if {c.hypothesis.name}")
        clocks = [c for c in alternatives if c.hypothesis.clock_offset and c.is_clearly_worse]
        if clocks:
            least = min(abs(c.hypothesis.clock_offset) for c in clocks) * 1e-9
            self._say(f"  clearly less if the clock of the poses is off by {least:g} s")
        better = [c for c in alternatives if c.is_clearly_better and c.contrast > noise]
        if better:
            best = better[0]
            same = [c for c in better[1:] if best.is_like(c) and not c.hypothesis.clock_offset]
            others = "".join(f"; or as if {c.hypothesis.name}: {c.hypothesis.remedy}" for c in same)
            self.problems.append(
                f"the events look as if {best.hypothesis.name} (contrast {best.contrast:.3f} instead of "
                f"{best.given:.3f}): {best.hypothesis.remedy}{others}"
            )
            return False
        untold = [c.hypothesis.name for c in alternatives if c.is_untold and not c.hypothesis.clock_offset]
        if untold:
            self._say(f"This motion cannot tell whether {', or '.join(untold)}.")
        if not still.is_clearly_worse:
            self.problems.append(
                "the poses do not sharpen the events, nor does any usual mistake explain it: check the intrinsics and "
                "the clock; or the camera moves too little to tell"
            )
            return False
        if still.given <= noise:
            self.problems.append(
                f"the events are hardly sharper than the same events in a random order (contrast {still.given:.3f}, "
                f"shuffled {mean:.3f} +/- {deviation:.3f}): they are noise, or the poses are of another recording: "
                "check the polarities, the order of the columns and the poses"
            )
            return False
        elsewhere = frozenset[int]().union(*(c.clear_slices for c in alternatives))
        if len(elsewhere) > _MAX_ELSEWHERE_SHARE * len(seconds):
            self.problems.append(
                f"{len(elsewhere)} of {len(seconds)} slices of the events clearly fit another meaning of the poses, "
                "and not all the same one: the poses are of another recording, or wrong in places"
            )
            return False
        return True

    def _report_depth(self, warped: WarpedEvents) -> float | None:
        """Report how far away the scene is, and whether the scene box holds it.

        Returns:
            The median depth in the unit of the poses, or None if no tile has a depth.
        """
        contrast = sum(s.energy.sum() for s in warped.given) / sum(s.brightness.sum() for s in warped.given)
        depths, points, weights = [], [], []
        for one in warped.given:
            trusted = (one.energy > _MIN_TILE_CONTRAST * contrast * one.brightness) & np.isfinite(one.depth)
            depths.append(one.depth[trusted])
            points.append(one.points[trusted])
            weights.append(one.energy[trusted])
        depth, point, weight = (np.concatenate(values) for values in (depths, points, weights))
        if len(depth) == 0:
            return None
        near, median, far = _quantiles(depth, weight, (0.03, 0.5, 0.97))
        low, high = (np.array([_quantiles(point[:, axis], weight, (q,))[0] for axis in range(3)]) for q in (0.03, 0.97))
        self._say(
            f"What is seen is {near:.3g} to {far:.3g} away, in units of the poses (median {median:.3g}), within "
            f"{low.round(3).tolist()} to {high.round(3).tolist()} of their world"
        )
        box, scale = self._recording.scene_box, self._scale
        if box is None:
            self.planes = {
                "pipeline.model.near-plane": f"{0.7 * near * scale:.2g}",
                "pipeline.model.far-plane": f"{10 * far * scale:.2g}",
            }
            self._say(f"Scene units: {scale:.3g} times those of the poses")
        else:
            inside = ((point >= box[0].numpy()) & (point <= box[1].numpy())).all(1)
            share = weight[inside].sum() / weight.sum()
            self._say(f"Within the scene box: {share:.1%} of it")
            if share < _MIN_IN_BOX_SHARE:
                self.problems.append(
                    f"the scene box holds only {share:.1%} of what is seen: state a larger scene_box, or none"
                )
        return median

    def _report_motion(self, statistics: EventStatistics, depth: float | None) -> None:
        """Report how far the camera moves from an event of a pixel to the next event of that pixel."""
        trajectory = self._recording.trajectory
        covered = TimeWindow(trajectory.start, trajectory.end)
        pairs = statistics.pair_times[covered.contains(statistics.pair_times).all(1)]
        if len(pairs) == 0:
            return
        before, after = (trajectory.interpolate(pairs[:, column]) for column in (0, 1))
        angles = rotation_angle(before, after).numpy()
        lengths = (after - before)[..., 3].norm(dim=-1).numpy()
        focal = self._recording.event_camera.fx
        pixels = angles * focal + (0 if depth is None else lengths * focal / depth)
        figures = []
        for name, share in (("median", 0.5), ("95 %", 0.95)):
            interval, angle, length, pixel = (
                float(np.quantile(values, share))
                for values in ((pairs[:, 1] - pairs[:, 0]) * 1e-6, angles, lengths, pixels)
            )
            figures.append(
                f"{name} {interval:.3g} ms, {np.degrees(angle):.2g} degrees, {length:.2g} units, {pixel:.2g} px"
            )
        self._say(f"Motion from an event of a pixel to its next: {'; '.join(figures)}")


def _histogram(values: np.ndarray) -> str:
    """Draw each value as one character; only 0 is blank."""
    levels = np.ceil(values / max(values.max(), 1) * (len(_BLOCKS) - 1)).astype(int)
    return "".join(_BLOCKS[level] for level in levels)


def _quantiles(values: np.ndarray, weights: np.ndarray, shares: tuple[float, ...]) -> list[float]:
    """Return the value below which each share of the weight lies."""
    order = np.argsort(values)
    cumulated = np.cumsum(weights[order])
    return [float(values[order][np.searchsorted(cumulated, share * cumulated[-1])]) for share in shares]
