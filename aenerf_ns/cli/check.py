"""``aenerf check``: whether a dataset is what it says it is."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image

from aenerf_ns.camera.alignment import rotation_angle
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.checking.contrast import Comparison, WarpedEvents, num_slices, slice_size
from aenerf_ns.cli.dataset_format import Automatic, DatasetFormat, open_dataset
from aenerf_ns.errors import DataError
from aenerf_ns.events.filters import find_hot_pixels, hot_pixel_summary
from aenerf_ns.events.picture import polarity_picture
from aenerf_ns.events.statistics import EventStatistics, event_statistics
from aenerf_ns.events.stream import EventFile, EventStream
from aenerf_ns.events.time_window import TimeWindow
from aenerf_ns.progress import progress_bar
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.recording import Recording
from aenerf_ns.recording.scene import SCENE

_RATE_PARTS = 60
_BLOCKS = " ▁▂▃▄▅▆▇█"
_MAX_SHOWN = 5

# Limits beyond which a figure is a problem.
_MIN_POLARITY_SHARE = 0.02
_MAX_REPEATED_SHARE = 0.05
_MAX_HOT_SHARE = 0.01
_MIN_COVERED_SHARE = 0.5
# A gap is longer than this many median intervals of the poses.
_GAP_FACTOR = 5
_MAX_GAP_SHARE = 0.01
_MIN_IN_BOX_SHARE = 0.5

# Fewer events give no contrast.
_MIN_EVENTS = 2_000
# Tiles with less than this share of the whole contrast have no depth to be trusted.
_MIN_TILE_CONTRAST = 0.5
_PICTURE_HEIGHT = 480


@dataclass
class Check:
    """Look a dataset over: its events, its poses, and whether the two fit each other. Exit status 0 if all is well, 1
    if there are problems, 2 if it cannot be read. Options of a format come after its name; by default the format is
    recognised."""

    data: Path
    """The dataset."""
    picture: Path | None = None
    """PNG file to write: events as they came, and warped to one view by the poses."""
    format: DatasetFormat = field(default_factory=Automatic)

    def main(self) -> None:
        """Prints what it finds, and ends the process with a status other than 0 unless all is well."""
        try:
            problems = self._check(open_dataset(self.data, self.format))
        except DataError as error:
            print(f"Error: {error}", file=sys.stderr)
            sys.exit(2)
        if problems:
            _print(f"\n{len(problems)} {'problem' if len(problems) == 1 else 'problems'}:")
            for problem in problems:
                _print(f"  - {problem}")
            sys.exit(1)
        _print("\nNo problems found.")

    def _check(self, parser: EventDataParser) -> list[str]:
        """Prints the figures and returns the problems."""
        # What training and evaluation will ask for.
        outputs = [parser.get_dataparser_outputs(split) for split in ("train", "val", "test")]
        recording, window = parser.recording, outputs[0].metadata[SCENE].window
        statistics, num_covered = _read(recording, window)
        problems = _check_events(recording, statistics) + _check_poses(recording, statistics, num_covered, window)
        if num_covered < _MIN_EVENTS:
            unseen = "" if self.picture is None else " No picture is written."
            _print(f"Contrast of warped events: not computed, for only {num_covered} events have a pose.{unseen}")
            return problems
        runs = _read_runs(recording, num_covered, window)
        with progress_bar() as progress:
            progress.add_task("Warping events", total=None)
            warped = WarpedEvents(runs, recording.trajectory, recording.event_camera)
            still, alternatives = warped.without_motion(), warped.comparisons()
        contrast_problems = _check_contrast(warped, still, alternatives)
        problems += contrast_problems
        depth = None
        if not contrast_problems:
            depth, box_problems = _check_depth(warped, recording, outputs[0].dataparser_scale)
            problems += box_problems
        _print_motion(recording, statistics, depth)
        if self.picture is not None:
            _write_picture(self.picture, warped)
        return problems


def _print(line: str) -> None:
    CONSOLE.print(line, highlight=False, markup=False, soft_wrap=True)


def _tracked(event_file: EventFile, description: str) -> Iterator[EventStream]:
    with progress_bar() as progress:
        task = progress.add_task(description, total=event_file.count())
        for chunk in event_file.chunks():
            yield chunk
            progress.advance(task, len(chunk))


def _read(recording: Recording, window: TimeWindow) -> tuple[EventStatistics, int]:
    """Statistics of the events, and how many of them have a pose."""
    event_file = recording.event_file
    num_covered = 0

    def chunks() -> Iterator[EventStream]:
        nonlocal num_covered
        for chunk in _tracked(event_file, "Reading events"):
            num_covered += int(window.contains(chunk.t).sum())
            yield chunk

    span = event_file.time_span()
    statistics = event_statistics(chunks(), event_file.width, event_file.height, span, _RATE_PARTS)
    return statistics, num_covered


def _read_runs(recording: Recording, num_covered: int, window: TimeWindow) -> list[EventStream]:
    """Runs of events that have a pose, evenly spread over these."""
    camera = recording.event_camera
    count = num_slices(num_covered, camera)
    length = num_covered if count == 1 else slice_size(camera)
    begins = np.linspace(0, num_covered - length, count).astype(np.int64)
    parts: list[list[dict[str, np.ndarray]]] = [[] for _ in begins]
    position = 0
    for chunk in _tracked(recording.event_file, "Choosing events"):
        covered = chunk[window.contains(chunk.t)]
        for part, begin in zip(parts, begins - position, strict=True):
            taken = covered[max(begin, 0) : max(begin + length, 0)]
            # Copies: views would keep whole chunks in memory.
            part.append({name: getattr(taken, name).copy() for name in ("x", "y", "t", "p")})
        position += len(covered)
    return [
        EventStream(
            **{name: np.concatenate([columns[name] for columns in part]) for name in ("x", "y", "t", "p")},
            width=camera.width,
            height=camera.height,
            source=recording.event_file.path,
        )
        for part in parts
    ]


def _check_events(recording: Recording, statistics: EventStatistics) -> list[str]:
    problems = []
    count, seconds = statistics.num_events, max(statistics.end - statistics.start, 1) * 1e-9
    camera = recording.event_camera
    _print(
        f"Events: {count:,} in {seconds:.3f} s (from {statistics.start} to {statistics.end} ns), "
        f"{count / seconds:,.0f} a second, {count / statistics.counts.size:.1f} a pixel of {camera.width} x "
        f"{camera.height}; {(statistics.counts == 0).mean():.1%} of the pixels have none"
    )
    rate = statistics.rate / seconds * _RATE_PARTS
    _print(f"Rate over time, 0 to {rate.max():,.0f} events a second:\n  |{_histogram(statistics.rate)}|")
    positive = statistics.num_positive / count
    _print(f"Polarity: {positive:.1%} positive")
    if not _MIN_POLARITY_SHARE < positive < 1 - _MIN_POLARITY_SHARE:
        problems.append(
            f"{positive:.1%} of the events are positive: check that the polarities were written as they were recorded"
        )
    repeated = statistics.num_repeated / count
    _print(f"Events with the pixel and time of another: {repeated:.2%}")
    if repeated > _MAX_REPEATED_SHARE:
        problems.append(
            f"{repeated:.1%} of the events have the pixel and time of another: check that no events were written "
            "twice, and that their times kept all their digits"
        )
    hot = find_hot_pixels(statistics.counts)
    _print(hot_pixel_summary(hot, statistics.counts))
    share = statistics.counts[hot].sum() / count
    if share > _MAX_HOT_SHARE:
        problems.append(
            f"hot pixels make {share:.1%} of the events: leave them out with aenerf convert --drop-hot-pixels"
        )
    return problems


def _histogram(values: np.ndarray) -> str:
    """One character for each value; only 0 is blank."""
    levels = np.ceil(values / max(values.max(), 1) * (len(_BLOCKS) - 1)).astype(int)
    return "".join(_BLOCKS[level] for level in levels)


def _check_poses(recording: Recording, statistics: EventStatistics, num_covered: int, window: TimeWindow) -> list[str]:
    problems = []
    trajectory = recording.trajectory
    times = trajectory.times.numpy()
    intervals = np.diff(times)
    median = float(np.median(intervals))
    degrees = torch.rad2deg(rotation_angle(trajectory.camera_to_worlds[:-1], trajectory.camera_to_worlds[1:]))
    steps = trajectory.camera_to_worlds[..., 3].diff(dim=0).norm(dim=-1)
    _print(
        f"Poses: {len(trajectory)} from {trajectory.start} to {trajectory.end} ns, {1e9 / median:.1f} a second; "
        f"between two of them at most {degrees.max():.2g} degrees and {steps.max():.2g} of their units; the path is "
        f"{steps.sum():.3g} long"
    )
    if recording.ground_truth is not None:
        _print(f"True poses: {len(recording.ground_truth)}, for evaluation")
    covered = num_covered / statistics.num_events
    _print(f"Events with a pose: {covered:.1%}")
    if covered < _MIN_COVERED_SHARE:
        problems.append(
            f"only {covered:.1%} of the events have a pose, the others are not used: check the clocks of events and "
            "poses, or cut the recording"
        )
    # Those that training leaves out were told when the dataset was opened.
    known = np.isin(times[:-1], [first for first, _ in window.gaps])
    gaps = np.flatnonzero((intervals > _GAP_FACTOR * median) & ~known)
    if len(gaps):
        # Of the sampled pairs, by their later event.
        segment = np.searchsorted(times, statistics.pair_times[:, 1]) - 1
        share = float(np.isin(segment, gaps).mean()) if len(segment) else 0.0
        longest = gaps[np.argsort(-intervals[gaps], kind="stable")[:_MAX_SHOWN]]
        named = ", ".join(f"{intervals[i] * 1e-9:.3f} s after {times[i]} ns" for i in longest)
        _print(f"Gaps between poses: {len(gaps)}, with {share:.1%} of the events; the longest: {named}")
        if share > _MAX_GAP_SHARE:
            problems.append(
                f"{share:.1%} of the events fall in gaps between poses, where they are interpolated: give the missing "
                "poses, or leave the gaps out (--max-pose-gap-ns of the dataparser)"
            )
    return problems


def _check_contrast(warped: WarpedEvents, still: Comparison, alternatives: list[Comparison]) -> list[str]:
    seconds = warped.seconds
    _print(
        f"Contrast of events warped by the poses (slices: {len(seconds)} of {np.median(seconds):.3f} s): "
        f"{still.given:.3f}; not warped: {still.contrast:.3f}"
    )
    shown = [c for c in alternatives if not c.hypothesis.clock_offset or c.is_clearly_better]
    for c in shown:
        _print(f"  {c.contrast:.3f} (given {c.given:.3f}) if {c.hypothesis.name}")
    clocks = [c for c in alternatives if c.hypothesis.clock_offset and c.is_clearly_worse]
    if clocks:
        least = min(abs(c.hypothesis.clock_offset) for c in clocks) * 1e-9
        _print(f"  clearly less if the clock of the poses is off by {least:g} s")
    better = [c for c in alternatives if c.is_clearly_better]
    if better:
        best = better[0]
        same = [c for c in better[1:] if best.is_like(c) and not c.hypothesis.clock_offset]
        others = "".join(f"; or as if {c.hypothesis.name}: {c.hypothesis.remedy}" for c in same)
        return [
            f"the events look as if {best.hypothesis.name} (contrast {best.contrast:.3f} instead of {best.given:.3f}): "
            f"{best.hypothesis.remedy}{others}"
        ]
    untold = [c.hypothesis.name for c in alternatives if c.is_untold and not c.hypothesis.clock_offset]
    if untold:
        _print(f"This motion cannot tell whether {', or '.join(untold)}.")
    if not still.is_clearly_worse:
        return [
            "the poses do not sharpen the events, nor does any usual mistake explain it: check the intrinsics and the "
            "clock; or the camera moves too little to tell"
        ]
    return []


def _check_depth(warped: WarpedEvents, recording: Recording, scale: float) -> tuple[float | None, list[str]]:
    """Prints from where to where there is something to see; returns the median depth in the poses' unit, and what is
    wrong with the scene box."""
    contrast = sum(s.energy.sum() for s in warped.given) / sum(s.brightness.sum() for s in warped.given)
    depths, points, weights = [], [], []
    for one in warped.given:
        trusted = (one.energy > _MIN_TILE_CONTRAST * contrast * one.brightness) & np.isfinite(one.depth)
        depths.append(one.depth[trusted])
        points.append(one.points[trusted])
        weights.append(one.energy[trusted])
    depth, point, weight = (np.concatenate(values) for values in (depths, points, weights))
    if len(depth) == 0:
        return None, []
    near, median, far = _quantiles(depth, weight, (0.03, 0.5, 0.97))
    low, high = (np.array([_quantiles(point[:, axis], weight, (q,))[0] for axis in range(3)]) for q in (0.03, 0.97))
    _print(
        f"What is seen is {near:.3g} to {far:.3g} away, in units of the poses (median {median:.3g}), within "
        f"{low.round(3).tolist()} to {high.round(3).tolist()} of their world"
    )
    box = recording.scene_box
    if box is None:
        _print(
            f"Suggested for a camera that stays that close: --pipeline.model.near-plane {0.7 * near * scale:.2g} "
            f"--pipeline.model.far-plane {10 * far * scale:.2g} (scene units: {scale:.3g} times those of the poses)"
        )
    else:
        inside = ((point >= box[0].numpy()) & (point <= box[1].numpy())).all(1)
        share = weight[inside].sum() / weight.sum()
        _print(f"Within the scene box: {share:.1%} of it")
        if share < _MIN_IN_BOX_SHARE:
            return median, [f"the scene box holds only {share:.1%} of what is seen: state a larger scene_box, or none"]
    return median, []


def _quantiles(values: np.ndarray, weights: np.ndarray, shares: tuple[float, ...]) -> list[float]:
    order = np.argsort(values)
    cumulated = np.cumsum(weights[order])
    return [float(values[order][np.searchsorted(cumulated, share * cumulated[-1])]) for share in shares]


def _print_motion(recording: Recording, statistics: EventStatistics, depth: float | None) -> None:
    """How far the camera moves from an event of a pixel to its next."""
    trajectory: Trajectory = recording.trajectory
    pairs = statistics.pair_times
    pairs = pairs[(pairs[:, 0] >= trajectory.start) & (pairs[:, 1] <= trajectory.end)]
    if len(pairs) == 0:
        return
    before, after = (trajectory.interpolate(pairs[:, column]) for column in (0, 1))
    angles = rotation_angle(before, after).numpy()
    lengths = (after - before)[..., 3].norm(dim=-1).numpy()
    focal = recording.event_camera.fx
    pixels = angles * focal + (0 if depth is None else lengths * focal / depth)
    figures = []
    for name, share in (("median", 0.5), ("95 %", 0.95)):
        interval, angle, length, pixel = (
            float(np.quantile(values, share))
            for values in ((pairs[:, 1] - pairs[:, 0]) * 1e-6, angles, lengths, pixels)
        )
        figures.append(f"{name} {interval:.3g} ms, {np.degrees(angle):.2g} degrees, {length:.2g} units, {pixel:.2g} px")
    _print(f"Motion from an event of a pixel to its next: {'; '.join(figures)}")


def _write_picture(path: Path, warped: WarpedEvents) -> None:
    net = np.rint(warped.picture()).astype(np.int64)
    rows, columns = np.nonzero(net)
    picture = polarity_picture(columns, rows, net[rows, columns], net.shape[1], net.shape[0])
    enlarged = max(_PICTURE_HEIGHT // net.shape[0], 1)
    try:
        Image.fromarray(picture.repeat(enlarged, 0).repeat(enlarged, 1)).save(path)
    except (OSError, ValueError) as error:
        raise DataError(path, f"it cannot be written ({error})", "choose another --picture, ending with .png") from None
    _print(f"{path}: events as they came, and warped")
