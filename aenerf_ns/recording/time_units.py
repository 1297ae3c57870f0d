"""Whether the times of events and poses fit each other, or do so only if those of one have another unit."""

from __future__ import annotations

from pathlib import Path

from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.errors import DataError
from aenerf_ns.files.event_reader import EventFile
from aenerf_ns.files.text import UNIT_NAMES

Span = tuple[int, int]

_UNITS: list[str] = list(UNIT_NAMES)
# Events do not fit poses if fewer poses lie among them, or if poses cover a smaller share of their time.
_MIN_POSES, _MIN_COVERED = 10, 0.1
# Two spans fit by chance less often, the more of the time that either covers is covered by both.
_MIN_OVERLAP, _SURE_OVERLAP = 0.05, 0.9
# No recording is shorter or longer, in seconds.
_SHORTEST, _LONGEST = 1e-3, 86_400


def require_one_unit(events: EventFile, poses: Trajectory, option: str) -> Span:
    """Return the times of the first and the last event in nanoseconds.

    Args:
        poses: of the events; their times were read as seconds.
        option: the dataparser's option for the unit of the events, or "" if it has none.

    Raises:
        DataError: the events are missing or out of order, or fit the poses only if the times of either have another
            unit.
    """
    span, known = events.time_span(), (poses.start, poses.end)
    seconds, covered = (span[1] - span[0]) * 1e-9, _common(span, known)
    is_covered = covered >= _MIN_COVERED * (span[1] - span[0])
    is_given = is_covered and len(poses.knots_between(*span)) >= _MIN_POSES
    power = unit_steps(span, known, _SURE_OVERLAP if is_given else _MIN_OVERLAP)
    if power is None and covered <= 0 and poses.duration < _MIN_COVERED * seconds:
        power = _steps_into(span, poses)
    # The time of one damaged event, at an end, says nothing of the unit.
    if power is None or (power < 0 and _share_within(events, known) >= _MIN_COVERED):
        return span
    part = ""
    if power > 0 and is_covered:
        # A short part at the beginning looks like that, too.
        part = ", or, if this part is what you want, give its start-time-ns and end-time-ns as options of the format"
    problem = f"the poses last {poses.duration:g} s and the events {seconds:g} s, as if the times of "
    source = poses.source if power > 0 else events.path
    if not option:
        event_error, pose_error = ("small", "large") if power > 0 else ("large", "small")
        problem += f"the events were {1000 ** abs(power):,} times too {event_error}, "
        problem += f"or those of the poses too {pose_error}"
        raise DataError(source, problem, "correct the unit of either" + part)
    blamed, remedies = [], []
    assumed = events.assumed_unit()
    index = -1 if assumed is None else _UNITS.index(assumed) + power
    is_short, is_long = seconds < _SHORTEST, poses.duration > _LONGEST
    if 0 <= index < len(_UNITS) and not (power > 0 and is_long):
        unit = _UNITS[index]
        blamed.append(f"the events were in {UNIT_NAMES[unit]}")
        remedies.append(f"give --{option.replace('_', '-')} {unit} (in aenerf --format-options {option}={unit})")
    if power > 0 and not (blamed and is_short):
        blamed.append(f"the poses were in {UNIT_NAMES[_UNITS[-1 - power]]}")
        remedies.append("write the times of the poses in seconds")
    if not blamed:
        return span
    raise DataError(source, problem + ", or those of ".join(blamed), ", or ".join(remedies) + part)


def require_covered(source: Path, num_events: int, num_covered: int) -> None:
    """Raise a DataError if hardly any events of a whole recording have a pose."""
    if num_covered < _MIN_COVERED * num_events:
        raise DataError(
            source,
            f"only {num_covered:,} of its {num_events:,} events have a pose",
            "check that events and poses share one clock and one unit of time; if this part is what you want, give its "
            "--start-time-ns and --end-time-ns",
        )


def unit_steps(span: Span, reference: Span, min_overlap: float = _MIN_OVERLAP) -> int | None:
    """Return by which power of 1000 a span of time must be multiplied to fit another one, or None if by none.

    Args:
        span, reference: first and last time, in nanoseconds.
        min_overlap: share of the time that either covers, which both cover if they fit.
    """
    for power in (1, 2, 3, -1, -2, -3):
        # With whole numbers: nanoseconds since 1970 have 19 digits.
        factor = int(1000 ** abs(power))
        first, last = (time * factor if power > 0 else time // factor for time in span)
        total = max(last, reference[1]) - min(first, reference[0])
        if _common((first, last), reference) > min_overlap * total:
            return power
    return None


def _steps_into(span: Span, poses: Trajectory) -> int | None:
    """Return by which power of 1000 a span must be divided to lie among poses, as a negative number, or None."""
    for power in (1, 2, 3):
        first, last = (time // 1000**power for time in span)
        if poses.start <= first and last <= poses.end and len(poses.knots_between(first, last)) >= _MIN_POSES:
            return -power
    return None


def _share_within(events: EventFile, span: Span) -> float:
    """Return the share of the events in a span of time."""
    inside = total = 0
    for chunk in events.tracked("Reading times"):
        inside += int(((chunk.t >= span[0]) & (chunk.t <= span[1])).sum())
        total += len(chunk)
    return inside / total


def _common(one: Span, other: Span) -> int:
    """Return how long two spans overlap in nanoseconds; negative if they are apart."""
    return min(one[1], other[1]) - max(one[0], other[0])
