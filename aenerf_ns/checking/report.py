"""What ``aenerf check`` finds in a recording: figures and problems."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.checking.contrast import MIN_EVENTS, WarpedEvents, read_runs
from aenerf_ns.checking.contrast_checks import check_contrast, check_depth
from aenerf_ns.checking.event_checks import (
    check_events,
    check_lens,
    check_polarity,
    check_principal_point,
    check_thresholds,
)
from aenerf_ns.checking.frames import FrameChanges
from aenerf_ns.checking.noise import NoiseRate
from aenerf_ns.checking.pose_checks import check_poses, check_steps
from aenerf_ns.checking.result import CheckResult
from aenerf_ns.checking.thresholds import PolarityBalance
from aenerf_ns.events.statistics import event_statistics
from aenerf_ns.events.stream import EventStream
from aenerf_ns.progress import progress_bar
from aenerf_ns.recording.recording import Capture, Recording

_RATE_PARTS = 60


def check(
    recording: Capture, frames: Iterable[tuple[int, Path]], window: TimeWindow | None = None, scale: float = 1.0
) -> CheckResult:
    """Check a recording: its events and its lens, and where it has poses, these, and whether they fit the events.

    Args:
        frames: times in nanoseconds and files.
        window: the time that training uses; to be given where there are poses.
        scale: scene units in a unit of the poses.

    Raises:
        DataError: the events cannot be read.
    """
    window = window or TimeWindow()
    result, num_posed, num_covered = _check_events(recording, frames, window)
    if not isinstance(recording, Recording):
        check_lens(result, recording.event_camera)
        check_principal_point(result, recording.event_camera)
        return result
    check_poses(result, recording, window, num_posed)
    num_problems = len(result.problems)
    check_lens(result, recording.event_camera)
    check_steps(result, recording.trajectory, window)
    is_simple = len(result.problems) > num_problems
    # The events are read once more only where there can be enough.
    enough = num_covered >= MIN_EVENTS
    runs = read_runs(recording.event_file, recording.event_camera, window, num_covered) if enough else []
    if not runs:
        check_principal_point(result, recording.event_camera)
        result.figures.append(
            f"Contrast of warped events: not computed, because no {MIN_EVENTS} events have poses without a gap."
        )
        return result
    num_problems = len(result.problems)
    with progress_bar() as progress:
        progress.add_task("Warping events", total=None)
        result.warped = WarpedEvents(runs, recording.trajectory, recording.event_camera)
        poses_fit = check_contrast(result, result.warped, is_simple)
    if not poses_fit:
        # A wrong principal point may be the reason of all that the contrast finds. In a part of a sensor, poses fit
        # wherever it lies.
        found = result.problems[num_problems:]
        del result.problems[num_problems:]
        check_principal_point(result, recording.event_camera)
        if len(result.problems) == num_problems:
            result.problems += found
    # Poses that do not fit give wrong depths.
    if poses_fit is not False:
        check_depth(result, result.warped, recording, scale)
    return result


def _check_events(
    capture: Capture, frames: Iterable[tuple[int, Path]], window: TimeWindow
) -> tuple[CheckResult, int, int]:
    """Check the events, and count those that have a pose, and those of them in the window, which may be chosen."""
    file, num_posed, num_covered = capture.event_file, 0, 0
    known = capture.trajectory.known_time(capture.max_pose_gap) if isinstance(capture, Recording) else window
    changes = FrameChanges(capture, frames, window)
    balance, noise = PolarityBalance(file, capture.sensor.refractory_period), NoiseRate(file.width, file.height)

    def chunks() -> Iterator[EventStream]:
        nonlocal num_posed, num_covered
        for chunk in file.tracked("Reading events"):
            num_posed += int(known.contains(chunk.t).sum())
            num_covered += int(window.contains(chunk.t).sum())
            changes.add(chunk, balance.add(chunk))
            noise.add(chunk)
            yield chunk

    result = CheckResult(event_statistics(chunks(), file.width, file.height, file.time_span(), _RATE_PARTS))
    check_events(result, noise, capture.sensor.bayer_pattern)
    correlation = changes.correlation()
    check_polarity(result, correlation)
    check_thresholds(result, capture, changes, balance, correlation or 0.0)
    return result, num_posed, num_covered
